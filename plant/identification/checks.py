"""Checks of a protocol: phases of its tests, plausible recordings, possible results."""

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
MIN_DUTY_STEP = 0.02  # [%]
MIN_SWEEP = {"projection": 5.0, "moment": 5.0, "frequency": 1.0}  # [°] smallest change of the tilt
MIN_WINDOW_ROWS, ROWS_PER_PERIOD = 10, 10  # rows of a window, and of a period of a sine
# 20 m: a height in mm exceeds this limit
RANGES = {"duty": (0.0, 100.0), "servo_duty": (0.0, 100.0), "height": (0.001, 20.0)}
MAX_TILT = np.radians(120.0)  # a servo turns by ±90° and some degrees; a duty in other units gives whole turns
MAX_RAIL_SHARE = {"thrust_line": 0.8, "projection": 0.5}  # share of saturated readings in a window; default 0.05
CHANNELS_OF = {"thrust_line": "z", "ground_effect": "z", "thrust_step": "z", "projection": "zx", "moment": "m"}
UPRIGHT = ("thrust_line", "ground_effect", "thrust_step")  # tests without a tilt
PROJECTION_RANGE = (0.4, 1.7)  # plausible factors on sin α in a single run; outside, the column is wrong
RESULT_RANGE = (0.5, 2.0)  # possible projection factors, ideally 1
MAX_TARE = 0.25  # largest tare as a share of the calibration voltages
SWAPPED = "the channels may be swapped; then rename them"


def planned_faults(protocol: Protocol) -> Iterator[Fault]:
    """Yield every fault of the tests that will be simulated; faults of equal runs are reported once."""
    file, bench = protocol.file, protocol.bench
    idle = REST_DUTY if file.bench is None else -bench.thrust_offset / bench.thrust_slope
    for name, test in file.tests.named_tests():
        runs = [] if test.files else commands(test, bench, file.step)
        missing = (missing_phase(bench, name, test, run, idle) for run in runs)
        for key, message in dict.fromkeys((fault[0], fault[2]) for fault in missing if fault):
            yield protocol.yaml.fault(("tests", name, key), message)


def missing_phase(bench: Bench, name: str, test: Test, r: Recording, idle: float) -> tuple[str, int, str] | None:
    """Return key of the test, row and message of the first phase that a recorded or planned run lacks.

    Args:
        idle: Highest duty without thrust [%].
    """
    windows = {"rest": test.rest, "window": test.window}
    if isinstance(test, HoldTest):
        windows["hold"] = test.hold
    elif isinstance(test, StepTest):
        windows["at"] = (test.at, test.window[1])
    elif isinstance(test, SineTest):
        windows["window"] = (test.analysed[0], r.time[-1])
    slack, phases = 1.5 * r.step, {key: r.rows(window) for key, window in windows.items()}
    for key, (first, last) in windows.items():
        count = int(phases[key].sum())
        if count < MIN_WINDOW_ROWS or first < r.time[0] - slack or last > r.time[-1] + slack:
            text = f"`{key}` from {first:g} to {last:g} s has {count} rows of a run that ends at {r.time[-1]:.4g} s"
            return key, 0, f"{text}; {MIN_WINDOW_ROWS} are needed; give the unit of time if it is not s: time [ms]"
    duty, angle, window = r.duty, r.commanded_tilt(bench), phases["window"]
    at_rest = float(duty[phases["rest"]].max())
    begins = max(idle, at_rest)
    has_thrust = name == "moment" or duty.max() > begins
    if not has_thrust or at_rest > max(REST_DUTY, duty.min()) + MIN_DUTY_CHANGE:
        text = f"duty is {at_rest:g} % in `rest`, which needs the motor off, and at most {duty.max():g} %"
        return "rest", _first(phases["rest"]), f"{text}; thrust begins above {idle:.4g} %"
    if isinstance(test, StepTest):
        command, of, least = (
            (duty, "duty", MIN_DUTY_STEP) if name == "thrust_step" else (angle, "servo_duty", MIN_TILT_CHANGE)
        )
        # slower motion is no step
        if np.abs(np.diff(command[np.abs(r.time - test.at) <= 2.5 * r.step])).max(initial=0.0) < least:
            text = f"{of} has no step at {test.at:g} s of at least {least:g}{' %' if of == 'duty' else '°'}"
            return "at", _first(window), text
    for key, rows in phases.items():
        low = rows & (duty <= begins)
        if key != "rest" and name not in ("moment", "thrust_line") and low.any():
            text = f"duty is {duty[low].min():.4g} % in `{key}`, where thrust begins above {begins:.4g} %"
            return key, _first(low), text
    if name == "thrust_line" and duty[window].max() - max(idle, duty[window].min()) < MIN_DUTY_CHANGE:
        text = f"the duty in `window` needs a ramp of at least {MIN_DUTY_CHANGE:g} % above {idle:.4g} %"
        return "window", _first(window), f"{text}, where thrust begins"
    change, least = np.degrees(np.ptp(angle[window])), MIN_SWEEP.get(name, 0.0)
    if change < least:
        return "window", _first(window), f"the tilt in `window` changes by {change:.3g}°, less than {least:g}°"
    if name == "moment" and (running := window & (duty > max(REST_DUTY, at_rest) + MIN_DUTY_CHANGE)).any():
        return "window", _first(running), f"duty is {duty[running].max():.4g} % in `window`, which needs the motor off"
    if isinstance(test, SineTest):
        w = frequency_of(r, test)
        period = 2.0 * np.pi / w
        needed = test.lead + max(test.skip, test.skipped_by_thesis(w)) + period
        if r.time[-1] < needed - slack or r.step > period / ROWS_PER_PERIOD * (1.0 + 1e-3):
            text = f"the run of {w:g} rad/s ends at {r.time[-1]:.4g} s, with rows {r.step:.3g} s apart; a whole period"
            return "periods", r.time.size - 1, f"{text} ends at {needed:.4g} s and needs {ROWS_PER_PERIOD} rows"
    return None


def _first(rows: Flags) -> int:
    return int(np.flatnonzero(rows)[0])


def recording_faults(protocol: Protocol, name: str, recordings: Sequence[Recording], cells: Cells) -> list[Fault]:
    """Return every fault of a test's recordings; a recording without a file is simulated."""
    bench, yaml, test = protocol.bench, protocol.yaml, getattr(protocol.file.tests, name)
    m, faults = Measurement(recordings, cells, bench, test), list[Fault]()
    for r in recordings:
        fault = None
        if r.path is not None:  # planned phases are checked before
            missing = missing_phase(bench, name, test, r, REST_DUTY)
            fault = _implausible_value(bench, r) or (missing and missing[1:])
        if fault := fault or _cell_fault(m, name, r):
            row, text = fault
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
        if max(heights) < test.free_height or len(groups) < 3:
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


def _implausible_value(bench: Bench, r: Recording) -> tuple[int, str] | None:
    """Return row and message of the first value outside the range of its column, or of an impossible tilt."""
    step = bench.converter_range / bench.converter_levels
    cures = {"%": "write it in % of the frame", "V": "give raw voltages, or `converter_range`"}
    columns = (r.duty, r.servo_duty, r.height, *r.volts.values())
    for q, values in zip(COLUMNS, columns, strict=True):
        low, high = RANGES.get(q.name, (-step, bench.converter_range + step))
        if (outside := (values < low) | (values > high)).any():
            text = f"{q.name} is {values[outside][0]:.4g} {q.unit} here, outside {low:.3g} to {high:.4g} {q.unit}"
            return _first(outside), f"{text}; {cures.get(q.unit, f'say its unit, such as {q.name} [mm]')}"
    angle = r.commanded_tilt(bench)
    if not (outside := np.abs(angle) > MAX_TILT).any():
        return None
    text = f"servo_duty is a tilt of {np.degrees(angle[outside][0]):.0f}° here, outside ±120°; {cures['%']}"
    return _first(outside), f"{text}, or give `servo_neutral` and `servo_slope` under `parameters`"


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
    if name != "moment" and name not in UPRIGHT:
        rows = r.rows((test.window[1] - 0.3, test.window[1])) if name == "step" else window
        angle = held_lag(r.commanded_tilt(bench), r.step, bench.lag)[rows]
        x, z = (
            float(m.force(r, c)[rows] @ f(angle) / (f(angle) @ f(angle))) for c, f in (("x", np.sin), ("z", np.cos))
        )
        factor, (least, most) = x / z, PROJECTION_RANGE
        # with a fast sine, an unknown lag changes the amplitude, not the sign
        is_fast = isinstance(test, SineTest) and frequency_of(r, test) > min(test.frequencies)
        if factor < 0.0 or not (is_fast or least <= factor <= most):
            text = f"the horizontal force is {factor:.3g} times (thrust of volts_z · sine of the tilt), not 1 times"
            cure = "check the points and units of cells z and x, and the sign of `servo_slope`"
            return _first(rows), f"{text}; {cure}; {SWAPPED}"
    for c in channels:
        cell, at_rest = m.cells[c], float(r.volts[c][r.rows(test.rest)].mean())
        if abs(at_rest - cell.zero) > MAX_TARE * float(np.ptp(cell.volts)):
            text = f"volts_{c} is {at_rest:.4g} V at rest, but {cell.zero:.4g} V in the calibration without load"
            return 0, f"{text}, more than a quarter of its range apart; calibrate again, or {SWAPPED}"
    return None


def result_faults(protocol: Protocol, results: Sequence[Result]) -> Iterator[Fault]:
    """Yield a fault for each impossible result."""
    for result in results:
        for e in result.estimates:
            if e.name.startswith("lag"):  # an end of the range of tried lags is not a result
                low, high = LAGS[0] * 1.001, LAGS[-1] / 1.001
            else:
                low, high = RESULT_RANGE if "projection" in e.name else protocol.bench.declared[e.name].bounds
            interval = f"95 % interval {e.low:.4g} … {e.high:.4g}"
            possible = f"{low:.4g} to {high:.4g} {e.unit}, with a finite interval"
            text = f"{e.name} is {e.value:.4g} {e.unit} ({interval}); possible are {possible}"
            if not (low <= e.value <= high and np.isfinite([e.low, e.high]).all()):
                cure = "check the units and calibration points of the cells, and look for a deviating run"
                yield protocol.yaml.fault(("tests", result.test), f"{text}; {cure}", key=True)
