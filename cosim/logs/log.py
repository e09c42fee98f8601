"""Measured logs from CSV files with `time` and the model's inputs and outputs, and the noise of their channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, pairwise, permutations
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from cosim.blocks.component import Signal
from cosim.core.arrays import Array, NamedArrays, NamedValues, Rows
from cosim.core.errors import Fault, refuse
from cosim.core.settings import Given, normalize_settings
from cosim.core.text import closest, did_you_mean
from cosim.core.units import Conversion, alternatives, assume_si, conversion
from cosim.files.table import Column, Faults, Table, Use, read_table
from cosim.files.yaml_file import short
from cosim.model.quantities import Quantity

FAST, USUAL = 0.001, 0.05  # [s] row spacings between which checks use fixed times; see `slowness`
GAP = 0.5  # [s] without a row; shorter holes are dropouts
MIN_PAUSE_ROWS = 10  # least number of rows lost in a pause
USUALLY = 3.0  # multiple of the usual measurement spacing beyond which a pause begins
INVALID_SIZE_RATIO = 1e6  # multiple of a column's usual size beyond which a value is invalid
ORDINARY = 1e9  # size in any SI unit up to which a mostly resting column may jump
MAX_VALID_SIZE = 1e30  # size in any SI unit beyond which every value is invalid
FULL_TURN = 2.0 * math.pi
MIN_NAME_SIMILARITY = 0.85  # similarity of two names for a suggestion; prefixes of loggers resemble much
HINTS, SHOWN = 50, 40  # columns with a suggestion, and names in a message
DRIFT = 2.0  # steps by which the last row of a log may be off before rows count as missing
STEP_PERCENTILE = 5.0  # percentile of the spacings of an irregular clock [%]
MISSING_ROW_STEPS = 1.5  # steps between rows from which a row is missing
MAX_INTERPOLATION_ERROR = 0.5  # share of the error of holding up to which interpolation is the better guess
SENSOR_FINDING = "sensors"  # kind of a finding on claimed errors of sensors
NORMAL_95 = 1.96  # 95 % limits of a normal distribution, in standard deviations
MAX_NEIGHBOUR_SPAN = 1.5  # multiple of the usual span of five readings beyond which readings are no neighbours
Severity = Literal["note", "warning", "fault"]


@dataclass(frozen=True, eq=False)
class Log:
    """Commands and measurements in the units of the model.

    Row k contains the measurements at `time[k]` and the command until `time[k + 1]`.

    Attributes:
        time: Increasing times [s], shape (rows,).
        inputs: Name → values, shape (rows,), none missing.
        outputs: Name → values, shape (rows,), NaN without a measurement.
        units: Name → unit of the values: the model's unit, or else the SI unit for the header's unit.
        written: Name → unit in the header, "" without one.
        undeclared: Signal with a unit in the header but not in the model → message.
        assumed: Sentences on the assumptions made when the file was read.
        step: Typical time between rows [s], see `usual_step`.
        unwrapped: Angle → times [s] at which jumps by a turn were removed.
        header: Line of the column names in the file.
        called: Name in the file → name in the model, if they differ.
        unread: Column that is not a signal of the model → suggested name, or "".
    """

    path: Path
    time: Array
    inputs: NamedArrays
    outputs: NamedArrays
    units: Mapping[str, str]
    step: float
    written: Mapping[str, str]
    unwrapped: Mapping[str, tuple[float, ...]]
    header: int = 1
    unread: Mapping[str, str] = field(default_factory=dict)
    called: Mapping[str, str] = field(default_factory=dict)
    undeclared: Mapping[str, str] = field(default_factory=dict)
    cells: Mapping[str, int] = field(default_factory=dict)  # column in the header by signal, from 1
    assumed: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return self.time.size

    @property
    def slowness(self) -> float:
        """Return the factor on the durations that checks use; see the function `slowness`."""
        return slowness(self.step)

    @property
    def pause(self) -> float:
        """Return the duration [s] above which missing rows are a pause, after which inputs and state are unknown."""
        return max(GAP, MIN_PAUSE_ROWS * self.step)

    @cached_property
    def grid(self) -> Rows:
        """Return the index of each row in equal steps; 0, 1, 2 … without missing rows."""
        number = np.arange(self.rows)
        ahead = (self.time - self.time[0]) / self.step - number
        if self.rows < 2 or (abs(ahead[-1]) < DRIFT and not np.any(np.diff(self.time) > MISSING_ROW_STEPS * self.step)):
            return number
        missing = np.rint(ahead).astype(np.intp)
        # those that this and all later rows lack: a single late row does not count
        return number + np.maximum(0, np.minimum.accumulate(missing[::-1])[::-1])


@dataclass(frozen=True)
class Finding:
    """A finding on a log.

    Attributes:
        severity: A fault makes the log unusable; a warning or a note does not.
        kind: Kind of finding, one word, for programs.
        channel: "time", a column, or "" for the whole log.
        numbers: Name → number in the sentence.
    """

    severity: Severity
    kind: str
    channel: str
    sentence: str
    numbers: NamedValues = field(default_factory=dict)

    @property
    def whole(self) -> str:
        """Return the sentence, preceded by the channel if the finding concerns a column."""
        return self.sentence if self.channel in ("", "time") else f"{self.channel} {self.sentence}"

    @property
    def line(self) -> str:
        """Return the sentence with channel and severity, as a line of output."""
        return f"{self.severity}: {self.whole}"


def rename_signals(log: Log, names: Mapping[str, str]) -> Log:
    """Return a log with renamed signals; signals without an entry keep their names."""
    groups = ("inputs", "outputs", "units", "written", "unwrapped", "undeclared", "cells")
    changed: dict[str, Any] = {g: {names.get(n, n): v for n, v in getattr(log, g).items()} for g in groups}
    return replace(log, called={n: names.get(v, v) for n, v in log.called.items()}, **changed)


def read_log(
    path: Path,
    inputs: Sequence[Signal | Quantity],
    outputs: Sequence[Signal | Quantity],
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
    alone: bool = False,
    declare: Callable[[Column, Faults], str | None] | None = None,
) -> Log:
    """Read a log with the signals of a model.

    Args:
        inputs, outputs: Signals of the model; the log must contain every input and at least one output.
        columns: Name in the file → name in the model, or `time`, if they differ.
        alone: True if `columns` is for this file only, so that a missing column is a fault.
        declare: For a log without a model: function that returns the unit of a column, or None to ignore the column.

    Raises:
        InputError: The file has faults; the error names all of them.
    """
    units = {s.name: s.unit for s in (*inputs, *outputs)}  # units of the values after reading
    into = [s.name for s in inputs]
    signals = [s for s in (*inputs, *outputs) if isinstance(s, Signal)]
    differences = {s.name for s in signals if s.relative}
    definitions = {s.unit: s.definition for s in signals if s.definition is not None}
    faults, unread, undeclared, cells = Faults(path), dict[str, str](), dict[str, str](), dict[str, int]()

    def use(column: Column) -> Use | None:
        """Return the conversion of a column to the model's unit, None for unread columns."""
        is_time, name = column.name == "time", columns.get(column.name, column.name)
        written = name if declare else column.name
        cells.setdefault(written, column.cell)
        if declare and not is_time:
            if (declared := declare(replace(column, name=name), faults)) is None:
                return None
            units[name] = declared
        if not is_time and name not in units:
            unread[written] = ""
            return None
        role = "the time" if is_time else "an input" if name in into else ""
        wanted = "s" if is_time else units[name]
        if column.unit and not wanted:
            assumed = assume_si(column.unit)
            units[name] = assumed.unit
            if assumed.sentence:
                undeclared[name] = assumed.sentence
            return Use(name, assumed.factor, assumed.offset, role)
        by = conversion(column.unit, wanted, difference=name in differences, definitions=definitions)
        if by is None:
            known = ", ".join(alternatives(wanted))
            message = f'the unit "{column.unit}" does not fit {name} [{wanted}]; known units: {known}'
            faults.note(faults.header, column.cell, message)
        by = by or Conversion()
        return Use(name, by.factor, by.offset, role)

    def check_header(table: Table) -> None:
        """Record faults of missing inputs and outputs."""
        line, outputs = table.header, [name for name in units if name not in into]
        for column, name in columns.items():
            if name not in (*units, "time"):
                cure = f"{did_you_mean(name, units)} (it has {name_list(units)})"
                faults.note(line, 1, f'column "{column}" is assigned to {name}, which the model does not have{cure}')
            elif name != "time" and column not in cells and (alone or name not in table):
                faults.note(line, 1, f'has no column "{column}"{did_you_mean(column, cells)} for {name}')
        missing = [name for name in into if name not in table]
        cure = "if columns have other names, use --column COLUMN=VARIABLE, or `columns` in a study"
        for name in missing:
            alike = closest(name, unread)
            fault = (
                f'"{alike}" is not a signal of the model; did you mean "{name}"?'
                if alike
                else f'input "{name}" is missing;'
            )
            every = f"a log needs every input of the model: {name_list(into)}; {cure}"
            faults.note(line, cells.get(alike, 1), f"{fault} {every}")
        if outputs and not missing and not any(name in table for name in outputs):
            message = f"has no output of the model; it needs at least one of {name_list(outputs)}; {cure}"
            message += "".join(
                dict.fromkeys(f'; did you mean "{close}"?' for w in unread if (close := closest(w, outputs)))
            )
            faults.note(line, 1, message)

    times = [column for column, name in columns.items() if name == "time"]
    table = read_table(faults, use, "inputs and outputs", names=frozenset((*units, *columns)), times=times)
    if table is not None:
        missing = [name for name in units if name not in table]
        for written in islice(unread, HINTS):
            close = closest(written, missing, MIN_NAME_SIMILARITY) or closest(
                written.rpartition(".")[2], missing, MIN_NAME_SIMILARITY
            )
            unread[written] = f'; did you mean "{close}"?' if close else ""
        if declare is None:
            check_header(table)
        elif len(cells) < 2:
            faults.note(table.header, 1, "has no column besides the time; a log needs inputs and measured outputs")
        if not table.faults:
            _check_values(table, faults, {"time", *into})
    faults.raise_any()
    assert table is not None
    read = {name: table[name] for name in table.by_name}
    time = read.pop("time")
    measured = {n: values for n, values in read.items() if n not in into}
    unwrapped = dict[str, tuple[float, ...]]()
    for name in [name for name in measured if units[name] == "rad"]:
        rows = np.flatnonzero(np.isfinite(measured[name]))
        values = measured[name][rows]
        jumps = rows[1:][np.abs(np.diff(values)) > math.pi]
        if jumps.size and np.ptp(values) <= 1.02 * FULL_TURN:  # An angle that spans more than a turn is unchanged.
            measured[name] = measured[name].copy()
            measured[name][rows] = np.unwrap(values)
            unwrapped[name] = tuple(time[jumps].tolist())
    return Log(
        path,
        time,
        {name: read[name] for name in into},
        measured,
        {n: units[n] for n in read},
        usual_step(time),
        {column.name: column.unit for column in table.columns},
        unwrapped,
        table.header,
        unread,
        dict(columns),
        undeclared,
        {column.name: column.cell for column in table.columns},
        table.assumed,
    )


def _check_values(table: Table, faults: Faults, complete: Container[str]) -> None:
    """Record faults of whole columns: too few rows, no measurements, impossible values.

    Args:
        complete: Columns that must have a value in every row.
    """
    if table.rows < 2 and not faults.faulty:
        count = "no row" if table.rows == 0 else "one row"
        message = f"has {count}; a log needs at least two rows, and some hundred for useful results"
        faults.note(table.header + 1, 1, message)
        return
    for name, column in table.by_name.items() if table.rows else ():
        if column.cell in faults.faulty:
            continue
        size, is_output = np.abs(table[name]), name not in complete
        if np.isnan(size).all():
            if is_output:
                message = f'column "{name}" has no value (NaN in every row); delete the column'
                faults.note(table.header, column.cell, message)
            continue
        # a logger may write 3.4e38 for `invalid`
        most = min(max(INVALID_SIZE_RATIO * float(np.nanmedian(size)), ORDINARY), MAX_VALID_SIZE)
        cure = "leave the cell empty" if is_output else "delete the row"

        def absurd(row: int, name: str = name, cure: str = cure) -> str:
            return (
                f"{name} is {table[name][row]:g} here, far beyond the other values; if it marks an invalid "
                f"reading, {cure}"
            )

        faults.note_cells(np.flatnonzero(size > most), table.lines, column.cell, absurd)


def read_column_names(columns: Given | None, log: Path) -> dict[str, str]:
    """Return column → name in the model, also from texts such as `measured_speed=motor.w` or `stamp=time`.

    Raises:
        InputError: A text has another form.
    """
    texts = normalize_settings(columns)
    if isinstance(texts, Mapping):
        return dict(texts)
    parts = [[part.strip() for part in text.partition("=")] for text in texts]
    refuse(
        Fault(
            log,
            0,
            0,
            f'--column "{short(text)}" does not have the form COLUMN=VARIABLE, such as measured_speed=motor.w',
        )
        for text, part in zip(texts, parts, strict=True)
        if not all(part)
    )
    return {column: name for column, _, name in parts}


def name_list(names: Collection[str]) -> str:
    """Return a list of names as text, shortened if there are many."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(islice(names, SHOWN)) + more


def usual_step(time: Array) -> float:
    """Return the typical row spacing [s]: the slope of a line through the times, with whole steps over gaps.

    With jittering time stamps, the median of differences is too inaccurate: an error of a thousandth adds up to whole
    rows at the end of a log. If slope and median differ by 2 %, the clock is irregular. If the median also misses the
    last row, the result is a low percentile of the differences, and longer differences are gaps.
    """
    apart = np.diff(time)
    median = float(np.median(apart))
    usual = apart < MISSING_ROW_STEPS * median
    number = np.concatenate([[0.0], np.cumsum(np.where(usual, 1.0, np.rint(apart / median)))])
    away = time - time[0] - median * number
    step = median
    if np.max(np.abs(away)) >= 1e-6 * median * time.size:
        slope = float(np.polyfit(number, time - time[0], 1)[0])
        if abs(slope - median) < 0.02 * median:
            step = slope
        elif abs(away[-1]) > DRIFT * median:
            step = float(np.percentile(apart, STEP_PERCENTILE))
    return float(f"{step:.9g}")


def slowness(step: float) -> float:
    """Return the factor that scales the time windows of checks to the step of a log [s].

    The factor is 1 for typical steps, larger for long steps and smaller for short ones. Windows such as 0.15 s or 1 s
    are too short for a tank logged every 0.5 s, and too long for a converter logged every 50 µs.
    """
    return min(1.0, step / FAST) if step < USUAL else max(1, math.ceil(step / USUAL - 0.1))


def first_rows(log: Log, count: int) -> Log:
    """Return the first rows of a log."""
    return log if log.rows <= count else _cut(log, slice(count))


def _cut(log: Log, rows: slice) -> Log:
    """Return some rows of a log, with the outputs measured in them."""
    outputs = {name: values[rows] for name, values in log.outputs.items() if not np.isnan(values[rows]).all()}
    inputs = {name: values[rows] for name, values in log.inputs.items()}
    return replace(log, time=log.time[rows], inputs=inputs, outputs=outputs)


def stretches(log: Log) -> list[Log]:
    """Return the parts of a log between pauses.

    In a pause, rows are missing (inputs and state are unknown) or measurements are missing (the state is unknown).
    Missing measurements are a pause only if the gap exceeds their typical spacing, so that a slow sensor does not cause
    pauses.
    """
    pieces: list[tuple[int, int]] = []
    for first, end in pairwise([0, *(np.flatnonzero(np.diff(log.time) > log.pause) + 1).tolist(), log.rows]):
        measured = [np.zeros(end - first, bool), *(np.isfinite(values[first:end]) for values in log.outputs.values())]
        rows = np.flatnonzero(np.any(measured, axis=0)) + first
        if not rows.size:
            pieces.append((first, end))
            continue
        intervals = np.diff(log.time[rows])
        limit = max(log.pause, USUALLY * float(np.median(intervals))) if intervals.size else log.pause
        edges = np.flatnonzero(intervals > limit)
        # Commands before the first and after the last measurement belong to the part, except after a pause.
        start = first if log.time[rows[0]] - log.time[first] <= limit else rows[0]
        stop = end if log.time[end - 1] - log.time[rows[-1]] <= limit else rows[-1] + 1
        pieces += zip([start, *rows[edges + 1].tolist()], [*(rows[edges] + 1).tolist(), stop], strict=True)
    return [log] if pieces == [(0, log.rows)] else [_cut(log, slice(*piece)) for piece in pieces]


def fill_holes(log: Log) -> Log:
    """Return the log with lost rows inserted if an input is smooth.

    Each input is held constant or interpolated; the method that predicts the existing rows better is used.
    """
    grid, smooth = log.grid, set[str]()
    whole = (np.diff(grid)[:-1] == 1) & (np.diff(grid)[1:] == 1)
    for name, values in log.inputs.items():
        first, middle, last = values[:-2][whole], values[1:-1][whole], values[2:][whole]
        if np.sum((middle - 0.5 * (first + last)) ** 2) < MAX_INTERPOLATION_ERROR * np.sum((middle - first) ** 2):
            smooth.add(name)
    rows = np.arange(int(grid[-1]) + 1)
    if rows.size == log.rows or not smooth:
        return log
    before = np.searchsorted(grid, rows, side="right") - 1
    inputs = {n: np.interp(rows, grid, v) if n in smooth else v[before] for n, v in log.inputs.items()}
    outputs = {n: np.where(grid[before] == rows, v[before], np.nan) for n, v in log.outputs.items()}
    return replace(log, time=np.interp(rows, grid, log.time), inputs=inputs, outputs=outputs)


# -- white noise of a channel, from its readings alone or with a model -------------------------------


def noise_level(values: Array) -> float:
    """Return a robust estimate of the white-noise standard deviation of a smooth signal; NaN below 5 values.

    The signal's fourth derivative times h⁴/6 counts as noise.
    """
    return white_noise(surprise(values))


def least_noise_level(values: Array, model: Array) -> float:
    """Return the noise level of a signal without the motion that the model's output explains."""
    return float(np.fmin(noise_level(values), noise_level(values - model)))


def white_noise(deviations: Array) -> float:
    """Return the standard deviation of white noise, estimated by the median of deviations; NaN without values."""
    deviations = deviations[np.isfinite(deviations)]
    return float(1.4826 * np.median(np.abs(deviations))) if deviations.size else math.nan


def surprise(values: Array) -> Array:
    """Return each reading's deviation from its four neighbours, scaled to the noise level; NaN if unknown.

    The cubic through two neighbours on each side predicts y_k, for equal rows as (−1, 4, 4, −1)/6; white noise σ gives
    a difference of σ·√(1 + Σ w²). For a slow sensor, neighbours are its own samples, but not across a gap.
    """
    deviations = np.full(values.size, np.nan)
    rows = np.flatnonzero(np.isfinite(values))
    if rows.size < 5:
        return deviations
    near = np.lib.stride_tricks.sliding_window_view(rows, 5)
    span = near[:, 4] - near[:, 0]
    near = near[span <= MAX_NEIGHBOUR_SPAN * np.median(span)]
    centre, others = near[:, 2], near[:, [0, 1, 3, 4]]
    distances = (others - centre[:, None]).astype(np.float64)
    weights = np.ones_like(distances)
    for j, i in permutations(range(4), 2):  # Lagrange weights at the centre
        weights[:, j] *= distances[:, i] / (distances[:, i] - distances[:, j])
    predicted = np.sum(weights * values[others], axis=1)
    deviations[centre] = (values[centre] - predicted) / np.sqrt(1.0 + np.sum(weights**2, axis=1))
    return deviations
