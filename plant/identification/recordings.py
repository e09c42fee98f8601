"""Recordings of a protocol, simulated or measured, and the load cells that convert their voltages to forces.

The thesis uses a piecewise cubic through every calibration point (interp1), including its error. Here one cubic is
fitted to all points; the piecewise cubic is used only if that cubic is not monotonic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from cosim.core.arrays import Array, Flags
from cosim.core.errors import Fault, InputError, refuse
from cosim.logs.log import read_log
from cosim.model import Stepper
from cosim.model.namespaces import arrays
from plant.bench import FREE_HEIGHT, NEUTRAL_DUTY, REST_DUTY, Bench
from plant.identification.protocol import CELL_UNITS, HeightTest, Protocol, SineTest
from plant.powertrain import servo_angle

LOAD_TIME = 1.0  # [s] duration of a calibration load
MAX_SPACING = 2.5  # largest distance of two rows in steps; between them one row is missing and is interpolated
COLUMNS = (*Bench.inputs[:3], *Bench.outputs[:3])  # of a recording, beside the time


@dataclass(frozen=True)
class Recording:
    """A run on the bench: commands, constant between rows, and the simulated or measured cell voltages.

    Attributes:
        volts: Cell → voltage of each row.
        low_pass, loads, thrust: For a simulated run: filter time, loads at the hub, factor on the thrust.
        noise: For a simulated run: voltage added to each reading, shape (cells, rows).
        path, lines: For a measured run: file, and line number of each row.
    """

    label: str
    time: Array
    duty: Array
    servo_duty: Array
    height: Array
    volts: Mapping[str, Array] = field(default_factory=dict)
    low_pass: float = 0.0
    loads: tuple[float, ...] = (0.0, 0.0, 0.0)
    thrust: float = 1.0
    noise: Array = field(default_factory=lambda: np.empty(0))
    path: Path | None = None
    lines: Sequence[int] = ()

    @property
    def step(self) -> float:
        """Return the median step [s]."""
        return float(np.median(np.diff(self.time)))

    def commanded_tilt(self, bench: Bench) -> Array:
        """Return the commanded tilt [rad]."""
        return np.asarray(servo_angle(self.servo_duty, bench.servo_neutral, bench.servo_slope))

    def rows(self, window: tuple[float, float]) -> Flags:
        """Return the rows within a time window."""
        slack = 1e-6 * self.step
        rows: Flags = (self.time >= window[0] - slack) & (self.time <= window[1] + slack)
        return rows


# -- simulated runs -----------------------------------------------------------------------


def commands(test: Any, bench: Bench, step: float) -> list[Recording]:
    """Return all different runs of a test, with commands only.

    Commands are linear between phases; two phases at the same time make a step.
    """

    sets = list[tuple[str, float, Any, float]]()  # label, height, phases, frequency of a sine of the tilt
    if isinstance(test, SineTest):
        for w, periods in zip(test.frequencies, test.periods, strict=True):
            end, third = test.lead + max(2.0 * np.pi * periods / w, test.skip + 1.0), test.lead / 3.0
            phases = [(0, REST_DUTY, 0), (third, REST_DUTY, 0), (2.0 * third, test.duty, 0), (end, test.duty, 0)]
            sets.append((f" at {w:g} rad/s", test.height, phases, w))
    elif isinstance(test, HeightTest):
        places = [test.free_height, *(h * bench.propeller_radius for h in test.heights)]
        sets += [(f" at {h:g} m", h, test.phases, 0.0) for h in places]
        if test.validation_duty is not None:
            top = max(p[1] for p in test.phases)
            other = [(t, test.validation_duty if d == top else d, a) for t, d, a in test.phases]
            sets += [(f" at {h:g} m, validation", h, other, 0.0) for h in places]
    else:
        sets.append(("", test.height, test.phases, 0.0))
    runs = []
    for label, height, phases, w in sets:
        times, duties, angles = np.array(phases, float).T
        time = np.asarray(step * np.arange(round(times[-1] / step) + 1), dtype=np.float64)
        in_row = step * np.rint(times / step)
        # a step applies in its own row, despite rounding
        times = np.where(np.abs(in_row - times) < 1e-9, in_row, times)
        duty, angle = (np.interp(time, times, values) for values in (duties, angles))
        if w:
            angle = np.where(time >= test.lead, test.amplitude * np.sin(w * (time - test.lead)), 0.0)
        servo_duty = bench.servo_neutral + np.radians(angle) / bench.servo_slope
        runs.append(Recording(label, time, duty, servo_duty, np.full(time.size, height), low_pass=test.low_pass))
    return runs


def runs_of(protocol: Protocol, name: str, seed: int) -> list[Recording]:
    """Return the runs of a test with random variation, reproducible by the seed."""
    file, test, runs = protocol.file, getattr(protocol.file.tests, name), []
    number = list(type(file.tests).model_fields).index(name)
    for k, run in enumerate(commands(test, protocol.bench, file.step)):
        for repetition in range(test.repetitions):
            rng = np.random.default_rng([seed, number, k, repetition])
            thrust = max(0.1, 1.0 + file.draws.thrust * rng.standard_normal())
            label = f"{name}{run.label}, repetition {repetition + 1}"
            runs.append(replace(run, label=label, thrust=thrust, noise=_noise(protocol, rng, run.time.size)))
    return runs


def _noise(protocol: Protocol, rng: np.random.Generator, rows: int, *, tare: bool = True) -> Array:
    draws = protocol.file.draws
    drift = np.array([draws.tare.get(c, 0.0) for c in CELL_UNITS]) * rng.standard_normal(3) * tare
    spread = np.array([draws.noise.get(c, 0.0) for c in CELL_UNITS])
    return np.asarray(drift[:, None] + spread[:, None] * rng.standard_normal((3, rows)))


def load_runs(protocol: Protocol, seed: int) -> dict[str, list[Recording]]:
    """Return cell → calibration runs, one per load, with random errors of the loads."""
    by_channel, step = dict[str, list[Recording]](), protocol.file.step
    time = np.asarray(step * np.arange(round(LOAD_TIME / step) + 1), dtype=np.float64)
    duty, servo_duty, height = (np.full_like(time, value) for value in (REST_DUTY, NEUTRAL_DUTY, FREE_HEIGHT))
    for place, channel in enumerate(CELL_UNITS):
        cell, rng = protocol.file.cells[channel], np.random.default_rng([seed, 100 + place])
        to_si, runs = protocol.load_in_si(channel), by_channel.setdefault(channel, [])
        off = cell.error * cell.full_scale * rng.standard_normal(len(cell.loads)) * (np.array(cell.loads) != 0)
        for load, e in zip(cell.loads, off, strict=True):
            noise = _noise(protocol, rng, time.size, tare=False)
            loads = tuple((load + e) * to_si * (c == channel) for c in CELL_UNITS)
            label = f"load {load:g} {cell.unit}"
            runs.append(Recording(label, time, duty, servo_duty, height, loads=loads, noise=noise))
    return by_channel


def play(bench: Bench, runs: Sequence[Recording], progress: Callable[[int], None] | None = None) -> list[Recording]:
    """Simulate runs on a bench; runs with equal commands are computed together.

    Row k contains the reading at t_k and the command that acts from t_k on. Noise is added to the reading at the end of
    a step.

    Args:
        progress: Function that is called with the number of completed rows of all runs.
    """
    groups, played, rows = dict[tuple[Any, ...], list[int]](), dict[int, Recording](), 0
    for number, run in enumerate(runs):
        commands = run.duty.tobytes(), run.servo_duty.tobytes(), run.height.tobytes(), run.low_pass
        groups.setdefault(commands, []).append(number)
    for numbers in groups.values():
        lanes = [runs[number] for number in numbers]
        first, count = lanes[0], lanes[0].time.size
        thrust, noise = np.array([r.thrust for r in lanes]), np.stack([r.noise for r in lanes], axis=2)
        stepper = Stepper(bench.with_values({"thrust_factor": thrust, "filter_time": first.low_pass}), arrays())
        loads = np.array([r.loads for r in lanes]).T
        moment, volts = stepper.start(float(first.time[0])), np.empty((count, len(CELL_UNITS), len(lanes)))
        for k in range(count):
            before = max(k - 1, 0)
            held = float(first.duty[before]), float(first.servo_duty[before]), float(first.height[k])
            command = (*held, *loads, *noise[:, k])
            if k:
                moment = stepper.step(moment, command, first.step)
            volts[k] = stepper.output(moment.t, moment.state, command)[: len(CELL_UNITS)]
        for number, run, own in zip(numbers, lanes, np.moveaxis(volts, 2, 0), strict=True):
            played[number] = replace(run, volts=dict(zip(CELL_UNITS, np.ascontiguousarray(own.T), strict=True)))
        rows += count * len(lanes)
        if progress is not None:
            progress(rows)
    return [played[number] for number in range(len(runs))]


# -- measured recordings ------------------------------------------------------------------


def read_recording(path: Path) -> Recording:
    """Read a measured run with all bench columns; single missing rows of an even clock are filled in.

    Raises:
        InputError: The file has faults, all of which the error names.
    """
    log = read_log(path, COLUMNS, ())  # readings must be as complete as commands
    spacing, number = np.diff(log.time), log.grid
    row, step = int(np.argmax(spacing)) + 1, float(np.median(spacing))
    if spacing.max() > MAX_SPACING * step:
        text = f"the time step before this row is {spacing.max():.3g} s instead of {step:.3g} s"
        cure = f"resample to rows {step:.3g} s apart, with linear interpolation of volts and constant duties"
        raise InputError([Fault(path, log.header + row + 1, 1, f"{text}: {cure}")])
    whole = np.arange(number[-1] + 1)
    time, *volts = (np.interp(whole, number, v) for v in (log.time, *(log.inputs[q.name] for q in COLUMNS[3:])))
    before = np.searchsorted(number, whole, side="right") - 1
    duty, servo_duty, height = (log.inputs[q.name][before] for q in COLUMNS[:3])
    lines, by_cell = (log.header + 1 + before).tolist(), dict(zip(CELL_UNITS, volts, strict=True))
    return Recording(path.name, time, duty, servo_duty, height, by_cell, path=path, lines=lines)


# -- load cells ---------------------------------------------------------------------------

RAIL_STEPS = 1.5  # a reading within this many converter steps of the end of the range is saturated
MIN_CURVE_POINTS = 3  # points of a curve
RAIL_ERRORS = 3.0  # distance of a point from the rail in standard errors, so that chance selects no points


@dataclass(frozen=True)
class Cell:
    """Calibration points in SI, ordered by voltage; `error` is the standard deviation of each load.

    Attributes:
        saturated_loads: Loads with saturated readings.
    """

    loads: Array
    volts: Array
    error: float
    saturated_loads: tuple[float, ...] = ()
    smooth: bool = True

    @cached_property
    def curve(self) -> Any:
        """Return a function from voltage to load."""
        if self.smooth:
            middle = float(self.volts.mean())
            cubic = np.polyfit(self.volts - middle, self.loads, min(3, self.volts.size - 2))
            slope = np.polyval(np.polyder(cubic), np.linspace(self.volts[0], self.volts[-1], 101) - middle)
            if np.all(slope > 0) or np.all(slope < 0):
                return lambda v, order=0: np.polyval(np.polyder(cubic, order), np.asarray(v) - middle)
        return PchipInterpolator(self.volts, self.loads)

    @cached_property
    def zero(self) -> float:
        """Return the voltage at which the curve has zero load."""
        return float(self.volts_of(np.zeros(1), np.linspace(self.volts[0], self.volts[-1], 4001))[0])

    def volts_of(self, forces: Array, grid: Array) -> Array:
        """Return the voltages of forces, by interpolation between the voltages of a grid."""
        loads = self.force(grid)
        order = np.argsort(loads)
        return np.interp(forces, loads[order], grid[order])

    def force(self, volts: Array) -> Array:
        """Return force [N] or moment [N m] for voltages."""
        low, high = self.volts[0], self.volts[-1]
        slopes = self.curve([low, high], 1)
        inside = self.curve(np.clip(volts, low, high))
        return np.asarray(inside + slopes[0] * np.minimum(volts - low, 0.0) + slopes[1] * np.maximum(volts - high, 0.0))

    @property
    def cross_validation_errors(self) -> Array:
        """Return leave-one-out errors at the inner points."""
        errors = []
        for k in range(1, self.loads.size - 1):
            others = replace(self, loads=np.delete(self.loads, k), volts=np.delete(self.volts, k))
            errors.append(float(others.force(self.volts[k])) - self.loads[k])
        return np.array(errors)

    def as_json(self) -> dict[str, Any]:
        """Return the calibration for identify.json."""
        return {
            "loads": self.loads.tolist(),
            "volts": self.volts.tolist(),
            "error": self.error,
            "left_one_out": self.cross_validation_errors.tolist(),
            "at_the_rail": list(self.saturated_loads),
        }


Cells = Mapping[str, Cell]


def at_rail(bench: Bench, volts: Array, margin: Array | float = 0.0) -> Flags:
    """Return True for readings that are saturated, or closer to a limit of the converter than `margin` [V]."""
    least = np.maximum(RAIL_STEPS * bench.converter_range / bench.converter_levels, margin)
    result: Flags = (volts <= least) | (volts >= bench.converter_range - least)
    return result


def calibrate(protocol: Protocol, hung: Mapping[str, Sequence[Recording]]) -> dict[str, Cell]:
    """Calibrate the load cells by simulated loads or measured points, and return them by channel.

    Args:
        hung: Channel → recording of each load; not used for a cell with measured points.

    Raises:
        InputError: The unsaturated points of a cell are too few, or the voltage is not monotonic in the load.
    """
    cells, faults = {}, list[Fault]()
    for channel in CELL_UNITS:
        cell, unit, text = protocol.file.cells[channel], protocol.load_in_si(channel), ""
        points = cell.points
        if not points:
            hanging = zip(cell.loads, hung[channel], strict=True)
            points = [(load, float(r.volts[channel].mean())) for load, r in hanging]
        loads, volts = np.array([(load * unit, v) for load, v in points]).T
        error = cell.error * cell.full_scale * unit
        per_load = abs(float(np.ptp(volts))) / (float(np.ptp(loads)) or 1.0)
        margin = np.where(loads == 0, 0.0, RAIL_ERRORS * error * per_load)  # zero load is exact
        rail = at_rail(protocol.bench, volts, margin)
        order = np.argsort(volts[~rail])
        f, v = loads[~rail][order], volts[~rail][order]
        steps = np.diff(f)
        turns = (np.diff(v) <= 0) | (steps * (np.median(steps) if steps.size else 0.0) <= 0)
        if f.size < MIN_CURVE_POINTS:
            inside = (
                f"{f.size} of {loads.size} points are inside 0 to {protocol.bench.converter_range:g} V by their error"
            )
            text = f"{inside}; {MIN_CURVE_POINTS} are needed; measure more points, give volts, or `converter_range`"
        elif turns.any():
            low, high = v[np.argmax(turns)], v[np.argmax(turns) + 1]
            text = f"between {low:.4g} V and {high:.4g} V the load does not increase monotonically; measure again"
        if text:
            faults.append(protocol.yaml.fault(("cells", channel), text, key=True))
        cells[channel] = Cell(f, v, error, tuple(loads[rail].tolist()))
    refuse(faults)
    return cells
