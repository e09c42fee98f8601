"""Checks of recordings and planned runs: ranges, phases of a test, and saturated, swapped or mirrored cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import Fault
from plant.bench import REST_DUTY, Bench
from plant.identification.cells import Cells, at_rail, force_of
from plant.identification.command_response import held_lag
from plant.identification.estimates import Measurement
from plant.identification.frequency import frequency_of, group_by_frequency, sine
from plant.identification.ground_effect import height_of, sets_by_duty
from plant.identification.protocol import (
    CHANNELS,
    MIN_REPETITIONS,
    HeightTest,
    HoldTest,
    Protocol,
    SineTest,
    StepTest,
    Test,
)
from plant.identification.recordings import COLUMNS, Recording
from plant.identification.thrust_line import rows_with_thrust
from plant.powertrain import servo_angle

MIN_DUTY_RANGE, MIN_ANGLE, MIN_AMPLITUDE = 0.1, np.radians(5), np.radians(1)  # [%, rad] least variation of a command
MIN_DUTY_STEP = 0.02  # [%] of the duty
MIN_ROWS, MIN_ROWS_BEFORE = 10, 3  # rows of a window, and before a step
ROWS_PER_PERIOD = 10  # rows in a period of a sine
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MAX_RAIL_SHARE = {"thrust_line": 0.8, "projection": 0.5}  # share of saturated readings in a window; default 0.05
CHANNELS_OF = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}
MIN_FORCE_RATIO = 3.0  # standard deviations of one reading at rest
PROJECTION = (0.4, 1.7)  # plausible factors on sin α; outside, the column is wrong
OPPOSITE = 130.0  # [°] from the tilt with the assumed lag; lags differ by less than 90°, a mirrored cell by 180°
MAX_TARE = 0.25  # largest tare as a share of the calibration voltages
SWAPPED = "are the channels swapped? Change their names"


class Lack(NamedTuple):
    """A deficiency of a run: key of its test, row, and message."""

    key: str
    row: int
    message: str


def windows_of(test: Test) -> dict[str, tuple[float, float]]:
    """Return the windows of a test by key; a sine test uses all rows after its lead."""
    windows = {"rest": test.rest} if isinstance(test, SineTest) else {"rest": test.rest, "window": test.window}
    return windows | ({"hold": test.hold} if isinstance(test, HoldTest) else {})


def lacks(bench: Bench, name: str, test: Test, r: Recording, *, own: bool) -> Iterator[Lack]:
    """Yield the deficiencies of a recorded or planned run for its test.

    Args:
        own: True if the thrust line in `bench` is simulated and gives the duty of zero thrust.
    """
    missing = list(_missing_windows(test, r))
    yield from missing
    if missing:
        return
    duty, angle = r.duty, servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope)
    rest, window = r.rows(test.rest), _window(test, r)
    idle = -bench.thrust_offset / bench.thrust_slope if own else REST_DUTY
    at_rest, first = float(duty[rest].max()), _first(window)
    needs_thrust = name != "moment"
    if needs_thrust and duty.max() <= idle:
        key = "duty" if isinstance(test, SineTest) else "phases"
        limit = f"thrust begins above {idle:.4g} %: the phase with thrust is missing"
        yield Lack(key, 0, f"duty is {duty.max():g} % at most, and {limit}")
        return
    if (needs_thrust and at_rest >= duty[~rest].max(initial=-np.inf)) or (
        at_rest > max(REST_DUTY, duty.min()) + MIN_DUTY_RANGE
    ):
        cure = f"begin each run with the motor off, at {REST_DUTY:g} % or less"
        yield Lack("rest", _first(rest), f"the phase at rest is missing: duty is {at_rest:g} % there already; {cure}")
        return
    if isinstance(test, StepTest) and (lack := _missing_step(name, test, r, duty if name == "thrust_step" else angle)):
        yield lack
        return
    under_thrust = {} if name in ("thrust_line", "moment") else {"window": window}
    if isinstance(test, HoldTest):
        under_thrust["hold"] = r.rows(test.hold)
    if isinstance(test, StepTest):
        under_thrust["window"] = window & (r.time >= test.at)
    for key, rows in under_thrust.items():
        if (low := rows & (duty <= max(idle, at_rest))).any():
            limit = f"where thrust begins above {max(idle, at_rest):.4g} %; keep the motor running there"
            yield Lack(key, _first(low), f"duty is {duty[low].min():.4g} % in `{key}`, {limit}")
    if name == "thrust_line" and duty[window].max() - max(idle, duty[window].min()) < MIN_DUTY_RANGE:
        text = f"the duty of `window` moves by less than {MIN_DUTY_RANGE:g} % above {idle:.4g} %, where thrust begins"
        yield Lack("window", first, f"{text}: a line needs a ramp")
    if name in ("projection", "moment") and np.ptp(angle[window]) < MIN_ANGLE:
        text = f"the tilt of `window` moves by less than {np.degrees(MIN_ANGLE):g}°; let it sweep"
        yield Lack("window", first, text)
    if name == "moment" and (running := window & (duty > max(REST_DUTY, at_rest) + MIN_DUTY_RANGE)).any():
        text = f"duty is {duty[running].max():.4g} % in `window`, which is read with the motor off"
        yield Lack("window", _first(running), text)
    if isinstance(test, SineTest):
        yield from _missing_sine(test, r, angle[window])


def _missing_windows(test: Test, r: Recording) -> Iterator[Lack]:
    """Yield windows with too few rows of a run."""
    for key, (start, end) in windows_of(test).items():
        covered = r.time[0] <= start + 1.5 * r.step and end <= r.time[-1] + 1.5 * r.step
        if (count := int(r.rows((start, end)).sum())) >= MIN_ROWS and covered:
            continue
        if covered and r.step > (end - start) / MIN_ROWS:
            text = f"rows are {r.step:.3g} s apart, so that `{key}` from {start:g} to {end:g} s holds {count}"
            cure = "if the time is in milliseconds, name its column time [ms]"
            yield Lack(key, 1, f"{text}, {MIN_ROWS} at least are needed; {cure}")
        else:
            text = f"the phase `{key}` from {start:g} to {end:g} s is missing"
            lasts = f"the run lasts from {r.time[0]:g} to {r.time[-1]:g} s"
            yield Lack(key, r.time.size - 1, f"{text}, {lasts}; record it, or change the window")


def _missing_step(name: str, test: StepTest, r: Recording, command: Array) -> Lack | None:
    """Return the deficiency of a run without a step at the stated time, or with too few rows about it."""
    at, (start, end) = test.at, test.window
    row = min(int(np.searchsorted(r.time, at)), r.time.size - 1)
    near = (r.time >= at - 2.5 * r.step) & (r.time <= at + 2.5 * r.step)
    least, of = (MIN_DUTY_STEP, "duty") if name == "thrust_step" else (MIN_ANGLE, "servo_duty")
    if np.abs(np.diff(command[near])).max(initial=0.0) < least:  # slower motion is no step
        steps = r.time[1:][np.abs(np.diff(command)) >= least]
        there = (
            f"there is one at {', '.join(f'{t:g}' for t in steps[:3])} s" if 0 < steps.size < 20 else "none is there"
        )
        return Lack(
            "at", row, f"{of} has no step at {at:g} s of {'0.02 %' if of == 'duty' else '5°'} at least; {there}"
        )
    after, before = (int(rows.sum()) for rows in (r.rows((at, end)), r.time < at - 0.5 * r.step))
    if not start - 0.5 * r.step <= at <= end or after < MIN_ROWS or before < MIN_ROWS_BEFORE:
        needed = f"with {MIN_ROWS} rows after it, and {MIN_ROWS_BEFORE} before it in the run"
        return Lack(
            "window", row, f"`window` from {start:g} to {end:g} s does not hold the step `at` {at:g} s {needed}"
        )
    return None


def _missing_sine(test: SineTest, r: Recording, angle: Array) -> Iterator[Lack]:
    """Yield the deficiency of a run without a sine, with less than a period, or with too few rows in a period."""
    if angle.size < MIN_ROWS or np.ptp(angle) < MIN_AMPLITUDE:
        yield Lack("amplitude", 0, f"the tilt has no sine after {test.lead:g} s; give it 1° at least")
        return
    w = frequency_of(r, test)
    period = 2.0 * np.pi / w
    skips = dict(zip(test.frequencies, test.thesis_skip, strict=False))
    needed = test.lead + max(test.skip, skips.get(w, 0.0) * period) + period
    if r.time[-1] < needed - 1.5 * r.step:
        text = f"the run of {w:g} rad/s ends at {r.time[-1]:.4g} s, before a whole period after what is skipped"
        yield Lack("periods", r.time.size - 1, f"{text}; it has to last until {needed:.4g} s")
    if r.path is not None and r.step > period / ROWS_PER_PERIOD * (1.0 + 1e-3):
        text = f"rows are {r.step:.3g} s apart, fewer than {ROWS_PER_PERIOD} in a period of {w:g} rad/s"
        yield Lack("frequencies", 1, f"{text}; record it at {period / ROWS_PER_PERIOD:.3g} s or less, or leave it out")


def _window(test: Test, r: Recording) -> Flags:
    return np.asarray(r.time >= test.lead + test.skip) if isinstance(test, SineTest) else r.rows(test.window)


def _first(rows: Flags) -> int:
    """Return the index of the first True row."""
    return int(np.flatnonzero(rows)[0])


# -- recordings -----------------------------------------------------------------------------


def recording_faults(
    protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells, *, whole: bool = True
) -> list[Fault]:
    """Return every fault of a test's recordings; a recording without a file is simulated.

    Args:
        whole: True if all files of the test are readable, for joint checks.
    """
    test: Test = getattr(protocol.file.tests, name)
    faults: list[Fault] = []
    for r in recordings:
        found: list[tuple[str, int]] = []
        if r.path is not None:  # planned phases are checked before
            found += _range_faults(protocol.bench, r)
            found += found or [(k.message, k.row) for k in lacks(protocol.bench, name, test, r, own=False)]
        found = found or list(_cell_faults(protocol.bench, name, test, r, cells))
        for text, row in dict.fromkeys(found):
            if r.path is None:
                faults.append(Fault(protocol.yaml.path, 0, 0, f"{r.label}: {text}"))
            else:
                faults.append(Fault(r.path, int(r.lines[row]), 1, text))
    if whole and not faults:
        faults += _joint_faults(protocol, name, test, recordings)
        m = Measurement(recordings, cells, protocol.bench, test)
        if name == "thrust_line" and not rows_with_thrust(m).is_sufficient:
            text = "the ramp has too few readings with thrust within the range of the cell; give a window with more"
            faults.append(protocol.yaml.fault(("tests", name, "window"), text))
    return faults


def _range_faults(bench: Bench, r: Recording) -> Iterator[tuple[str, int]]:
    """Yield message and row of each column's first implausible value, and of an impossible tilt."""
    values = {"duty": r.duty, "servo_duty": r.servo_duty, "height": r.height}
    values |= {f"volts_{c}": r.volts[c] for c in CHANNELS}
    implausible = set[str]()
    for name, column in COLUMNS.items():
        low, high = column.low, bench.converter_range if column.high is None else column.high
        slack = bench.converter_range / bench.converter_levels if column.high is None else 0.0
        outside = (values[name] < low - slack) | (values[name] > high + slack)
        if column.unit == "m":
            outside |= values[name] <= 0.0
        if outside.any():
            implausible.add(name)
            row = _first(outside)
            text = f"{name} is {values[name][row]:.4g} {column.unit} here, beyond {low:g} to {high:g} {column.unit}"
            yield f"{text}; {column.cure.format(name=name)}", row
    angle = servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope)
    if "servo_duty" not in implausible and (outside := np.abs(angle) > MAX_TILT).any():
        row = _first(outside)
        text = f"servo_duty of {r.servo_duty[row]:.4g} % is a tilt of {np.degrees(angle[row]):.0f}°, beyond ±120°"
        cure = "write it in % of the frame, or give `servo_neutral` and `servo_slope` of this servo under `parameters`"
        yield f"{text}; {cure}", row


def _cell_faults(bench: Bench, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[tuple[str, int]]:
    """Yield message and row of a saturated, dead, swapped or mirrored cell."""
    window = _window(test, r)
    for c in CHANNELS_OF.get(name, "x"):
        volts, rail = r.volts[c], at_rail(bench, r.volts[c]) & window
        if (share := rail.sum() / window.sum()) > MAX_RAIL_SHARE.get(name, 0.05):
            text = (
                f"volts_{c} is at the end of its range, {volts[rail][0]:.3g} V, at {100 * share:.0f} % of the readings"
            )
            yield f"{text}, first in this row; take a cell of a larger range, or less thrust", _first(rail)
            return
        if np.ptp(volts[window]) == 0.0:
            yield f"volts_{c} stands still at {volts[window][0]:.4g} V; look at the cell and its wires", _first(window)
            return
    faults = [] if name == "moment" else list(_channel_faults(bench, name, test, r, cells))
    yield from faults
    for c in CHANNELS_OF.get(name, "x") if not faults else "":
        volts_at_rest = float(r.volts[c][r.rows(test.rest)].mean())
        if abs(volts_at_rest - cells[c].zero) > MAX_TARE * float(np.ptp(cells[c].volts)):
            text = f"volts_{c} is {volts_at_rest:.4g} V at rest, and cell {c} without load {cells[c].zero:.4g} V"
            yield f"{text}, more than a quarter of its calibration off; calibrate it anew, or {SWAPPED}", 0


def _channel_faults(bench: Bench, name: str, test: Test, r: Recording, cells: Cells) -> Iterator[tuple[str, int]]:
    """Yield message and row of channels that do not follow the commands."""
    rest, window = r.rows(test.rest), _window(test, r)
    force = {c: force_of(r, cells, c, test.rest) for c in CHANNELS}
    change = {}
    for c in CHANNELS:
        size = np.abs(force[c] - force[c][rest].mean())
        most, least = (float(np.quantile(size[rows], 0.99)) for rows in (window, rest))
        change[c] = (most - least) / float(np.ptp(cells[c].loads))
    if name in ("thrust_line", "ground_effect", "thrust_step"):
        other = max("xm", key=lambda c: change[c])
        if change[other] > max(0.2, change["z"]):
            yield f"volts_{other} follows the thrust and volts_z does not, upright: {SWAPPED}", 0
        elif force["z"][window].mean() < 0:
            cure = "look at the plug and at the points of cell z"
            yield (
                f"the vertical force falls with the duty: volts_z has the wrong sign or another calibration; {cure}",
                0,
            )
        return
    if name in ("step", "frequency") and change["m"] > max(0.2, change["x"]):
        yield f"volts_m follows the tilt and volts_x does not: {SWAPPED}", 0
    delayed = held_lag(servo_angle(r.servo_duty, bench.servo_neutral, bench.servo_slope), r.step, bench.lag)
    mirrored = (
        f"the servo or cell x is mirrored: turn the sign of `servo_slope` under `parameters`, {-bench.servo_slope:g}"
    )
    if isinstance(test, SineTest) and (w := frequency_of(r, test)) > min(test.frequencies):
        size = sine(r, force["x"], w, test)  # an unknown lag changes the phase
        error = float(force["x"][rest].std()) * float(np.sqrt(2.0 / window.sum()))
        phase = float(np.degrees(np.angle(size / sine(r, np.sin(delayed), w, test))))
        if abs(size) > MIN_FORCE_RATIO * error and abs(phase) > OPPOSITE:
            text = f"the horizontal force leans against the commanded tilt (phase {phase:.0f}° at {w:g} rad/s)"
            yield f"{text}; {mirrored}, or look at the clock of this run", _first(window)
        return
    rows = r.rows((test.window[1] - 0.3, test.window[1])) if name == "step" else window
    angle = delayed[rows]
    x, z = (float(force[c][rows] @ f(angle) / (f(angle) @ f(angle))) for c, f in (("x", np.sin), ("z", np.cos)))
    factor, (least, most) = x / z, PROJECTION
    if -most <= factor <= -least:
        text = f"the horizontal force leans against the commanded tilt (factor {factor:.3g} on sin α, 1 is right)"
        yield f"{text}; {mirrored}, or of the loads of cell x", _first(rows)
    elif not least <= factor <= most:
        text = f"the horizontal force is {factor:.3g} times the thrust of volts_z times sin α, and 1 is right"
        cure = "look at the points and units of cells z and x, and at `servo_slope`"
        yield f"{text}; {cure}; {SWAPPED}", _first(rows)


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
            text = "the runs with nothing below are missing"
            cure = f"add runs at {test.free_height:g} m or more, or lower free_height"
            yield protocol.yaml.fault(place, f"{text}; {cure}")
        if len(heights) < 3:
            yield protocol.yaml.fault(place, "two heights near the ground are needed at least; add runs")
        main, *others = sets_by_duty(recordings, test)
        for r in (r for s in others if main.keys() - s.keys() for group in s.values() for r in group):
            if r.path is not None:
                text = f"duty is {np.median(r.duty[r.rows(test.window)]):.4g} % in `window`, unlike that of most runs"
                cure = "runs of another duty are needed at each height; correct the column, or leave the file out"
                yield Fault(r.path, int(r.lines[_first(r.rows(test.window))]), 1, f"{text}; {cure}")
    for what, count in groups.items():
        if count < MIN_REPETITIONS:
            text = f"{count} recordings at {what} are too few; record {MIN_REPETITIONS} at least"
            yield protocol.yaml.fault(place, text)
