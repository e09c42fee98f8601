"""A measured log: CSV with `time` and the model's inputs and outputs by name; every fault has its place."""

from __future__ import annotations

import csv
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from cosim.arrays import Array, Rows
from cosim.errors import Fault, InputError
from cosim.logs.cells import absurd, no_number, wrong_length
from cosim.yaml_file import did_you_mean
from fmus.units import alternatives, factor

GAP = 0.5  # [s] without a row; shorter holes are dropouts
LOST = 10  # rows at least that are lost in a pause

LARGEST = 200_000_000  # bytes; read whole, so that every fault can be reported
FAULTS_A_CELL_COLUMN = 5  # then their number
TURN = 2.0 * math.pi
MISSING = 1.5  # steps from row to row, from which one is missing in between


class SignalLike(Protocol):
    """An input or output of a model: `blocks.interface.Signal`, `plant.quantities.Quantity`."""

    @property
    def name(self) -> str:
        """Its FMI name."""

    @property
    def unit(self) -> str:
        """Its unit, "" where it has none."""


@dataclass(frozen=True, eq=False)
class Log:
    """What was commanded and measured, in the units of the model.

    Row k holds, at `time[k]`, what is measured there and the command that acts until `time[k + 1]`.

    time:      [s], shape (rows,), increasing
    inputs:    name → (rows,), every value known
    outputs:   name → (rows,), NaN where nothing was measured
    units:     name → unit of the model; `written`: name → unit of the header, "" where it gave none
    step:      median time between rows [s]
    unwrapped: angle → times [s] at which it jumped by a turn; the jumps are undone
    header:    line of the file that names the columns
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

    @property
    def rows(self) -> int:
        """Number of rows."""
        return self.time.size

    @cached_property
    def grid(self) -> Rows:
        """Row of each in equal steps of `step` from the first; 0, 1, 2 … where no row is missing."""
        number = np.arange(self.rows)
        if not np.any(np.diff(self.time) > MISSING * self.step):
            return number
        missing = np.rint((self.time - self.time[0]) / self.step - number).astype(np.intp)
        # a row that is late moves none of those after it
        return number + np.maximum(0, np.minimum.accumulate(missing[::-1])[::-1])


def read_log(path: Path, inputs: Sequence[SignalLike], outputs: Sequence[SignalLike]) -> Log:
    """Read a log of a model with these inputs and outputs; InputError with every fault."""
    reader = _Reader(path, {s.name: s.unit for s in inputs}, {s.name: s.unit for s in outputs})
    try:
        if not path.is_file():
            reader.refuse(0, 0, "is no file" if path.exists() else "no such file")
        elif (size := path.stat().st_size) > LARGEST:
            reader.refuse(0, 0, f"has {size / 1e6:.0f} MB, more than the {LARGEST / 1e6:.0f} MB a log may have; "
                          "cut it into pieces and list them as logs of one study")  # fmt: skip
        else:
            with path.open("rb") as stream:
                reader.read(stream)
    except OSError as error:
        reader.refuse(0, 0, f"cannot be read: {error.strerror}")
    return reader.log()


class _NotText(Exception):
    """A line that is not UTF-8."""


def _lines(stream: BinaryIO) -> Iterator[str]:
    """Lines of text; the first may begin with a byte order mark."""
    for raw in stream:
        try:
            yield raw.decode("utf-8-sig" if raw.startswith(b"\xef\xbb\xbf") else "utf-8")
        except UnicodeDecodeError:
            raise _NotText from None


class _Reader:
    """Collects faults while the header and then the cells are read."""

    def __init__(self, path: Path, inputs: dict[str, str], outputs: dict[str, str]) -> None:
        self.path, self.inputs, self.outputs = path, inputs, outputs
        self.faults: list[Fault] = []
        self.counts: Counter[tuple[int, str]] = Counter()
        self.places: dict[str, int] = {}  # name → cell, of the columns that are kept
        self.factors: dict[str, float] = {}
        self.written: dict[str, str] = {}
        self.top = 1  # line of the header
        self.width = 0  # of the header
        self.columns: dict[str, array[float]] = {}
        self.signals: list[tuple[str, int]] = []  # the same without the time
        self.rows = 0
        self.lines = array("q")  # of the rows

    # -- faults -------------------------------------------------------------------------------

    def refuse(self, line: int, cell: int, message: str) -> None:
        """Note a fault; line and cell count from 1."""
        self.faults.append(Fault(self.path, line, cell, message))

    def refuse_head(self, cell: int, message: str) -> None:
        """Note a fault of the header."""
        self.refuse(self.top, cell, message)

    def refuse_cell(self, line: int, cell: int, kind: str, message: str) -> None:
        """Note a fault of which a column may have thousands: the first few, later their number."""
        self.counts[cell, kind] += 1
        if self.counts[cell, kind] <= FAULTS_A_CELL_COLUMN:
            self.refuse(line, cell, message)

    # -- reading ------------------------------------------------------------------------------

    def read(self, stream: BinaryIO) -> None:
        rows = csv.reader(_lines(stream))
        try:
            header = next(filter(_filled, rows), None)
            if header is None:
                self.refuse(1, 1, "is empty; the first line names the columns: time, then inputs and outputs")
                return
            self.top = rows.line_num
            self._header(header)
            if "time" not in self.places:
                return
            for row in rows:
                if _filled(row):
                    self._row(rows.line_num, row)
        except _NotText:
            self.refuse(rows.line_num + 1, 1, "is not UTF-8 text; save the log as plain CSV, UTF-8")
            return
        except csv.Error as error:
            self.refuse(rows.line_num, 1, f"is not CSV: {error}")
            return
        self._check_columns()
        self._summarise()

    def _header(self, header: list[str]) -> None:
        self.width = len(header)
        if self.width == 1 and (mark := next((m for m in ";\t" if m in header[0]), None)):
            shown = {";": "semicolons", "\t": "tabs"}[mark]
            self.refuse_head(1, f"cells are separated by {shown}; separate them with commas, decimals with a point")
            return
        for cell, text in enumerate(header, 1):
            name, _, rest = text.partition("[")
            self._head(cell, name.strip(), rest.rstrip().removesuffix("]").strip())
        self.signals = [(name, cell) for name, cell in self.places.items() if cell > 1]
        missing = [name for name in self.inputs if name not in self.places]
        for name in missing if "time" in self.places else ():
            self.refuse_head(
                1, f'input "{name}" is missing; a log holds every input of the model: {_list(self.inputs)}'
            )
        if not missing and not any(name in self.places for name in self.outputs) and "time" in self.places:
            self.refuse_head(1, f"holds no output of the model; at least one of {_list(self.outputs)} is measured")

    def _head(self, cell: int, name: str, unit: str) -> None:
        """Check one cell of the header and note what its column is."""
        known = self.inputs | self.outputs
        if cell == 1 and name != "time":
            self.refuse_head(1, f'the first column is "{name}"; it must be "time" [s]{did_you_mean(name, ["time"])}')
        elif name in self.places:
            self.refuse_head(cell, f'column "{name}" stands twice, first as column {self.places[name]}; keep one')
        elif cell > 1 and name not in known:
            hint = did_you_mean(name, known) or did_you_mean(name.rpartition(".")[2], known)
            self.refuse_head(cell, f'unknown column "{name}"{hint} (the model has {_list(known)})')
        else:
            self._unit(cell, name, unit, "s" if cell == 1 else known[name])

    def _unit(self, cell: int, name: str, unit: str, wanted: str) -> None:
        self.places[name], self.written[name] = cell, unit
        self.columns[name] = array("d")
        scale = factor(unit, wanted)
        if scale is None:
            known = ", ".join(alternatives(wanted))
            self.refuse_head(cell, f'"{unit}" is no unit of {name}, which is in {wanted}; known here: {known}')
        self.factors[name] = 1.0 if scale is None else scale

    def _row(self, line: int, row: list[str]) -> None:
        if len(row) != self.width:
            self.refuse_cell(line, 1, "rows of another length", wrong_length(len(row), self.width))
            return
        time, before = self._value(line, 1, "time", row[0]), self.columns["time"]
        if math.isnan(time):
            return
        if before and time <= before[-1]:
            message = f"time {time:g} s does not increase, {before[-1]:g} s stands before it; sort the rows"
            self.refuse_cell(line, 1, "times that do not increase", f"{message}, keep one of each")
        before.append(time)
        for name, cell in self.signals:
            self.columns[name].append(self._value(line, cell, name, row[cell - 1]))
        self.rows += 1
        self.lines.append(line)

    def _value(self, line: int, cell: int, name: str, text: str) -> float:
        """A cell in the unit of the model, NaN where it is empty, `nan` or faulty."""
        value = self._number(line, cell, name, text)
        if value != value and name not in self.outputs and text.strip().lower() in {"", "nan"}:
            cure = "the time is known" if name == "time" else "an input is known"
            message = f"{name} has no value here; {cure} at every row, so fill the cell or leave the row out"
            self.refuse_cell(line, cell, f"cells of {name} without a value", message)
        return value * self.factors[name]

    def _number(self, line: int, cell: int, name: str, text: str) -> float:
        try:
            value = float(text) if text and not text.isspace() else math.nan
        except ValueError:
            self.refuse_cell(line, cell, *no_number(text, name))
            return math.nan
        if value in (math.inf, -math.inf):
            message = f'"{text.strip()}" in column {name} is not finite; leave the cell empty where there is no value'
            self.refuse_cell(line, cell, f"cells of {name} that are not finite", message)
            return math.nan
        return value

    # -- the whole ----------------------------------------------------------------------------

    def _summarise(self) -> None:
        for (cell, kind), count in self.counts.items():
            if count > FAULTS_A_CELL_COLUMN:
                self.refuse(0, 0, f"{count} {kind} in all, column {cell}; the first {FAULTS_A_CELL_COLUMN} are shown")

    def _check_columns(self) -> None:
        """What only the whole column shows: too few rows, nothing measured, values that no sensor ever read."""
        if self.rows < 2 and not self.counts:
            seen = "no row" if self.rows == 0 else "one row"
            self.refuse(self.top + 1, 1, f"holds {seen}; a log has at least two, and some hundred to be of use")
            return
        if not self.rows:
            return
        told = {cell for cell, _ in self.counts}
        for name, cell in self.signals:
            if name in self.outputs and cell not in told and np.isnan(self.columns[name]).all():
                self.refuse_head(cell, f'column "{name}" holds no value (NaN in every row); delete the column')
        for name, cell in self.places.items():
            self._check_sizes(name, cell)

    def _check_sizes(self, name: str, cell: int) -> None:
        values = np.frombuffer(self.columns[name])
        cure = "leave the cell empty" if name in self.outputs else "leave the row out"
        for row in absurd(values):
            message = f'{name} is {values[row]:g} here, far beyond the rest: a mark for "invalid"? Then {cure}'
            self.refuse_cell(self.lines[row], cell, f"cells of {name} far beyond the rest", message)

    def log(self) -> Log:
        """The log, or InputError."""
        if self.faults:
            raise InputError(self.faults)
        columns = {name: np.array(values, dtype=np.float64) for name, values in self.columns.items()}
        known, time = self.inputs | self.outputs, columns.pop("time")
        outputs, unwrapped = dict[str, Array](), dict[str, tuple[float, ...]]()
        for name in (n for n in columns if n in self.outputs):
            outputs[name] = columns[name]
            if known[name] == "rad":
                outputs[name], jumps = _continuous(columns[name])
                unwrapped |= {name: tuple(time[jumps].tolist())} if jumps.size else {}
        return Log(
            self.path, time, {n: columns[n] for n in self.inputs}, outputs, {n: known[n] for n in columns},
            float(f"{np.median(np.diff(time)):.9g}"), self.written, unwrapped, self.top,
        )  # fmt: skip


def _continuous(angle: Array) -> tuple[Array, Rows]:
    """The angle without jumps of a turn, and the rows after them; one that spans more than a turn is left alone."""
    rows = np.flatnonzero(np.isfinite(angle))
    values = angle[rows]
    jumps = rows[1:][np.abs(np.diff(values)) > math.pi]
    if not jumps.size or np.ptp(values) > 1.02 * TURN:
        return angle, jumps[:0]
    smooth = angle.copy()
    smooth[rows] = np.unwrap(values)
    return smooth, jumps


def _filled(row: Sequence[str]) -> bool:
    return any(cell.strip() for cell in row)


def _list(names: Mapping[str, str]) -> str:
    return ", ".join(names)


def stretches(log: Log) -> list[Log]:
    """A log cut at its pauses, over which neither commands nor state are known; each stretch is a log of its own."""
    cuts = np.flatnonzero(np.diff(log.time) > max(GAP, LOST * log.step)) + 1
    if not cuts.size:
        return [log]
    found = []
    for first, end in pairwise([0, *cuts.tolist(), log.rows]):
        rows = slice(first, end)
        outputs = {name: values[rows] for name, values in log.outputs.items() if not np.isnan(values[rows]).all()}
        inputs = {name: values[rows] for name, values in log.inputs.items()}
        found.append(replace(log, time=log.time[rows], inputs=inputs, outputs=outputs))
    return found
