"""Components without inputs: references made of steps and ramps, and recorded columns played back."""

from __future__ import annotations

import bisect
import csv
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from cosim.blocks.interface import Row, Signal
from cosim.blocks.profile import Profile, profile_function
from cosim.errors import Fault, InputError

TO_SI = {"deg": ("rad", math.pi / 180.0), "deg/s": ("rad/s", math.pi / 180.0)}


class Source:
    """Signals that are functions of time."""

    def __init__(self, name: str, signals: Mapping[str, tuple[str, Callable[[float], float]]]) -> None:
        self.name = name
        self.inputs: tuple[Signal, ...] = ()
        self.outputs = tuple(Signal(signal, unit) for signal, (unit, _) in signals.items())
        self._functions = tuple(function for _, function in signals.values())
        self._t = 0.0

    def depends_on(self, name: str) -> bool | None:
        return False

    def bind(self, row: Row, first: int) -> None:
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        self._t = start

    def start(self) -> None:
        pass

    def put(self) -> None:
        pass

    def get(self) -> None:
        for k, function in enumerate(self._functions, self._first):
            self._row[k] = function(self._t)

    def advance(self, t: float, h: float) -> None:
        self._t = t + h

    def close(self) -> None:
        pass


def reference(name: str, profiles: Mapping[str, Profile]) -> Source:
    """References from profiles; degrees become radians."""
    signals = {}
    for signal, profile in profiles.items():
        unit, factor = TO_SI.get(profile.unit, (profile.unit, 1.0))
        signals[signal] = (unit, profile_function(profile, factor))
    return Source(name, signals)


def playback(name: str, path: Path) -> Source:
    """Columns of a CSV file whose first column is `time` [s]; header cells are `name` or `name [unit]`."""
    header, columns = _read_columns(path)
    times = columns[0]
    signals = {}
    for cell, values in zip(header[1:], columns[1:], strict=True):
        signal, _, unit = cell.partition("[")
        si, factor = TO_SI.get(unit.strip(" ]"), (unit.strip(" ]"), 1.0))
        signals[signal.strip()] = (si, _held(times, [factor * v for v in values]))
    return Source(name, signals)


def _held(times: Sequence[float], values: Sequence[float]) -> Callable[[float], float]:
    return lambda t: values[max(0, bisect.bisect_right(times, t + 1e-9) - 1)]


def _header_faults(path: Path, header: Sequence[str]) -> list[Fault]:
    names = [cell.partition("[")[0].strip() for cell in header]
    faults = []
    if header[0].partition("[")[2].strip(" ]") not in {"", "s"}:
        faults.append(Fault(path, 1, 1, f'"{header[0].strip()}": time is in seconds'))
    for column, name in enumerate(names, 1):
        if not name:
            faults.append(Fault(path, 1, column, "the column has no name"))
        elif name in names[: column - 1]:
            faults.append(Fault(path, 1, column, f'"{name}" stands twice; keep one'))
    return faults


def _read_columns(path: Path) -> tuple[list[str], list[list[float]]]:
    """Header and columns; InputError with every faulty cell."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError([Fault(path, 0, 0, f"cannot be read: {error}")]) from None
    if len(rows) < 2 or not rows[0] or rows[0][0].partition("[")[0].strip() != "time":
        raise InputError(
            [Fault(path, 1, 1, 'is no log: the first column is "time" and at least one row follows the header')]
        )
    width, faults = len(rows[0]), _header_faults(path, rows[0])
    table: list[list[float]] = []
    for line, row in enumerate(rows[1:], 2):
        if len(row) != width:
            faults.append(Fault(path, line, 1, f"has {len(row)} cells; the header has {width}"))
            continue
        numbers = []
        for column, cell in enumerate(row, 1):
            try:
                numbers.append(float(cell))
            except ValueError:
                faults.append(Fault(path, line, column, f'"{cell}" is no number'))
                numbers.append(math.nan)
            else:
                if not math.isfinite(numbers[-1]):
                    faults.append(Fault(path, line, column, f'"{cell}" is not finite; an input is known at every row'))
        if table and numbers[0] <= table[-1][0]:
            faults.append(Fault(path, line, 1, f"time {numbers[0]:g} s does not increase"))
        table.append(numbers)
    if faults:
        raise InputError(faults)
    return rows[0], [list(column) for column in zip(*table, strict=True)]
