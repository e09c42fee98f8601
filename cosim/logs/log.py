"""Measured logs from CSV files with `time` and the model's inputs and outputs; faults have a place.

A model without states has a table instead: no `time`, independent rows.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import Fault, InputError
from cosim.base.units import Conversion, alternatives, assume_si, conversion
from cosim.storage.table import read_table
from cosim.storage.table_columns import Column, Faults, Heading
from cosim.storage.yaml_file import closest, did_you_mean, short

USUAL = 0.05  # [s] row spacing up to which fixed times apply; see `slowness`
GAP = 0.5  # [s] without a row; shorter holes are dropouts
LOST = 10  # least number of rows lost in a pause
USUALLY = 3.0  # multiple of the usual measurement spacing beyond which a pause begins
BEYOND = 1e6  # multiple of a column's usual size beyond which a value is invalid
ORDINARY = 1e9  # size in any SI unit up to which a mostly resting column may jump
NEVER = 1e30  # size in any SI unit beyond which every value is invalid
TURN = 2.0 * math.pi
ALIKE = 0.85  # similarity of two names for a suggestion; prefixes of loggers resemble much
HINTS, SHOWN = 50, 40  # columns with a suggestion, and names in a message
MISSING = 1.5  # steps between rows from which a row is missing
OTHER_MODEL = (
    "a log of another model is checked with --model FILE:CLASS and replayed with --plant FMU; "
    "where columns have other names, --column COLUMN=VARIABLE, or `columns` of a study, says which is which"
)


class SignalLike(Protocol):
    """An input or output of a model: `cosim.blocks.component.Signal`, `cosim.model.Quantity`."""

    @property
    def name(self) -> str:
        """Return the FMI name."""

    @property
    def unit(self) -> str:
        """Return the unit, "" without one."""


@dataclass(frozen=True, eq=False)
class Log:
    """Commands and measurements in the units of the model.

    Row k holds the measurements at `time[k]` and the command until `time[k + 1]`.

    Attributes:
        time: Increasing times [s], shape (rows,).
        inputs: Name → (rows,), complete.
        outputs: Name → (rows,), NaN without a measurement.
        units: Name → unit of the model, else the header's unit in SI.
        written: Name → unit in the header, "" without one.
        undeclared: Signal without a unit in the model, but with one in the header → message.
        step: Usual time between rows [s], see `usual_step`.
        unwrapped: Angle → times of removed jumps by a turn [s].
        header: Line of the column names in the file.
        called: Name in the file → name in the model, if different.
        unread: Column unknown to the model → suggestion, or "".
    """

    path: Path
    time: Array
    inputs: Mapping[str, Array]
    outputs: Mapping[str, Array]
    units: Mapping[str, str]
    step: float
    written: Mapping[str, str]
    unwrapped: Mapping[str, tuple[float, ...]]
    header: int = 1
    unread: Mapping[str, str] = field(default_factory=dict)
    called: Mapping[str, str] = field(default_factory=dict)
    undeclared: Mapping[str, str] = field(default_factory=dict)
    cells: Mapping[str, int] = field(default_factory=dict)  # column in the header by signal, from 1
    table: bool = False  # rows are independent; `time` is their number

    @property
    def rows(self) -> int:
        """Return the number of rows."""
        return self.time.size

    @property
    def slowness(self) -> int:
        """Return the time scale of slow logs, see `slowness`."""
        return slowness(self.step)

    @property
    def pause(self) -> float:
        """Return the time without a row from which commands and state are unknown [s]."""
        return max(GAP, LOST * self.step)

    @cached_property
    def grid(self) -> Rows:
        """Return the index of each row in equal steps; 0, 1, 2 … without missing rows."""
        number = np.arange(self.rows)
        if not np.any(np.diff(self.time) > MISSING * self.step):
            return number
        missing = np.rint((self.time - self.time[0]) / self.step - number).astype(np.intp)
        # a late row does not shift later rows
        return number + np.maximum(0, np.minimum.accumulate(missing[::-1])[::-1])


def read_log(
    path: Path,
    inputs: Sequence[SignalLike],
    outputs: Sequence[SignalLike],
    *,
    table: bool = False,
    columns: Mapping[str, str] = MappingProxyType({}),
    alone: bool = False,
) -> Log:
    """Return a log of a model with these signals, or a table without time.

    Args:
        columns: Name in the file → name in the model, or `time`, if different.
        alone: True if `columns` applies to this file only, which must have each of them.

    Raises:
        InputError: Every fault of the file.
    """
    known = {s.name: s.unit for s in inputs}, {s.name: s.unit for s in outputs}
    return LogReader(path, *known, not table, columns, alone).log()


class LogReader:
    """Reader that turns a table into a log: known columns, complete inputs, plausible values."""

    def __init__(
        self,
        path: Path,
        inputs: dict[str, str],
        outputs: dict[str, str],
        timed: bool,
        columns: Mapping[str, str],
        alone: bool = False,
    ) -> None:
        self.inputs, self.outputs, self.known, self.timed = inputs, outputs, inputs | outputs, timed
        self.called, self.alone = columns, alone
        self.units = dict(self.known)  # units of the values after reading
        self.faults = Faults(path)
        self.timeless: dict[str, str] = {}  # unneeded time of a table, without a unit
        self.unread: dict[str, str] = {}
        self.undeclared: dict[str, str] = {}
        self.seen: dict[str, int] = {}  # column → its cell
        shorter = "cut it into pieces and list them as logs of one study"
        names = frozenset((*self.known, *columns))
        times = [name for name, meant in columns.items() if meant == "time"]
        self.table = read_table(
            self.faults, self._column, "inputs and outputs", shorter, timed=timed, names=names, times=times
        )

    def log(self) -> Log:
        """Return the log.

        Raises:
            InputError: Every fault of the file.
        """
        if "time" in self.table.columns or (not self.timed and self.table.whole):
            self._check_header()
        if self.table.whole:
            self._check_values()
        self.faults.raise_any()
        columns = {name: self.table[name] for name in self.table.columns}
        time = columns.pop("time") if self.timed else np.arange(self.table.rows, dtype=np.float64)
        units, unwrapped = {n: self.units[n] for n in columns}, dict[str, tuple[float, ...]]()
        outputs = {n: values for n, values in columns.items() if n in self.outputs}
        if self.timed:
            outputs, unwrapped = _unwrapped(outputs, units, time)
        inputs, step = {name: columns[name] for name in self.inputs}, usual_step(time)
        cells = {name: column.cell for name, column in self.table.columns.items()}
        written = {name: column.heading.unit for name, column in self.table.columns.items()} | self.timeless
        path, header, unread, called = self.faults.path, self.table.header, self._unread(), dict(self.called)
        known = (path, time, inputs, outputs, units, step, written, unwrapped)
        return Log(*known, header, unread, called, self.undeclared, cells, table=not self.timed)

    def _unread(self) -> dict[str, str]:
        """Return unread columns with suggested names."""
        missing = [name for name in self.known if name not in self.table.columns]
        close = (
            closest(name, missing, ALIKE) or closest(name.rpartition(".")[2], missing, ALIKE)
            for name in islice(self.unread, HINTS)
        )
        hints = (f'; did you mean "{name}"?' if name else "" for name in close)
        return {**self.unread, **dict(zip(self.unread, hints, strict=False))}

    # -- header -------------------------------------------------------------------------------

    def _column(self, heading: Heading) -> Column | None:
        """Return the conversion of a column to the model's unit, None for unread columns."""
        self.seen.setdefault(heading.name, heading.cell)
        written, heading = heading.name, replace(heading, name=self.called.get(heading.name, heading.name))
        name, is_time = heading.name, self.timed and heading.cell == 1
        if not self.timed and name == "time":
            self.timeless = {"time": ""}
            return None
        if not is_time and name not in self.known:
            self.unread[written] = ""
            return None
        known = "the time" if is_time else "an input" if name in self.inputs else ""
        wanted = "s" if is_time else self.known[name]
        if heading.unit and not wanted:
            found = assume_si(heading.unit)
            self.units[name] = found.unit
            if found.sentence:
                self.undeclared[name] = found.sentence
            return Column(heading, found.factor, known, offset=found.offset)
        by = conversion(heading.unit, wanted)
        if by is None:
            offered = ", ".join(alternatives(wanted))
            message = f'"{heading.unit}" is no unit of {name}, which is in {wanted}; known here: {offered}'
            self.faults.note(heading.line, heading.cell, message)
        by = by or Conversion()
        return Column(heading, by.factor, known, offset=by.offset)

    def _check_header(self) -> None:
        """Note faults of missing inputs and outputs."""
        self._check_called()
        line, columns = self.table.header, self.table.columns
        missing = [name for name in self.inputs if name not in columns]
        if missing and not self._about_the_model():
            self.faults.note(line, 1, f"holds none of the columns of the model: {named(self.known)}; {OTHER_MODEL}")
            return
        for name in missing:
            what = "log" if self.timed else "table"
            every = f"a {what} holds every input of the model: {named(self.inputs)}"
            if close := closest(name, self.unread):
                message = (
                    f'"{close}" is no column of the model; did you mean "{name}", which is missing? {every[:1].upper()}'
                )
                self.faults.note(line, self.seen[close], message + every[1:])
            else:
                self.faults.note(line, 1, f'input "{name}" is missing; {every}')
        if not missing and not any(name in columns for name in self.outputs):
            hints = "".join(dict.fromkeys(self._unread().values()))
            one = f"at least one of {named(self.outputs)} is measured"
            self.faults.note(line, 1, f"holds no output of the model{hints}; {one}")

    def _check_called(self) -> None:
        """Note faults of renamed columns."""
        line, first = self.table.header, self.table.first
        for name, meant in self.called.items():
            if meant == "time" and self.timed:
                if name != first:
                    self.faults.note(line, 1, f'"{name}" is to be the time, which is the first column, "{first}"')
            elif meant not in self.known:
                message = f'"{name}" is to be {meant}, which the model does not have{did_you_mean(meant, self.known)}'
                self.faults.note(line, 1, f"{message} (it has {named(self.known)})")
            elif name not in self.seen and (self.alone or meant not in self.table.columns):
                message = f'has no column "{name}"{did_you_mean(name, self.seen)} (it is to be {meant})'
                self.faults.note(line, 1, message)

    def _about_the_model(self) -> bool:
        """Return True if some column matches the model."""
        if self.called or len(self.unread) > HINTS or any(name in self.table.columns for name in self.known):
            return True
        return any(closest(name, self.unread) for name in self.known)

    # -- rows ---------------------------------------------------------------------------------

    def _check_values(self) -> None:
        """Note faults of whole columns: too few rows, no measurement, absurd values."""
        table, counts = self.table, self.faults.counts
        if table.rows < 2 and not counts:
            seen = "no row" if table.rows == 0 else "one row"
            what = "a log has at least two, and some hundred" if self.timed else "a table has at least two, and a dozen"
            message = f"holds {seen}; {what} to be of use"
            self.faults.note(table.header + 1, 1, message)
            return
        if not table.rows:
            return
        faulty = {cell for cell, _ in counts}
        for name, column in table.columns.items():
            values = table[name]
            if name in self.outputs and column.cell not in faulty and np.isnan(values).all():
                message = f'column "{name}" holds no value (NaN in every row); delete the column'
                self.faults.note(table.header, column.cell, message)
            self._check_sizes(column, values)

    def _check_sizes(self, column: Column, values: Array) -> None:
        name, cure = column.name, "leave the row out" if column.role else "leave the cell empty"
        for row in _absurd(values):
            message = f'{name} is {values[row]:g} here, far beyond the rest: a mark for "invalid"? Then {cure}'
            self.faults.note_cell(self.table.lines[row], column.cell, f"cells of {name} far beyond the rest", message)


def renamed(texts: Sequence[str], log: Path) -> dict[str, str]:
    """Return column → name in the model for texts such as `measured_speed=motor.w` or `stamp=time`.

    Raises:
        InputError: A text has another form.
    """
    parts = [(text, *text.partition("=")) for text in texts]
    if wrong := [t for t, name, sign, meant in parts if not (name.strip() and sign and meant.strip())]:
        cure = "is not COLUMN=VARIABLE, as in measured_speed=motor.w"
        raise InputError([Fault(log, 0, 0, f'--column "{short(t)}" {cure}') for t in wrong])
    return {name.strip(): meant.strip() for _, name, _, meant in parts}


def named(names: Collection[str]) -> str:
    """Return names in a line, shortened if very many."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(islice(names, SHOWN)) + more


def _absurd(values: Array) -> Rows:
    """Return rows of absurd values, such as a logger's 3.4e38 for `invalid`."""
    size = np.abs(values)
    seen = size[~np.isnan(size)]
    if not seen.size:
        return np.zeros(0, np.intp)
    limit = min(max(BEYOND * float(np.median(seen)), ORDINARY), NEVER)
    return np.flatnonzero(size > limit)


def _continuous(angle: Array) -> tuple[Array, Rows]:
    """Return the continuous angle and its jumps.

    An angle that spans more than a turn is unchanged.
    """
    rows = np.flatnonzero(np.isfinite(angle))
    values = angle[rows]
    jumps = rows[1:][np.abs(np.diff(values)) > math.pi]
    if not jumps.size or np.ptp(values) > 1.02 * TURN:
        return angle, jumps[:0]
    smooth = angle.copy()
    smooth[rows] = np.unwrap(values)
    return smooth, jumps


def _unwrapped(
    outputs: Mapping[str, Array], units: Mapping[str, str], time: Array
) -> tuple[dict[str, Array], dict[str, tuple[float, ...]]]:
    """Return the outputs with continuous angles, and the times of removed jumps."""
    smooth, jumps = dict(outputs), dict[str, tuple[float, ...]]()
    for name in outputs:
        if units[name] == "rad":
            smooth[name], rows = _continuous(outputs[name])
            jumps |= {name: tuple(time[rows].tolist())} if rows.size else {}
    return smooth, jumps


def usual_step(time: Array) -> float:
    """Return the row spacing [s] of a line through the times, with whole steps over gaps.

    With jittering stamps, a median off by a thousandth would be off by whole rows at the end of a log.
    """
    apart = np.diff(time)
    median = float(np.median(apart))
    usual = apart < MISSING * median
    number = np.concatenate([[0.0], np.cumsum(np.where(usual, 1.0, np.rint(apart / median)))])
    if np.max(np.abs(time - time[0] - median * number)) < 1e-6 * median * time.size:
        return float(f"{median:.9g}")
    slope = float(np.polyfit(number, time - time[0], 1)[0])
    return float(f"{slope:.9g}") if abs(slope - median) < 0.02 * median else float(f"{median:.9g}")


def slowness(step: float) -> int:
    """Return the time scale for slow rows.

    A tank logged every half second is slow: a second, or a memory of 0.15 s, would be two rows or none.
    """
    return max(1, math.ceil(step / USUAL - 0.1))


def _measuring(log: Log, first: int, end: int) -> list[tuple[int, int]]:
    """Return measured ranges (first, end) without pauses, relative to `first`; all rows without measurement.

    A pause exceeds the usual spacing of measurements too, so a slow sensor is no pause.
    """
    seen = np.zeros(end - first, bool)
    for values in log.outputs.values():
        seen |= np.isfinite(values[first:end])
    rows = np.flatnonzero(seen)
    if not rows.size:
        return [(0, end - first)]
    time = log.time[first:end]
    apart = np.diff(time[rows])
    limit = max(log.pause, USUALLY * float(np.median(apart))) if apart.size else log.pause
    edges = np.flatnonzero(apart > limit)
    # Commands before the first and after the last measurement belong to the range, except after a pause.
    start = 0 if time[rows[0]] - time[0] <= limit else rows[0]
    stop = end - first if time[-1] - time[rows[-1]] <= limit else rows[-1] + 1
    starts, ends = (start, *rows[edges + 1]), (*rows[edges] + 1, stop)
    return [(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def stretches(log: Log) -> list[Log]:
    """Return a log cut at its pauses.

    In a pause, rows are missing (unknown commands and state), or measurements are (unknown state).
    """
    pieces = [
        (first + a, first + b)
        for first, end in pairwise([0, *(np.flatnonzero(np.diff(log.time) > log.pause) + 1).tolist(), log.rows])
        for a, b in _measuring(log, first, end)
    ]
    if pieces == [(0, log.rows)]:
        return [log]
    found = []
    for first, end in pieces:
        rows = slice(first, end)
        outputs = {name: values[rows] for name, values in log.outputs.items() if not np.isnan(values[rows]).all()}
        inputs = {name: values[rows] for name, values in log.inputs.items()}
        found.append(replace(log, time=log.time[rows], inputs=inputs, outputs=outputs))
    return found
