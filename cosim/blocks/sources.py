"""Components without inputs: references of steps and ramps, and playback of recorded columns."""

from __future__ import annotations

import bisect
import ctypes
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.units import computed_in
from cosim.blocks.component import Row, RowComponent, Signal
from cosim.blocks.profile import ROUNDING, Profile, ProfileFunction, profile_function
from cosim.blocks.stepping import Slot
from cosim.storage.table import read_columns, read_exactly, whole_numbers_in
from cosim.storage.table_columns import Table

TEXTS = {"String", "Binary"}


class SourceBlock(RowComponent):
    """Signals as functions of time; their `over` equals single calls at ordered times."""

    def __init__(
        self,
        name: str,
        signals: Mapping[str, tuple[str, ProfileFunction | Recorded]],
        exact: Mapping[str, tuple[str, Recorded]] = MappingProxyType({}),
    ) -> None:
        """Make a source.

        Args:
            signals: Name → unit and function.
            exact: Name → FMI type and recorded values, of signals beyond the exact range of doubles.
        """
        self.name = name
        self.exact_outputs = tuple(Signal(signal, kind=kind) for signal, (kind, _) in exact.items())
        self.exact_functions = tuple(function for _, function in exact.values())
        # Whether a value is a difference is known from the input that it goes to.
        self.outputs = tuple(Signal(signal, unit, relative=True) for signal, (unit, _) in signals.items())
        self.functions = tuple(function for _, function in signals.values())
        self._t = 0.0

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return False

    def open(self, start: float, stop: float) -> None:
        self._t = start

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        super().bind(row, first)
        self._beside = [None] * len(self.exact_functions) if beside is None else beside
        self._first_beside = first_beside

    def get(self) -> None:
        for k, function in enumerate(self.functions, self._first):
            self._row[k] = function(self._t)
        for k, function in enumerate(self.exact_functions, self._first_beside):
            self._beside[k] = function(self._t)

    def advance(self, t: float, h: float) -> None:
        self._t = t + h

    def slot(self) -> Slot | str:
        """Return the C loop's slot with prepared values, or the reason for none."""
        if self.exact_functions:
            return f"{self.name} has values that no double holds"
        slot = Slot(0, every=1, time=self._t, scalars=len(self.outputs))
        slot.row = ctypes.addressof(self._row) + 8 * self._first
        return slot

    def over(self, times: Array) -> Array:
        """Return the signals at many times, shape (times, signals)."""
        columns = [function.over(times) for function in self.functions]
        return np.ascontiguousarray(np.transpose(columns)) if columns else np.zeros((len(times), 0))

    def set_time(self, t: float) -> None:
        """Note the time [s] after C steps."""
        self._t = t

    def checkpoint(self) -> float:
        return self._t

    def restore(self, state: float) -> None:
        self._t = state


def reference(name: str, profiles: Mapping[str, Profile]) -> SourceBlock:
    """Return a source of reference signals that follow profiles; degrees become radians."""
    signals = {}
    for signal, profile in profiles.items():
        unit, factor = computed_in(profile.unit)
        signals[signal] = (unit, profile_function(profile, factor))
    return SourceBlock(name, signals)


def playback(
    name: str, path: Path, names: Collection[str] = (), exact: Mapping[str, str] = MappingProxyType({})
) -> SourceBlock:
    """Return the columns of a CSV file as signals.

    The first column is `time`; header cells are `name` or `name [unit]`. Degrees become radians.

    Args:
        names: Names used by connections, whose brackets are not units. Other columns with non-numbers are ignored.
        exact: Column → FMI type of an input that it feeds and whose values no double holds: text, 64-bit integers.

    Raises:
        InputError: The file has faults; it lists all of them.
    """
    table, exactly = read_recording(path, names, exact)
    times, signals = table.values["time"], {}
    for column in (c for c in table.columns.values() if c.name != "time"):
        unit, factor = computed_in(column.heading.unit)
        signals[column.name] = (unit, Recorded(times, [factor * v for v in table.values[column.name]]))
    return SourceBlock(name, signals, {n: (exact[n], Recorded(times, values)) for n, values in exactly.items()})


def read_recording(
    path: Path, names: Collection[str], exact: Mapping[str, str]
) -> tuple[Table, dict[str, Sequence[Any]]]:
    """Return the columns of numbers of a table, and those that no double holds; arguments as in `playback`.

    Raises:
        InputError: The file has faults; it lists all of them.
    """
    columns = dict[str, Sequence[Any]]()
    with suppress(InputError):  # The other columns are then read, to list all faults.
        for name, values in (read_exactly(path, exact.keys(), names) if exact else {}).items():
            content = [*map(str, values)] if exact[name] in TEXTS else whole_numbers_in(values)
            columns |= {name: content} if content is not None else {}
    return read_columns(path, names, columns), columns


class Recorded:
    """A recorded signal: last value at or before a time; before the first time the first value."""

    def __init__(self, times: Sequence[float], values: Sequence[Any]) -> None:
        self.times, self.values = times, values

    def __call__(self, t: float) -> Any:
        return self.values[max(0, bisect.bisect_right(self.times, t + ROUNDING) - 1)]

    def over(self, times: Array) -> Array:
        """Return the values at many times."""
        return self._values[np.maximum(0, np.searchsorted(self._times, times + ROUNDING, "right") - 1)]

    @cached_property
    def _times(self) -> Array:
        return np.asarray(self.times, np.float64)

    @cached_property
    def _values(self) -> Array:
        return np.asarray(self.values, np.float64)
