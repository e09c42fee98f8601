"""Components without inputs: references of steps and ramps, and playback of recorded columns."""

from __future__ import annotations

import bisect
import ctypes
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.blocks.component import Component, Row, Signal
from cosim.blocks.profile import Profile, ProfileFunction
from cosim.blocks.stepping import Slot
from cosim.core.arrays import Array
from cosim.core.errors import InputError
from cosim.core.times import rounding, roundings
from cosim.core.units import computed_in
from cosim.files.table import Table, read_columns, source_of

TEXT_TYPES = {"String", "Binary"}
INTEGER_PATTERN = re.compile(r"[-+]?\d+")


class SourceBlock(Component):
    """Signals as functions of time. `over` returns exactly the values of single calls at the same times.

    Attributes:
        assumed: Sentences on the assumptions made when a file was read.
    """

    assumed: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        signals: Mapping[str, tuple[str, ProfileFunction | Recorded]],
        exact: Mapping[str, tuple[str, Recorded]] = MappingProxyType({}),
    ) -> None:
        """Create a source.

        Args:
            signals: Name → unit and function.
            exact: Name → FMI type and recorded values, for signals whose values doubles cannot represent exactly.
        """
        self.name = name
        self.exact_outputs = tuple(Signal(signal, kind=kind) for signal, (kind, _) in exact.items())
        self.exact_functions = tuple(function for _, function in exact.values())
        # Only the connected input determines whether a value is a difference.
        self.outputs = tuple(Signal(signal, unit, relative=True) for signal, (unit, _) in signals.items())
        self.functions = tuple(function for _, function in signals.values())
        self._t = 0.0

    @property
    def interpolated(self) -> frozenset[str]:
        """Return the names of the signals that are interpolated between the rows of a file."""
        pairs = zip(self.outputs, self.functions, strict=True)
        return frozenset(s.name for s, f in pairs if isinstance(f, Recorded) and f.is_linear)

    def hold(self, name: str) -> None:
        """Hold a signal constant between the rows of a file."""
        for signal, function in zip(self.outputs, self.functions, strict=True):
            if signal.name == name and isinstance(function, Recorded):
                function.is_linear = False

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

    def slot(self, cells: Any) -> Slot | str:
        """Return the C loop's slot with precomputed values, or the reason why there is none."""
        if self.exact_functions:
            return f"{self.name} has values that doubles cannot represent"
        slot = Slot(0, time=self._t, scalars=len(self.outputs))
        slot.row = ctypes.addressof(self._row) + 8 * self._first
        return slot

    def over(self, times: Array) -> Array:
        """Return the signals at many times, shape (times, signals)."""
        columns = np.array([function.over(times) for function in self.functions])
        return np.ascontiguousarray(columns.reshape(len(self.functions), len(times)).T)

    def set_time(self, t: float) -> None:
        """Record the time [s] after steps in C."""
        self._t = t

    def checkpoint(self) -> float:
        return self._t

    def restore(self, state: float) -> None:
        self._t = state


def reference(name: str, profiles: Mapping[str, Profile], step: float = 0.0) -> SourceBlock:
    """Return a source of reference signals that follow profiles; degrees become radians.

    Args:
        step: Communication step [s]; times that differ by much less count as equal.
    """
    signals = {}
    for signal, profile in profiles.items():
        unit, factor = computed_in(profile.unit)
        signals[signal] = (unit, ProfileFunction(profile, factor, step))
    return SourceBlock(name, signals)


def playback(
    name: str,
    path: Path,
    names: Collection[str] = (),
    exact: Mapping[str, str] = MappingProxyType({}),
    *,
    step: float = 0.0,
    linear: bool = False,
) -> SourceBlock:
    """Return the columns of a CSV file as signals.

    The time column is `time`, a column with another usual name, or the first increasing column. Header cells are `name`
    or `name [unit]`. Degrees become radians.

    Args:
        names: Column names that connections use; their brackets are not units. Of the other columns, those that are not
            numeric are ignored.
        exact: Column → FMI type of the connected input, if doubles cannot represent its values exactly: text, 64-bit
            integers.
        step: Communication step [s]; times that differ by much less count as equal.
        linear: Interpolate linearly between rows, instead of holding values.

    Raises:
        InputError: The file has faults, all of which the error lists.
    """
    table, exactly = read_recording(path, names, exact)
    times, signals = table["time"].tolist(), {}
    for column in (c for c in table.columns if c.name != "time"):
        unit, factor = computed_in(column.unit)
        values = [factor * v for v in table[column.name].tolist()]
        signals[column.name] = (unit, Recorded(times, values, step, is_linear=linear))
    block = SourceBlock(name, signals, {n: (exact[n], Recorded(times, held, step)) for n, held in exactly.items()})
    block.assumed = tuple(f"{path.name}: {text}" for text in table.assumed)
    return block


def read_recording(
    path: Path, names: Collection[str], exact: Mapping[str, str]
) -> tuple[Table, dict[str, Sequence[Any]]]:
    """Return a table's numeric columns, and the columns in `exact`; arguments are those of `playback`.

    Raises:
        InputError: The file has faults, all of which the error lists.
    """
    columns = dict[str, Sequence[Any]]()
    with suppress(InputError):  # The other columns are then read, to list all faults.
        for column in source_of(path).read(path, names, exact.keys()).columns[1:] if exact else ():
            if column.name in exact and not column.fault:
                values = column.values.tolist() if isinstance(column.values, np.ndarray) else column.values
                with suppress(ValueError):
                    is_text = exact[column.name] in TEXT_TYPES
                    columns[column.name] = [str(value) if is_text else _whole_number(value) for value in values]
    return read_columns(path, names, columns), columns


def _whole_number(value: Any) -> int:
    """Return an exact whole number; raise ValueError for anything else."""
    if isinstance(value, int) or (isinstance(value, str) and INTEGER_PATTERN.fullmatch(value.strip())):
        return int(value)
    if not (number := float(value)).is_integer():
        raise ValueError
    return int(number)


@dataclass(eq=False)
class Recorded:
    """A recorded signal: the last value at or before a time, or the first value before the first time.

    Rows with equal times are a jump; the last of these values applies from this time on.

    Attributes:
        step: Communication step [s]; times that differ by much less count as equal.
        is_linear: True if values are interpolated linearly between rows.
    """

    times: Sequence[float]
    values: Sequence[Any]
    step: float = 0.0
    is_linear: bool = False

    def __call__(self, t: float) -> Any:
        k = max(0, bisect.bisect_right(self.times, t + rounding(t, self.step)) - 1)
        if not self.is_linear or k + 1 == len(self.times):
            return self.values[k]
        share = max(0.0, t - self.times[k]) / (self.times[k + 1] - self.times[k])
        return self.values[k] + share * (self.values[k + 1] - self.values[k])

    def over(self, times: Array) -> Array:
        """Return the values at many times."""
        rows = np.maximum(0, np.searchsorted(self._times, times + roundings(times, self.step), "right") - 1)
        held = self._values[rows]
        if not self.is_linear:
            return held
        following = np.minimum(rows + 1, len(self.times) - 1)
        spans = np.where(following > rows, self._times[following] - self._times[rows], 1.0)
        share = np.maximum(0.0, times - self._times[rows]) / spans
        values: Array = held + share * (self._values[following] - held)
        return values

    @cached_property
    def _times(self) -> Array:
        return np.asarray(self.times, np.float64)

    @cached_property
    def _values(self) -> Array:
        return np.asarray(self.values, np.float64)
