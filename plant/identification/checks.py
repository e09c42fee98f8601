"""Checks of recordings and planned runs: ranges, phases of a test, saturated, swapped or mirrored cells, results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.core.arrays import Array, Flags
from cosim.core.errors import Fault
from plant.bench import REST_DUTY, Bench
from plant.identification.cells import Cells, at_rail
from plant.identification.estimates import LAGS, Measurement, Result, held_lag
from plant.identification.lags import frequency_of, group_by_frequency, sine
from plant.identification.protocol import (
    BENCH,
    CHANNELS,
    MIN_REPETITIONS,
    HeightTest,
    HoldTest,
    Protocol,
    SineTest,
    StepTest,
    Test,
)
from plant.identification.recordings import COLUMNS, Recording, commands
from plant.identification.thrust import MIN_LINE_RANGE, MIN_LINE_ROWS, height_of, rows_with_thrust, sets_by_duty
from plant.powertrain import servo_angle

MIN_DUTY_CHANGE, MIN_TILT_CHANGE = 0.1, np.radians(5)  # [%, rad] least variation of a command
MIN_DUTY_STEP, MIN_AMPLITUDE = 0.02, np.radians(1)  # [%, rad] of the duty, and of a sine of the tilt
MIN_WINDOW_ROWS, MIN_ROWS_BEFORE = 10, 3  # rows of a window, and before a step
ROWS_PER_PERIOD = 10  # rows in a period of a sine
MAX_PLANNED_ROWS = 1_000_000
RANGES = {"duty": (0.0, 100.0), "servo_duty": (0.0, 100.0), "height": (0.0, 20.0)}  # 20 m: a height in mm exceeds it
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MAX_RAIL_SHARE = {"thrust_line": 0.8, "projection": 0.5}  # share of saturated readings in a window; default 0.05
CHANNELS_OF = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}
MIN_FORCE_RATIO = 3.0  # standard deviations of one reading at rest
PROJECTION_RANGE = (0.4, 1.7)  # plausible factors on sin α in a single run; outside, the column is wrong
RESULT_RANGE = (0.5, 2.0)  # possible projection factors, ideally 1
OPPOSITE_PHASE = 130.0  # [°] from the tilt with the assumed lag; lags differ by less than 90°, a mirrored cell by 180°
MAX_TARE = 0.25  # largest tare as a share of the calibration voltages
SWAPPED = "are the channels swapped? Change their names"
Lack = tuple[str, int, str]  # key of the test, row, and message


def planned_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield every fault of the simulated tests before a simulation, once for all equal runs."""
    file, bench = protocol.file, protocol.bench
    for name, test in file.tests.named_tests():
        if test.files:
            continue
        longest = max((time for time, *_ in test.phases), default=0.0)
        if isinstance(test, SineTest):
            longest = max(2.0 * np.pi * n / w for n, w in zip(test.periods, test.frequencies, strict=True))
        if longest / file.step > MAX_PLANNED_ROWS:
            text = f"the step is too short: a run of {longest:g} s would have {longest / file.step:.3g} rows"
            cure = f"{MAX_PLANNED_ROWS} are allowed; give {longest / MAX_PLANNED_ROWS:.1g} s or more"
            yield protocol.yaml.fault(("step",), f"{text}, and {cure}")
            continue
        found: dict[tuple[str, str], Fault] = {}
        for label, time, duty, servo_duty, height in commands(test, bench, file.step):
            run = Recording(name + label, time, duty, servo_duty, np.full(time.size, height), {})
            for key, _, message in lacks(bench, name, test, run, own=file.bench == BENCH):
                found.setdefault((key, message), protocol.yaml.fault(("tests", name, key), message))
        yield from found.values()


def lacks(bench: Bench, name: str, test: Test, r: Recording, *, own: bool) -> Iterator[Lack]:
    """Yield what a recorded or planned run lacks for its test.

    Args:
        own: True if the thrust line in `bench` is simulated and gives the duty of zero thrust.
    """
    if missing := list(_missing_windows(test, r)):
        yield from missing
        return
    duty, angle = r.duty, servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope)
    rest, window = r.rows(test.rest), _looked_at(test, r)
    idle = -bench.thrust_offset / bench.thrust_slope if own else REST_DUTY
    at_rest, first, needs_thrust = float(duty[rest].max()), _first(window), name != "moment"
    if needs_thrust and duty.max() <= idle:
        key = "duty" if isinstance(test, SineTest) else "phases"
        limit = f"thrust begins above {idle:.4g} %: the phase with thrust is missing"
        yield key, 0, f"duty is {duty.max():g} % at most, and {limit}"
        return
    is_highest = needs_thrust and at_rest >= duty[~rest].max(initial=-np.inf)
    if is_highest or at_rest > max(REST_DUTY, duty.min()) + MIN_DUTY_CHANGE:
        cure = f"begin each run with the motor off, at {REST_DUTY:g} % or less"
        yield "rest", _first(rest), f"the phase at rest is missing: duty is {at_rest:g} % there already; {cure}"
        return
    if isinstance(test, StepTest) and (lack := _missing_step(name, test, r, duty if name == "thrust_step" else angle)):
        yield lack
        return
    under_thrust = {} if name in ("thrust_line", "moment") else {"window": window}
    if isinstance(test, HoldTest):
        under_thrust["hold"] = r.rows(test.hold)
    if isinstance(test, StepTest):
        under_thrust["window"] = window & (r.time >= test.at)
    begins = max(idle, at_rest)
    for key, rows in under_thrust.items():
        if (low := rows & (duty <= begins)).any():
            limit = f"where thrust begins above {begins:.4g} %; keep the motor running there"
            yield key, _first(low), f"duty is {duty[low].min():.4g} % in `{key}`, {limit}"
    if name == "thrust_line" and duty[window].max() - max(idle, duty[window].min()) < MIN_DUTY_CHANGE:
        text = f"the duty of `window` moves by less than {MIN_DUTY_CHANGE:g} % above {idle:.4g} %, where thrust begins"
        yield "window", first, f"{text}: a line needs a ramp"
    if name in ("projection", "moment") and np.ptp(angle[window]) < MIN_TILT_CHANGE:
        text = f"the tilt of `window` moves by less than {np.degrees(MIN_TILT_CHANGE):g}°; let it sweep"
        yield "window", first, text
    if name == "moment" and (running := window & (duty > max(REST_DUTY, at_rest) + MIN_DUTY_CHANGE)).any():
        text = f"duty is {duty[running].max():.4g} % in `window`, which is read with the motor off"
        yield "window", _first(running), text
    if isinstance(test, SineTest):
        yield from _missing_sine(test, r, angle[window])


def _missing_windows(test: Test, r: Recording) -> Iterator[Lack]:
    """Yield windows with too few rows of a run; a sine test uses all rows after its lead."""
    windows = {"rest": test.rest} if isinstance(test, SineTest) else {"rest": test.rest, "window": test.window}
    windows |= {"hold": test.hold} if isinstance(test, HoldTest) else {}
    for key, (start, end) in windows.items():
        covered = r.time[0] <= start + 1.5 * r.step and end <= r.time[-1] + 1.5 * r.step
        if (count := int(r.rows((start, end)).sum())) >= MIN_WINDOW_ROWS and covered:
            continue
        if covered and r.step > (end - start) / MIN_WINDOW_ROWS:
            text = f"rows are {r.step:.3g} s apart, so that `{key}` from {start:g} to {end:g} s holds {count}"
            cure = "if the time is in milliseconds, name its column time [ms]"
            yield key, 1, f"{text}, {MIN_WINDOW_ROWS} at least are needed; {cure}"
        else:
            text = f"the phase `{key}` from {start:g} to {end:g} s is missing"
            lasts = f"the run lasts from {r.time[0]:g} to {r.time[-1]:g} s"
            yield key, r.time.size - 1, f"{text}, {lasts}; record it, or change the window"


def _missing_step(name: str, test: StepTest, r: Recording, command: Array) -> Lack | None:
    """Return the deficiency of a run without a step at the stated time, or with too few rows about it."""
    at, (start, end) = test.at, test.window
    row = min(int(np.searchsorted(r.time, at)), r.time.size - 1)
    near = (r.time >= at - 2.5 * r.step) & (r.time <= at + 2.5 * r.step)
    least, of = (MIN_DUTY_STEP, "duty") if name == "thrust_step" else (MIN_TILT_CHANGE, "servo_duty")
    size = "0.02 %" if name == "thrust_step" else "5°"
    if np.abs(np.diff(command[near])).max(initial=0.0) < least:  # slower motion is no step
        steps = r.time[1:][np.abs(np.diff(command)) >= least]
        some = ", ".join(f"{t:g}" for t in steps[:3])
        there = f"there is one at {some} s" if 0 < steps.size < 20 else "none is there"
        return "at", row, f"{of} has no step at {at:g} s of {size} at least; {there}"
    after, before = (int(rows.sum()) for rows in (r.rows((at, end)), r.time < at - 0.5 * r.step))
    if not start - 0.5 * r.step <= at <= end or after < MIN_WINDOW_ROWS or before < MIN_ROWS_BEFORE:
        needed = f"with {MIN_WINDOW_ROWS} rows after it, and {MIN_ROWS_BEFORE} before it in the run"
        text = f"`window` from {start:g} to {end:g} s does not hold the step `at` {at:g} s {needed}"
        return "window", row, text
    return None


def _missing_sine(test: SineTest, r: Recording, angle: Array) -> Iterator[Lack]:
    """Yield the deficiency of a run without a sine, with less than a period, or with too few rows in a period."""
    if angle.size < MIN_WINDOW_ROWS or np.ptp(angle) < MIN_AMPLITUDE:
        yield "amplitude", 0, f"the tilt has no sine after {test.lead:g} s; give it 1° at least"
        return
    w = frequency_of(r, test)
    period = 2.0 * np.pi / w
    skips = dict(zip(test.frequencies, test.thesis_skip, strict=False))
    needed = test.lead + max(test.skip, skips.get(w, 0.0) * period) + period
    if r.time[-1] < needed - 1.5 * r.step:
        text = f"the run of {w:g} rad/s ends at {r.time[-1]:.4g} s, before a whole period after what is skipped"
        yield "periods", r.time.size - 1, f"{text}; it has to last until {needed:.4g} s"
    if r.step > period / ROWS_PER_PERIOD * (1.0 + 1e-3):
        text = f"rows are {r.step:.3g} s apart, fewer than {ROWS_PER_PERIOD} in a period of {w:g} rad/s"
        yield "frequencies", 1, f"{text}; give rows {period / ROWS_PER_PERIOD:.3g} s apart or less, or leave it out"


def _looked_at(test: Test, r: Recording) -> Flags:
    return np.asarray(r.time >= test.lead + test.skip) if isinstance(test, SineTest) else r.rows(test.window)


def _first(rows: Flags) -> int:
    return int(np.flatnonzero(rows)[0])


# -- recordings -----------------------------------------------------------------------------


def recording_faults(
    protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells, *, whole: bool = True
) -> list[Fault]:
    """Return every fault of a test's recordings; a recording without a file is simulated.

    Args:
        whole: True if all files of the test are readable, for joint checks.
    """
    bench, yaml, test = protocol.bench, protocol.yaml, getattr(protocol.file.tests, name)
    m, faults = Measurement(recordings, cells, bench, test), list[Fault]()
    for r in recordings:
        found = list[tuple[int, str]]()
        if r.path is not None:  # planned phases are checked before
            found = list(_range_faults(bench, r))
            found = found or [(row, text) for _, row, text in lacks(bench, name, test, r, own=False)]
        for row, text in dict.fromkeys(found or _cell_faults(m, name, r)):
            place = (yaml.path, 0, 0) if r.path is None else (r.path, int(r.lines[row]), 1)
            faults.append(Fault(*place, f"{r.label}: {text}" if r.path is None else text))
    if whole and not faults:
        faults += _joint_faults(protocol, name, test, recordings)
        line = rows_with_thrust(m).delayed if name == "thrust_line" else ()
        if any(d.size < MIN_LINE_ROWS or np.ptp(d) < MIN_LINE_RANGE for d in line):
            text = "the ramp has too few readings with thrust within the range of the cell; give a window with more"
            faults.append(yaml.fault(("tests", name, "window"), text))
    return faults


def _range_faults(bench: Bench, r: Recording) -> Iterator[tuple[int, str]]:
    """Yield row and message of each column's first implausible value, or else of an impossible tilt."""
    columns = {"duty": r.duty, "servo_duty": r.servo_duty, "height": r.height}
    columns |= {f"volts_{c}": v for c, v in r.volts.items()}
    step = bench.converter_range / bench.converter_levels
    for name, values in columns.items():
        low, high = RANGES.get(name, (-step, bench.converter_range + step))
        outside = (values < low) | (values > high) | ((values <= 0.0) & (name == "height"))
        if outside.any():
            row, unit = _first(outside), COLUMNS[name]
            text = f"{name} is {values[row]:.4g} {unit} here, beyond {low:.3g} to {high:.4g} {unit}"
            cure = "give raw voltages, or `converter_range`" if unit == "V" else f"say its unit, such as {name} [mm]"
            yield row, f"{text}; {'write it in % of the frame' if unit == '%' else cure}"
        elif name == "servo_duty":
            angle = servo_angle(values, bench.servo_neutral, bench.servo_slope)
            if (outside := np.abs(angle) > MAX_TILT).any():
                row = _first(outside)
                text = f"servo_duty of {values[row]:.4g} % is a tilt of {np.degrees(angle[row]):.0f}°, beyond ±120°"
                cure = "write it in % of the frame, or give `servo_neutral` and `servo_slope` under `parameters`"
                yield row, f"{text}; {cure}"


def _cell_faults(m: Measurement, name: str, r: Recording) -> Iterator[tuple[int, str]]:
    """Yield row and message of a saturated, dead, swapped or mirrored cell."""
    test, window = m.test, _looked_at(m.test, r)
    channels = CHANNELS_OF.get(name, "x")
    for c in channels:
        volts, rail = r.volts[c], at_rail(m.bench, r.volts[c]) & window
        if (share := rail.sum() / window.sum()) > MAX_RAIL_SHARE.get(name, 0.05):
            text = f"volts_{c} is at the end of its range, {volts[rail][0]:.3g} V, at {100 * share:.0f} % of the rows"
            yield _first(rail), f"{text}, first in this row; take a cell of a larger range, or less thrust"
            return
        if np.ptp(volts[window]) == 0.0:
            yield _first(window), f"volts_{c} stands still at {volts[window][0]:.4g} V; look at the cell and its wires"
            return
    faults = [] if name == "moment" else list(_channel_faults(m, name, r))
    yield from faults
    for c in channels if not faults else "":
        cell, at_rest = m.cells[c], float(r.volts[c][r.rows(test.rest)].mean())
        if abs(at_rest - cell.zero) > MAX_TARE * float(np.ptp(cell.volts)):
            text = f"volts_{c} is {at_rest:.4g} V at rest, and cell {c} without load {cell.zero:.4g} V"
            yield 0, f"{text}, more than a quarter of its calibration off; calibrate it anew, or {SWAPPED}"


def _channel_faults(m: Measurement, name: str, r: Recording) -> Iterator[tuple[int, str]]:
    """Yield row and message of channels that do not follow the commands."""
    bench, test = m.bench, m.test
    rest, window = r.rows(test.rest), _looked_at(test, r)
    force, change = {c: m.force(r, c) for c in CHANNELS}, dict[str, float]()
    for c in CHANNELS:
        size = np.abs(force[c] - force[c][rest].mean())
        most, least = (float(np.quantile(size[rows], 0.99)) for rows in (window, rest))
        change[c] = (most - least) / float(np.ptp(m.cells[c].loads))
    if name in ("thrust_line", "ground_effect", "thrust_step"):
        other = max("xm", key=lambda c: change[c])
        if change[other] > max(0.2, change["z"]):
            yield 0, f"volts_{other} follows the thrust and volts_z does not, upright: {SWAPPED}"
        elif force["z"][window].mean() < 0:
            text = "the vertical force falls with the duty: volts_z has the wrong sign or another calibration"
            yield 0, f"{text}; look at the plug and at the points of cell z"
        return
    if name in ("step", "frequency") and change["m"] > max(0.2, change["x"]):
        yield 0, f"volts_m follows the tilt and volts_x does not: {SWAPPED}"
    delayed = held_lag(servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope), r.step, bench.lag)
    leans = "the horizontal force leans against the commanded tilt"
    mirrored = f"servo or cell x is mirrored: turn the sign of `servo_slope` under `parameters`, {-bench.servo_slope:g}"
    if isinstance(test, SineTest) and (w := frequency_of(r, test)) > min(test.frequencies):
        size = sine(r, force["x"], w, test)  # an unknown lag changes the phase
        error = float(force["x"][rest].std()) * float(np.sqrt(2.0 / window.sum()))
        phase = float(np.degrees(np.angle(size / sine(r, np.sin(delayed), w, test))))
        if abs(size) > MIN_FORCE_RATIO * error and abs(phase) > OPPOSITE_PHASE:
            yield (
                _first(window),
                f"{leans} (phase {phase:.0f}° at {w:g} rad/s); {mirrored}, or look at its clock",
            )
        return
    rows = r.rows((test.window[1] - 0.3, test.window[1])) if name == "step" else window
    angle = delayed[rows]
    x, z = (float(force[c][rows] @ f(angle) / (f(angle) @ f(angle))) for c, f in (("x", np.sin), ("z", np.cos)))
    factor, (least, most) = x / z, PROJECTION_RANGE
    if -most <= factor <= -least:
        yield _first(rows), f"{leans} (factor {factor:.3g} on sin α, 1 is right); {mirrored}, or of the loads of cell x"
    elif not least <= factor <= most:
        text = f"the horizontal force is {factor:.3g} times the thrust of volts_z times sin α, and 1 is right"
        yield _first(rows), f"{text}; look at the points and units of cells z and x, and at `servo_slope`; {SWAPPED}"


def _joint_faults(protocol: Protocol, name: str, test: Test, recordings: Sequence[Recording]) -> Iterator[Fault]:
    """Yield faults of a test's recordings as a whole: too few of a height or a frequency."""
    place, groups = ("tests", name, "files") if test.files else ("tests", name), dict[str, int]()
    if isinstance(test, SineTest):
        by_frequency = group_by_frequency(recordings, test)
        groups = {f"{w:g} rad/s": len(by_frequency.get(w, ())) for w in test.frequencies}
    if isinstance(test, HeightTest):
        heights = Counter(height_of(r, test) for r in recordings)
        groups = {f"{h:g} m": count for h, count in heights.items()}
        if max(heights) < test.free_height:
            cure = f"add runs at {test.free_height:g} m or more, or lower free_height"
            yield protocol.yaml.fault(place, f"the runs with nothing below are missing; {cure}")
        if len(heights) < 3:
            yield protocol.yaml.fault(place, "two heights near the ground are needed at least; add runs")
        main, *others = sets_by_duty(recordings, test)
        for r in (r for s in others if main.keys() - s.keys() for group in s.values() for r in group):
            if r.path is not None:
                window = r.rows(test.window)
                text = f"duty is {np.median(r.duty[window]):.4g} % in `window`, unlike that of most runs"
                cure = "runs of another duty are needed at each height; correct the column, or leave the file out"
                yield Fault(r.path, int(r.lines[_first(window)]), 1, f"{text}; {cure}")
    for what, count in groups.items():
        if count < MIN_REPETITIONS:
            text = f"{count} recordings at {what} are too few; record {MIN_REPETITIONS} at least"
            yield protocol.yaml.fault(place, text)


def result_faults(protocol: Protocol, results: Sequence[Result]) -> Iterator[Fault]:
    """Yield a fault for each impossible number; warn in its result of an interval that holds impossible values."""
    for result in results:
        for e in result.estimates:
            if e.name.startswith("lag"):  # an end of the lags that are tried is no result
                low, high = LAGS[0] * 1.001, LAGS[-1] / 1.001
            else:
                low, high = RESULT_RANGE if "projection" in e.name else protocol.bench.declared[e.name].bounds
            unit = "" if e.unit == "1" else f" {e.unit}"
            possible = f"{low:.4g} to {high:.4g}{unit} is possible"
            if not (low <= e.value <= high and np.isfinite([e.low, e.high]).all()):
                text = f"{e.name} comes out as {e.value:.4g}{unit} (95 % {e.low:.4g} … {e.high:.4g}), and {possible}"
                cure = "look at the units and points of the cells, and for a run that differs"
                yield protocol.yaml.fault(("tests", result.test), f"{text}; {cure}", key=True)
            elif e.low < low or e.high > high:
                text = f"the interval of {e.name}, {e.low:.4g} to {e.high:.4g}{unit}, contains impossible values"
                result.warnings.append(f"{text} ({possible}): look for a run that differs, or record more")
