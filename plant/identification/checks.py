"""Checks of recordings and planned runs: ranges, phases, results, and saturated, swapped or sign-reversed cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.core.arrays import Flags
from cosim.core.errors import Fault
from plant.bench import REST_DUTY, Bench
from plant.identification.analyses import MIN_LINE_RANGE, MIN_LINE_ROWS, frequency_of, height_of, rows_with_thrust
from plant.identification.estimates import LAGS, Measurement, Result, held_lag
from plant.identification.protocol import (
    CELL_UNITS,
    MIN_REPETITIONS,
    HeightTest,
    HoldTest,
    Protocol,
    SineTest,
    StepTest,
    Test,
)
from plant.identification.recordings import COLUMNS, Cells, Recording, at_rail, commands

MIN_DUTY_CHANGE, MIN_TILT_CHANGE = 0.1, np.radians(5)  # [%, rad] smallest variation of a command
MIN_DUTY_STEP, MIN_AMPLITUDE = 0.02, np.radians(1)  # [%, rad] of the duty, and of a sine of the tilt
MIN_WINDOW_ROWS, MIN_ROWS_BEFORE = 10, 3  # rows of a window, and before a step
ROWS_PER_PERIOD = 10  # rows in a period of a sine
# 20 m: a height in mm exceeds this limit
RANGES = {"duty": (0.0, 100.0), "servo_duty": (0.0, 100.0), "height": (0.001, 20.0)}
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MAX_RAIL_SHARE = {"thrust_line": 0.8, "projection": 0.5}  # share of saturated readings in a window; default 0.05
CHANNELS_OF = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}
UPRIGHT = ("thrust_line", "ground_effect", "thrust_step")  # tests without a tilt
MIN_FOLLOWING = 0.2  # force of another cell, as a share of its calibration, from which it follows the thrust
PROJECTION_RANGE = (0.4, 1.7)  # plausible factors on sin α in a single run; outside, the column is wrong
RESULT_RANGE = (0.5, 2.0)  # possible projection factors, ideally 1
MAX_TARE = 0.25  # largest tare as a share of the calibration voltages
SWAPPED = "the channels may be swapped; then rename them"


def planned_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield every fault of the tests that will be simulated; faults of equal runs are reported once."""
    file = protocol.file
    for name, test in file.tests.named_tests():
        runs = [] if test.files else commands(test, protocol.bench, file.step)
        lacking = (lacks(protocol.bench, name, test, run, own=file.bench is not None) for run in runs)
        for key, message in {(key, message) for faults in lacking for key, _, message in faults}:
            yield protocol.yaml.fault(("tests", name, key), message)


def lacks(bench: Bench, name: str, test: Test, r: Recording, *, own: bool) -> Iterator[tuple[str, int, str]]:
    """Yield key of the test, row and message for each fault of a recorded or planned run.

    Args:
        own: True if the thrust line in `bench` is that of the simulated bench, so that it gives the duty of zero
            thrust.
    """
    windows = {"rest": test.rest} if isinstance(test, SineTest) else {"rest": test.rest, "window": test.window}
    if isinstance(test, HoldTest):
        windows["hold"] = test.hold
    begin, end, slack, is_short = r.time[0], r.time[-1], 1.5 * r.step, False
    for key, (first, last) in windows.items():
        count = int(r.rows((first, last)).sum())
        if count < MIN_WINDOW_ROWS or first < begin - slack or last > end + slack:
            is_short = True
            text = f"`{key}` from {first:g} to {last:g} s has {count} rows of a run from {begin:g} to {end:.4g} s"
            cure = f"at least {MIN_WINDOW_ROWS} are needed; give the unit of time if it is not s: time [ms]"
            yield key, 0, f"{text} with rows {r.step:.3g} s apart; {cure}"
    if is_short:
        return
    duty, angle = r.duty, r.commanded_tilt(bench)
    rest, window = r.rows(test.rest), r.rows(test.analysed)
    idle = -bench.thrust_offset / bench.thrust_slope if own else REST_DUTY
    at_rest, needs_thrust = float(duty[rest].max()), name != "moment"
    begins = max(idle, at_rest)
    if needs_thrust and duty.max() <= idle:
        text = f"duty is at most {duty.max():g} %, but thrust begins above {idle:.4g} %: there is no phase with thrust"
        yield "duty" if isinstance(test, SineTest) else "phases", 0, text
        return
    is_highest = needs_thrust and at_rest >= duty[~rest].max(initial=-np.inf)
    if is_highest or at_rest > max(REST_DUTY, duty.min()) + MIN_DUTY_CHANGE:
        text = f"there is no phase at rest: duty is {at_rest:g} %; begin with the motor off, at {REST_DUTY:g} % or less"
        yield "rest", _first(rest), text
        return
    under_thrust = {} if name in ("thrust_line", "moment") else {"window": window}
    if isinstance(test, HoldTest):
        under_thrust["hold"] = r.rows(test.hold)
    if isinstance(test, StepTest):
        command, of, least = (
            (duty, "duty", MIN_DUTY_STEP) if name == "thrust_step" else (angle, "servo_duty", MIN_TILT_CHANGE)
        )
        near = np.abs(r.time - test.at) <= 2.5 * r.step
        row = min(int(np.searchsorted(r.time, test.at)), r.time.size - 1)
        under_thrust["window"] = after = r.rows((test.at, test.window[1]))
        rows_before = int((r.time < test.at - 0.5 * r.step).sum())
        if np.abs(np.diff(command[near])).max(initial=0.0) < least:  # slower motion is no step
            yield "at", row, f"{of} has no step at {test.at:g} s of at least {'0.02 %' if of == 'duty' else '5°'}"
            return
        if test.window[0] > test.at + 0.5 * r.step or after.sum() < MIN_WINDOW_ROWS or rows_before < MIN_ROWS_BEFORE:
            text = f"with {MIN_WINDOW_ROWS} rows after it, and {MIN_ROWS_BEFORE} before it in the run"
            yield "window", row, f"`window` does not contain the step `at` {test.at:g} s {text}"
            return
    for key, rows in under_thrust.items():
        if (low := rows & (duty <= begins)).any():
            text = f"duty is {duty[low].min():.4g} % in `{key}`, where thrust begins above {begins:.4g} %"
            yield key, _first(low), text
    if name == "thrust_line" and duty[window].max() - max(idle, duty[window].min()) < MIN_DUTY_CHANGE:
        text = f"the duty in `window` needs a ramp of at least {MIN_DUTY_CHANGE:g} % above {idle:.4g} %"
        yield "window", _first(window), f"{text}, where thrust begins"
    if name in ("projection", "moment") and np.ptp(angle[window]) < MIN_TILT_CHANGE:
        yield "window", _first(window), "the tilt in `window` changes by less than 5°; sweep the tilt"
    if name == "moment" and (running := window & (duty > max(REST_DUTY, at_rest) + MIN_DUTY_CHANGE)).any():
        text = f"duty is {duty[running].max():.4g} % in `window`, which needs the motor off"
        yield "window", _first(running), text
    if isinstance(test, SineTest):
        if window.sum() < MIN_WINDOW_ROWS or np.ptp(angle[window]) < MIN_AMPLITUDE:
            yield "amplitude", 0, f"the tilt has no sine after {test.lead:g} s; command at least 1°"
            return
        w = frequency_of(r, test)
        period = 2.0 * np.pi / w
        needed = test.lead + max(test.skip, test.skipped_by_thesis(w)) + period
        if r.time[-1] < needed - 1.5 * r.step:
            text = f"the run of {w:g} rad/s has no whole period after the skipped part; extend it to {needed:.4g} s"
            yield "periods", r.time.size - 1, text
        if r.step > period / ROWS_PER_PERIOD * (1.0 + 1e-3):
            text = f"rows are {r.step:.3g} s apart, fewer than {ROWS_PER_PERIOD} in a period of {w:g} rad/s"
            yield "frequencies", 1, text


def _first(rows: Flags) -> int:
    return int(np.flatnonzero(rows)[0])


def recording_faults(protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells) -> list[Fault]:
    """Return every fault of a test's recordings; a recording without a file is simulated."""
    bench, yaml, test = protocol.bench, protocol.yaml, getattr(protocol.file.tests, name)
    m, faults = Measurement(recordings, cells, bench, test), list[Fault]()
    for r in recordings:
        found = list[tuple[int, str]]()
        if r.path is not None:  # planned phases are checked before
            found = list(_range_faults(bench, r))
            found = found or [(row, text) for _, row, text in lacks(bench, name, test, r, own=False)]
        for row, text in found or filter(None, [_cell_fault(m, name, r)]):
            at = (yaml.path, 0, 0) if r.path is None else (r.path, r.lines[row], 1)
            faults.append(Fault(*at, text if r.path else f"{r.label}: {text}"))
    if faults:
        return faults
    groups = Counter[str]()
    if isinstance(test, SineTest):
        groups = Counter({f"{w:g} rad/s": 0 for w in test.frequencies})
        groups.update(f"{frequency_of(r, test):g} rad/s" for r in recordings)
    if isinstance(test, HeightTest):
        heights = [height_of(r, test) for r in recordings]
        groups = Counter(f"{h:g} m" for h in heights)
        if max(heights) < test.free_height or len(set(heights)) < 3:
            text = f"runs at {test.free_height:g} m or more, without ground below, and at two lower heights are needed"
            faults.append(yaml.fault(("tests", name), f"{text}; add runs, or lower free_height"))
    for place, count in groups.items():
        if count < MIN_REPETITIONS:
            text = f"{count} recordings at {place} are too few; record at least {MIN_REPETITIONS}"
            faults.append(yaml.fault(("tests", name), text))
    line = rows_with_thrust(m)[3] if name == "thrust_line" else ()  # duty of each repetition
    if any(d.size < MIN_LINE_ROWS or np.ptp(d) < MIN_LINE_RANGE for d in line):
        text = "the ramp has too few readings with thrust within the range of the cell; enlarge the window"
        faults.append(yaml.fault(("tests", name, "window"), text))
    return faults


def _range_faults(bench: Bench, r: Recording) -> Iterator[tuple[int, str]]:
    """Yield row and message of the first implausible value in each column; if there is none, of an impossible tilt."""
    step = bench.converter_range / bench.converter_levels
    cures = {"%": "write it in % of the frame", "V": "give raw voltages, or `converter_range`"}
    columns = (r.duty, r.servo_duty, r.height, *r.volts.values())
    for q, values in zip(COLUMNS, columns, strict=True):
        low, high = RANGES.get(q.name, (-step, bench.converter_range + step))
        if (outside := (values < low) | (values > high)).any():
            text = f"{q.name} is {values[outside][0]:.4g} {q.unit} here, outside {low:.3g} to {high:.4g} {q.unit}"
            yield _first(outside), f"{text}; {cures.get(q.unit, f'say its unit, such as {q.name} [mm]')}"
    angle = r.commanded_tilt(bench)
    if (outside := (np.abs(angle) > MAX_TILT) & (r.servo_duty <= RANGES["servo_duty"][1])).any():
        text = f"servo_duty is a tilt of {np.degrees(angle[outside][0]):.0f}° here, outside ±120°; {cures['%']}"
        yield _first(outside), f"{text}, or give `servo_neutral` and `servo_slope` under `parameters`"


def _cell_fault(m: Measurement, name: str, r: Recording) -> tuple[int, str] | None:
    """Return row and message of the first saturated, dead, swapped or sign-reversed cell."""
    bench, test, window, channels = m.bench, m.test, r.rows(m.test.analysed), CHANNELS_OF.get(name, "x")
    for c in channels:
        volts, rail = r.volts[c], at_rail(bench, r.volts[c]) & window
        if (share := rail.sum() / window.sum()) > MAX_RAIL_SHARE.get(name, 0.05):
            text = f"volts_{c} is at the end of its range, {volts[rail][0]:.3g} V, at {100 * share:.0f} % of the rows"
            return _first(rail), f"{text}, first in this row; use a cell with a larger range, or less thrust"
        if np.ptp(volts[window]) == 0.0:
            return _first(window), f"volts_{c} is constant at {volts[window][0]:.4g} V; check the cell and its wires"
    if name in UPRIGHT:
        follows = {c: float(m.force(r, c)[window].mean() / np.ptp(m.cells[c].loads)) for c in CELL_UNITS}
        other = max("xm", key=lambda c: abs(follows[c]))
        if abs(follows[other]) > max(MIN_FOLLOWING, abs(follows["z"])):
            return 0, f"upright, volts_{other} follows the thrust and volts_z does not: {SWAPPED}"
        if follows["z"] < 0:
            return 0, "the vertical force decreases with the duty: check connector and points of cell z, volts_z"
    elif name != "moment":
        rows = r.rows((test.window[1] - 0.3, test.window[1])) if name == "step" else window
        angle = held_lag(r.commanded_tilt(bench), r.step, bench.lag)[rows]
        x, z = (
            float(m.force(r, c)[rows] @ f(angle) / (f(angle) @ f(angle))) for c, f in (("x", np.sin), ("z", np.cos))
        )
        factor, (least, most) = x / z, PROJECTION_RANGE
        # with a fast sine, an unknown lag changes the amplitude, not the sign
        is_fast = isinstance(test, SineTest) and frequency_of(r, test) > min(test.frequencies)
        is_reversed = factor < 0.0 if is_fast else -most <= factor <= -least
        if is_reversed or not (is_fast or least <= factor <= most):
            cure = f"check the points and units of cells z and x, and `servo_slope`; {SWAPPED}"
            if is_reversed:
                cure = f"reverse the sign of `servo_slope`, {-bench.servo_slope:g}, or of the loads of cell x"
            text = f"the horizontal force is {factor:.3g} times (thrust of volts_z · sine of the tilt), not 1 times"
            return _first(rows), f"{text}; {cure}"
    for c in channels:
        cell, at_rest = m.cells[c], float(r.volts[c][r.rows(test.rest)].mean())
        if abs(at_rest - cell.zero) > MAX_TARE * float(np.ptp(cell.volts)):
            text = f"volts_{c} is {at_rest:.4g} V at rest, but {cell.zero:.4g} V in the calibration without load"
            return 0, f"{text}, more than a quarter of its range apart; calibrate again, or {SWAPPED}"
    return None


def result_faults(protocol: Protocol, results: Sequence[Result]) -> Iterator[Fault]:
    """Yield a fault for each impossible result; add a warning to a result whose interval includes impossible values."""
    for result in results:
        for e in result.estimates:
            if e.name.startswith("lag"):  # an end of the range of tried lags is not a result
                low, high = LAGS[0] * 1.001, LAGS[-1] / 1.001
            else:
                low, high = RESULT_RANGE if "projection" in e.name else protocol.bench.declared[e.name].bounds
            possible = f"{low:.4g} to {high:.4g} {e.unit} is possible"
            text = f"{e.name} is {e.value:.4g} (95 % {e.low:.4g} … {e.high:.4g}), and {possible}"
            if not (low <= e.value <= high and np.isfinite([e.low, e.high]).all()):
                cure = "check the units and points of the cells, and look for a deviating run"
                yield protocol.yaml.fault(("tests", result.test), f"{text}; {cure}", key=True)
            elif e.low < low or e.high > high:
                result.warnings.append(f"{text}: look for a deviating run, or record more runs")
