"""Components without inputs: references of steps and ramps, and playback of recorded columns."""

from __future__ import annotations

import bisect
import ctypes
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array
from cosim.base.units import computed_in
from cosim.blocks.component import RowComponent, Signal
from cosim.blocks.profile import ROUNDING, Profile, ProfileFunction, profile_function
from cosim.blocks.stepping import Slot
from cosim.storage.table import read_columns


class SourceBlock(RowComponent):
    """Signals as functions of time; their `over` equals single calls at ordered times."""

    is_linear = False

    def __init__(self, name: str, signals: Mapping[str, tuple[str, ProfileFunction | Recorded]]) -> None:
        self.name = name
        self.outputs = tuple(Signal(signal, unit) for signal, (unit, _) in signals.items())
        self.functions = tuple(function for _, function in signals.values())
        self._t = 0.0

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return False

    def open(self, start: float, stop: float) -> None:
        self._t = start

    def get(self) -> None:
        for k, function in enumerate(self.functions, self._first):
            self._row[k] = function(self._t)

    def advance(self, t: float, h: float) -> None:
        self._t = t + h

    def slot(self) -> Slot | str:
        """Return the C loop's slot with prepared values."""
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


def playback(name: str, path: Path, names: Collection[str] = ()) -> SourceBlock:
    """Return the columns of a CSV file as signals.

    The first column is `time`; header cells are `name` or `name [unit]`. Degrees become radians.

    Args:
        names: Names used by connections, whose brackets are not units. Other columns with non-numbers are ignored.

    Raises:
        InputError: The file has faults; it lists all of them.
    """
    table = read_columns(path, names)
    times, signals = table.values["time"], {}
    for column in (c for c in table.columns.values() if c.name != "time"):
        unit, factor = computed_in(column.heading.unit)
        signals[column.name] = (unit, Recorded(times, [factor * v for v in table.values[column.name]]))
    return SourceBlock(name, signals)


class Recorded:
    """A recorded signal: last value at or before a time; before the first time the first value."""

    def __init__(self, times: Sequence[float], values: Sequence[float]) -> None:
        self.times, self.values = times, values

    def __call__(self, t: float) -> float:
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
