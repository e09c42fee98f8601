"""Runs of a protocol and their recordings: simulated by an FMU, or measured."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.text import counted
from cosim.base.units import factor
from cosim.blocks.description import read_description
from cosim.blocks.fmu import RestartableFmu
from cosim.storage.table import DECIMAL_COMMA, Column, Faults, Use, read_table
from cosim.storage.yaml_file import did_you_mean
from plant.bench import FREE_HEIGHT, NEUTRAL_DUTY, REST_DUTY, Bench
from plant.identification import messages
from plant.identification.protocol import CHANNELS, HeightTest, Protocol, SineTest, Test

SECONDS = 1.0  # duration of a calibration load
SAME_STEP = 0.1  # share of a step by which an even clock varies
MAX_MISSING = 0.02  # largest share of single missing rows, which are interpolated
DEGREE = np.pi / 180.0
MAX_HEIGHT = 20.0  # [m]: twice the default height without ground effect, App. D.2; a height in mm or cm exceeds it


class BenchColumn(NamedTuple):
    """A column of a recording: unit, plausible range (`high` None: the bench's `converter_range`), and advice."""

    unit: str
    low: float
    high: float | None
    cure: str


DUTY = BenchColumn("%", 0.0, 100.0, f"write it in % of the frame, {messages.PULSE}")
VOLTS = BenchColumn("V", 0.0, None, "write raw voltages, say the unit, {name} [mV], or give `converter_range`")
COLUMNS = {
    "duty": DUTY,
    "servo_duty": DUTY,
    "height": BenchColumn("m", 0.0, MAX_HEIGHT, "say its unit, {name} [mm]; 20 m is as good as no ground"),
    **dict.fromkeys(("volts_z", "volts_x", "volts_m"), VOLTS),
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
    """Return label, time, duty, servo duty and height of each different run of a test."""
    if isinstance(test, SineTest):
        return [_sine(test, bench, step, *pair) for pair in zip(test.frequencies, test.periods, strict=True)]
    sets = [("", test.height, test.phases)]
    if isinstance(test, HeightTest):
        places = [test.free_height, *(h * bench.propeller_radius for h in test.heights)]
        sets = [(f" at {h:g} m", h, test.phases) for h in places]
        if test.validation_duty is not None:
            top = max(p[1] for p in test.phases)
            other = [(t, test.validation_duty if d == top else d, a) for t, d, a in test.phases]
            sets += [(f" at {h:g} m, validation", h, other) for h in places]
    return [(label, *_interpolate(phases, bench, step), height) for label, height, phases in sets]


def _interpolate(phases: Sequence[tuple[float, float, float]], bench: Bench, step: float) -> tuple[Array, Array, Array]:
    """Return times, duty and servo duty as straight lines between phases; two phases at one time make a step."""
    times, duty, angle = np.array(phases, float).T
    time = step * np.arange(round(times[-1] / step) + 1)
    k = np.clip(np.searchsorted(times, time + 1e-9, side="right") - 1, 0, times.size - 2)
    gap = times[k + 1] - times[k]
    share = np.clip(np.divide(time - times[k], gap, out=np.ones_like(time), where=gap > 0), 0.0, 1.0)
    duty, angle = (v[k] + share * (v[k + 1] - v[k]) for v in (duty, angle))
    return time, duty, bench.servo_neutral + angle * DEGREE / bench.servo_slope


def _sine(
    test: SineTest, bench: Bench, step: float, w: float, periods: float
) -> tuple[str, Array, Array, Array, float]:
    end = test.lead + max(2.0 * np.pi * periods / w, test.skip + 1.0)
    time = np.asarray(step * np.arange(round(end / step) + 1), dtype=np.float64)
    duty: Array = np.interp(time, [1.0 / 3.0 * test.lead, 2.0 / 3.0 * test.lead], [REST_DUTY, test.duty])
    angle = np.where(time >= test.lead, test.amplitude * np.sin(w * (time - test.lead)), 0.0)
    return f" at {w:g} rad/s", time, duty, bench.servo_neutral + angle * DEGREE / bench.servo_slope, test.height


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
    time = np.asarray(file.step * np.arange(round(SECONDS / file.step) + 1), dtype=np.float64)
    at_rest = np.full_like(time, REST_DUTY), np.full_like(time, NEUTRAL_DUTY)
    for place, channel in enumerate(CHANNELS):
        cell, rng = file.cells[channel], np.random.default_rng([seed, 100 + place])
        to_si = load_in_si(protocol, channel)
        off = cell.error * cell.full_scale * rng.standard_normal(len(cell.loads)) * (np.array(cell.loads) != 0)
        by_channel[channel] = []
        for load, e in zip(cell.loads, off, strict=True):
            noise = _noise(protocol, rng, time.size, tare=False)
            loads = tuple((load + e) * to_si * (c == channel) for c in CHANNELS)
            by_channel[channel].append(
                SimulatedRecording(f"load {load:g} {cell.unit}", time, *at_rest, FREE_HEIGHT, 0.0, noise, loads)
            )
    return by_channel


def load_in_si(protocol: Protocol, channel: str) -> float:
    """Return the load unit of a cell in N or N m; a gram-force is converted with the bench's gravity."""
    unit = protocol.file.cells[channel].unit
    gravity = protocol.bench.gravity / 9.80665 if unit == "gf" else 1.0
    return (factor(unit, CHANNELS[channel]) or 1.0) * gravity


# -- simulation ---------------------------------------------------------------------------


def to_recording(run: SimulatedRecording, volts: Array) -> Recording:
    """Return a run with its voltages, shape (rows, cells)."""
    by_cell = dict(zip(CHANNELS, np.ascontiguousarray(volts.T), strict=True))
    return Recording(run.label, run.time, run.duty, run.servo_duty, np.full(run.time.size, run.height), by_cell)


class FmuPlayer:
    """Player that simulates runs of the tests on an FMU with the bench's variables."""

    def __init__(
        self, fmu: Path, parameters: Mapping[str, float], progress: Callable[[int], None] | None = None
    ) -> None:
        self.parameters, self.progress, self.steps = dict(parameters), progress, 0
        self.block = RestartableFmu("bench", fmu, read_description(fmu), {}, frozenset(q.name for q in Bench.inputs))
        inputs, outputs = [s.name for s in self.block.inputs], [s.name for s in self.block.outputs]
        own, names = [q.name for q in Bench.inputs], ", ".join(inputs + outputs)
        missing = [n for n in (*own, *(f"volts_{c}" for c in CHANNELS)) if n not in (*inputs, *outputs)]
        refuse(Fault(fmu, 0, 0, messages.NO_BENCH(name=n, names=names)) for n in missing)
        self.order = [own.index(n) for n in inputs]
        self.read = [len(inputs) + outputs.index(f"volts_{c}") for c in CHANNELS]
        self.row = (ctypes.c_double * (len(inputs) + len(outputs)))()
        self.block.bind(self.row, 0)

    def __call__(self, runs: Sequence[SimulatedRecording]) -> list[Recording]:
        """Simulate runs one after another."""
        return [self._play(run) for run in runs]

    def _play(self, run: SimulatedRecording) -> Recording:
        """Simulate a run; row k has the reading at t_k and the command from t_k.

        The noise belongs to the reading at the end of a step.
        """
        block, time = self.block, run.time
        own = {"thrust_factor": run.thrust, "filter_time": run.low_pass}
        block.begin({**self.parameters, **own}, float(time[0]), float(time[-1]))
        table = _inputs(run)[:, self.order]
        volts = np.empty((time.size, 3))
        count = len(self.order)
        self.row[:count] = table[0].tolist()
        block.put()
        block.get()
        block.start()
        volts[0] = [self.row[k] for k in self.read]
        step = float(np.median(np.diff(time)))
        for k, command in enumerate(table[1:].tolist()):
            self.row[:count] = command
            block.put()
            block.advance(float(time[k]), step)
            block.get()
            volts[k + 1] = [self.row[j] for j in self.read]
        self.steps += time.size
        if self.progress is not None:
            self.progress(self.steps)
        return to_recording(run, volts)

    def close(self) -> None:
        """Free the FMU."""
        self.block.close()


def _inputs(run: SimulatedRecording) -> Array:
    """Return the inputs of the FMU by row: row k holds the inputs, with reading noise, of the step that ends at t_k."""
    before = np.maximum(np.arange(run.time.size) - 1, 0)
    same = np.ones(run.time.size)
    return np.column_stack(
        (run.duty[before], run.servo_duty[before], run.height * same, *(load * same for load in run.loads), *run.noise)
    )


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
            raise InputError([Fault(path, faults.header + 1, 1, messages.DECIMAL_COMMAS())])
        wanted = "s" if name == "time" else COLUMNS[name].unit
        if (scale := factor(unit, wanted)) is None:
            if name == "time":
                message = messages.NO_UNIT_OF_TIME(unit=unit)
            elif wanted == "%" and factor(unit, "s"):
                message = messages.TIME_FOR_DUTY(unit=unit, column=name)
            else:
                message = messages.NO_UNIT_OF_COLUMN(unit=unit, column=name, wanted=wanted)
            faults.note(faults.header, column.cell, message)
        return Use(name, scale or 1.0, role="the time" if name == "time" else "a column of the bench")

    table = read_table(faults, choose, ", ".join(COLUMNS))
    if table is not None and not table.faults:
        for name in (n for n in COLUMNS if n not in table):
            hint = did_you_mean(name, table.by_name)
            faults.note(table.header, 1, messages.NO_COLUMN(name=name, unit=COLUMNS[name].unit, hint=hint))
        if table.rows < 10:
            faults.note(0, 0, messages.SHORT_RECORDING(rows=counted(table.rows, "row")))
    faults.raise_any()
    assert table is not None
    time, lines = table["time"], np.array(table.lines)
    values = np.column_stack([table[name] for name in COLUMNS])
    time, values, lines = _fill_single_rows(time, values, lines)
    gaps = np.diff(time)
    if gaps.max() > 1.5 * np.median(gaps):
        row, step = int(np.argmax(gaps)) + 1, float(np.median(gaps))
        raise InputError([Fault(path, int(lines[row]), 1, messages.UNEVEN_CLOCK(gap=gaps.max(), step=step))])
    duty, servo_duty, height, *volts = np.ascontiguousarray(values.T)
    by_cell = dict(zip(CHANNELS, volts, strict=True))
    return Recording(path.name, time, duty, servo_duty, height, by_cell, path, lines)


def _fill_single_rows(time: Array, values: Array, lines: Array) -> tuple[Array, Array, Array]:
    """Return rows with single gaps filled."""
    gaps = np.diff(time)
    step = float(np.median(gaps))
    missing = np.flatnonzero(np.abs(gaps - 2.0 * step) < SAME_STEP * step)
    even = np.abs(np.delete(gaps, missing) - step) < SAME_STEP * step
    if not missing.size or not even.all() or missing.size > MAX_MISSING * time.size:
        return time, values, lines
    middle = values[missing].copy()
    cells = [name.startswith("volts_") for name in COLUMNS]
    middle[:, cells] = 0.5 * (values[missing] + values[missing + 1])[:, cells]
    after = missing + 1
    return (
        np.insert(time, after, 0.5 * (time[missing] + time[after])),
        np.insert(values, after, middle, axis=0),
        np.insert(lines, after, lines[after]),
    )


def read_recordings(protocol: Protocol, name: str) -> tuple[list[Recording], list[Fault]]:
    """Return a test's readable recordings, and the others' faults."""
    faults: list[Fault] = []
    recordings = []
    for text in getattr(protocol.file.tests, name).files:
        try:
            recordings.append(read_recording(protocol.folder / text))
        except InputError as error:
            faults += error.faults
    return recordings, faults
