"""Runs of a protocol and their recordings: simulated by an FMU, or measured."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cosim.blocks.fmu import RestartableFmu
from cosim.core.arrays import Array, Flags
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.text import counted
from cosim.core.units import factor
from cosim.files.table import DECIMAL_COMMA, Column, Faults, Use, read_table
from cosim.files.yaml_file import did_you_mean
from cosim.fmi.description import read_description
from plant.bench import FREE_HEIGHT, NEUTRAL_DUTY, REST_DUTY, Bench
from plant.identification.protocol import CHANNELS, HeightTest, Protocol, SineTest, Test

LOAD_TIME = 1.0  # [s] duration of a calibration load
SAME_STEP = 0.1  # share of a step by which an even clock varies
MAX_MISSING = 0.02  # largest share of single missing rows, which are interpolated
COLUMNS = {  # column of a recording → unit
    **{"duty": "%", "servo_duty": "%", "height": "m"},
    **dict.fromkeys(("volts_z", "volts_x", "volts_m"), "V"),
}


@dataclass(frozen=True)
class SimulatedRecording:
    """A run to simulate; `noise` has a row per cell and a value per reading, `thrust` is a factor on the thrust."""

    label: str
    time: Array
    duty: Array
    servo_duty: Array
    height: float
    low_pass: float
    noise: Array
    loads: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust: float = 1.0


@dataclass(frozen=True)
class Recording:
    """A recorded run: held commands and voltages by cell; `path` and `lines` (of the rows) for a measured run."""

    label: str
    time: Array
    duty: Array
    servo_duty: Array
    height: Array
    volts: Mapping[str, Array]
    path: Path | None = None
    lines: Array = field(default_factory=lambda: np.empty(0))

    @property
    def step(self) -> float:
        """Return the median step [s]."""
        return float(np.median(np.diff(self.time)))

    def rows(self, window: tuple[float, float]) -> Flags:
        """Return the rows within a time window."""
        slack = 1e-6 * self.step
        rows: Flags = (self.time >= window[0] - slack) & (self.time <= window[1] + slack)
        return rows


# -- commands of a protocol ---------------------------------------------------------------


def commands(test: Test, bench: Bench, step: float) -> list[tuple[str, Array, Array, Array, float]]:
    """Return label, time, duty, servo duty and height of each different run of a test.

    Commands are straight lines between phases; two phases at one time make a step.
    """
    runs = list[tuple[str, Array, Array, Array, float]]()
    if isinstance(test, SineTest):
        for w, periods in zip(test.frequencies, test.periods, strict=True):
            end = test.lead + max(2.0 * np.pi * periods / w, test.skip + 1.0)
            time = np.asarray(step * np.arange(round(end / step) + 1), dtype=np.float64)
            duty: Array = np.interp(time, [1.0 / 3.0 * test.lead, 2.0 / 3.0 * test.lead], [REST_DUTY, test.duty])
            angle = np.where(time >= test.lead, test.amplitude * np.sin(w * (time - test.lead)), 0.0)
            runs.append((f" at {w:g} rad/s", time, duty, _servo_duty(bench, angle), test.height))
        return runs
    sets = [("", test.height, test.phases)]
    if isinstance(test, HeightTest):
        places = [test.free_height, *(h * bench.propeller_radius for h in test.heights)]
        sets = [(f" at {h:g} m", h, test.phases) for h in places]
        if test.validation_duty is not None:
            top = max(p[1] for p in test.phases)
            other = [(t, test.validation_duty if d == top else d, a) for t, d, a in test.phases]
            sets += [(f" at {h:g} m, validation", h, other) for h in places]
    for label, height, phases in sets:
        times, duties, angles = np.array(phases, float).T
        time = step * np.arange(round(times[-1] / step) + 1)
        k = np.clip(np.searchsorted(times, time + 1e-9, side="right") - 1, 0, times.size - 2)
        gap = times[k + 1] - times[k]
        share = np.clip(np.divide(time - times[k], gap, out=np.ones_like(time), where=gap > 0), 0.0, 1.0)
        duty, angle = (v[k] + share * (v[k + 1] - v[k]) for v in (duties, angles))
        runs.append((label, time, duty, _servo_duty(bench, angle), height))
    return runs


def _servo_duty(bench: Bench, angle: Array) -> Array:
    """Return the duty of the servo for a tilt [°]."""
    return bench.servo_neutral + angle * (np.pi / 180.0) / bench.servo_slope


def runs_of(protocol: Protocol, name: str, seed: int) -> list[SimulatedRecording]:
    """Return the runs of a test with random variation, reproducible by the seed."""
    file, runs = protocol.file, []
    number = list(type(file.tests).model_fields).index(name)
    test = getattr(file.tests, name)
    for k, (label, time, duty, servo_duty, height) in enumerate(commands(test, protocol.bench, file.step)):
        for repetition in range(test.repetitions):
            rng = np.random.default_rng([seed, number, k, repetition])
            thrust = max(0.1, 1.0 + file.draws.thrust * rng.standard_normal())
            noise = _noise(protocol, rng, time.size)
            name_of_run = f"{name}{label}, repetition {repetition + 1}"
            runs.append(
                SimulatedRecording(name_of_run, time, duty, servo_duty, height, test.low_pass, noise, thrust=thrust)
            )
    return runs


def _noise(protocol: Protocol, rng: np.random.Generator, rows: int, *, tare: bool = True) -> Array:
    draws = protocol.file.draws
    drift = np.array([draws.tare.get(c, 0.0) for c in CHANNELS]) * rng.standard_normal(3) * tare
    spread = np.array([draws.noise.get(c, 0.0) for c in CHANNELS])
    return np.asarray(drift[:, None] + spread[:, None] * rng.standard_normal((3, rows)))


def load_runs(protocol: Protocol, seed: int) -> dict[str, list[SimulatedRecording]]:
    """Return for each cell the calibration runs, one per load, with random errors of the loads."""
    file, by_channel = protocol.file, dict[str, list[SimulatedRecording]]()
    time = np.asarray(file.step * np.arange(round(LOAD_TIME / file.step) + 1), dtype=np.float64)
    at_rest = np.full_like(time, REST_DUTY), np.full_like(time, NEUTRAL_DUTY)
    for place, channel in enumerate(CHANNELS):
        cell, rng = file.cells[channel], np.random.default_rng([seed, 100 + place])
        to_si = protocol.load_in_si(channel)
        off = cell.error * cell.full_scale * rng.standard_normal(len(cell.loads)) * (np.array(cell.loads) != 0)
        by_channel[channel] = []
        for load, e in zip(cell.loads, off, strict=True):
            noise = _noise(protocol, rng, time.size, tare=False)
            loads = tuple((load + e) * to_si * (c == channel) for c in CHANNELS)
            by_channel[channel].append(
                SimulatedRecording(f"load {load:g} {cell.unit}", time, *at_rest, FREE_HEIGHT, 0.0, noise, loads)
            )
    return by_channel


# -- simulation ---------------------------------------------------------------------------


def to_recording(run: SimulatedRecording, volts: Array) -> Recording:
    """Return a run with its voltages, shape (rows, cells)."""
    by_cell = dict(zip(CHANNELS, np.ascontiguousarray(volts.T), strict=True))
    return Recording(run.label, run.time, run.duty, run.servo_duty, np.full(run.time.size, run.height), by_cell)


def play_on_fmu(
    fmu: Path,
    parameters: Mapping[str, float],
    runs: Sequence[SimulatedRecording],
    progress: Callable[[int], None] | None = None,
) -> list[Recording]:
    """Simulate runs one after another on an FMU with the bench's variables.

    Row k has the reading at t_k and the command from t_k. The noise belongs to the reading at the end of a step.

    Args:
        progress: Function of the completed rows of all runs.
    """
    own = [q.name for q in Bench.inputs]
    block = RestartableFmu("bench", fmu, read_description(fmu), {}, frozenset(own))
    try:
        inputs, outputs = [s.name for s in block.inputs], [s.name for s in block.outputs]
        names = ", ".join(inputs + outputs)
        needed = (*own, *(f"volts_{c}" for c in CHANNELS))
        missing = [n for n in needed if n not in (*inputs, *outputs)]
        refuse(Fault(fmu, 0, 0, f'is no bench: it lacks "{n}"; it has {names}') for n in missing)
        order, count = [own.index(n) for n in inputs], len(inputs)
        read = [count + outputs.index(f"volts_{c}") for c in CHANNELS]
        row = (ctypes.c_double * (count + len(outputs)))()
        block.bind(row, 0)
        recordings, rows = [], 0
        for run in runs:
            time = run.time
            step, begin, end = float(np.median(np.diff(time))), float(time[0]), float(time[-1])
            block.begin({**parameters, "thrust_factor": run.thrust, "filter_time": run.low_pass}, begin, end)
            # row k holds the inputs, with reading noise, of the step that ends at t_k
            before, same = np.maximum(np.arange(time.size) - 1, 0), np.ones(time.size)
            loads = (load * same for load in run.loads)
            commanded = (run.duty[before], run.servo_duty[before], run.height * same, *loads, *run.noise)
            table = np.column_stack(commanded)[:, order]
            volts = np.empty((time.size, 3))
            row[:count] = table[0].tolist()
            block.put()
            block.get()
            block.start()
            volts[0] = [row[k] for k in read]
            for k, command in enumerate(table[1:].tolist()):
                row[:count] = command
                block.put()
                block.advance(float(time[k]), step)
                block.get()
                volts[k + 1] = [row[j] for j in read]
            recordings.append(to_recording(run, volts))
            rows += time.size
            if progress is not None:
                progress(rows)
        return recordings
    finally:
        block.close()


# -- measured recordings ------------------------------------------------------------------


def read_recording(path: Path) -> Recording:
    """Read a measured run with all bench columns.

    Raises:
        InputError: Every fault of the file.
    """
    faults = Faults(path)

    def choose(column: Column) -> Use | None:
        name, unit = column.name, column.unit
        if name != "time" and name not in COLUMNS:
            return None
        if not column.numeric and any(DECIMAL_COMMA.fullmatch(str(cell).strip()) for cell in column.values):
            # The cause of all other faults.
            text = "numbers have decimal commas; write decimals with a point, and separate cells with commas"
            raise InputError([Fault(path, faults.header + 1, 1, text)])
        wanted = COLUMNS.get(name, "s")
        if (scale := factor(unit, wanted)) is None:
            example = ", such as 7.5 for a pulse of 1500 µs in a frame of 20 ms" if wanted == "%" else ""
            faults.note(
                faults.header, column.cell, f"{unit} is no unit of {name} [{wanted}]; give it in {wanted}{example}"
            )
        return Use(name, scale or 1.0, role="the time" if name == "time" else "a column of the bench")

    table = read_table(faults, choose, ", ".join(COLUMNS))
    if table is not None and not table.faults:
        for name in (n for n in COLUMNS if n not in table):
            text = f'column "{name}" [{COLUMNS[name]}] is missing{did_you_mean(name, table.by_name)}; add it'
            faults.note(table.header, 1, text)
        if table.rows < 10:
            faults.note(0, 0, f"holds {counted(table.rows, 'row')}; a run has ten at least; record it anew")
    faults.raise_any()
    assert table is not None
    time, lines = table["time"], np.array(table.lines)
    values = np.column_stack([table[name] for name in COLUMNS])
    gaps = np.diff(time)
    step = float(np.median(gaps))
    missing = np.flatnonzero(np.abs(gaps - 2.0 * step) < SAME_STEP * step)
    even = np.abs(np.delete(gaps, missing) - step) < SAME_STEP * step
    if missing.size and even.all() and missing.size <= MAX_MISSING * time.size:  # fill single missing rows
        middle, after = values[missing].copy(), missing + 1
        cells = [name.startswith("volts_") for name in COLUMNS]
        middle[:, cells] = 0.5 * (values[missing] + values[after])[:, cells]
        time = np.insert(time, after, 0.5 * (time[missing] + time[after]))
        values, lines = np.insert(values, after, middle, axis=0), np.insert(lines, after, lines[after])
        gaps = np.diff(time)
    if gaps.max() > 1.5 * np.median(gaps):
        row, step = int(np.argmax(gaps)) + 1, float(np.median(gaps))
        text = f"{gaps.max():.3g} s pass before this row, {step:.3g} s before others; rows are missing, or the clock is"
        cure = f"resample to rows {step:.3g} s apart, volts by straight lines, duties held"
        raise InputError([Fault(path, int(lines[row]), 1, f"{text} uneven: {cure}")])
    duty, servo_duty, height, *volts = np.ascontiguousarray(values.T)
    by_cell = dict(zip(CHANNELS, volts, strict=True))
    return Recording(path.name, time, duty, servo_duty, height, by_cell, path, lines)
