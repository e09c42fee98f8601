"""Components without inputs: references made of steps and ramps, and recorded columns played back."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from cosim.blocks.interface import Row, Signal
from cosim.blocks.profile import Profile, profile_function
from cosim.table import read_columns
from fmus.units import computed_in


class Source:
    """Signals that are functions of time."""

    nominal_step = True

    def __init__(self, name: str, signals: Mapping[str, tuple[str, Callable[[float], float]]]) -> None:
        self.name = name
        self.inputs: tuple[Signal, ...] = ()
        self.exact_inputs: tuple[Signal, ...] = ()
        self.exact_outputs: tuple[Signal, ...] = ()
        self.outputs = tuple(Signal(signal, unit) for signal, (unit, _) in signals.items())
        self.functions = tuple(function for _, function in signals.values())
        self._t = 0.0

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return False

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        self._t = start

    def start(self) -> None:
        pass

    def put(self) -> None:
        pass

    def get(self) -> None:
        for k, function in enumerate(self.functions, self._first):
            self._row[k] = function(self._t)

    def advance(self, t: float, h: float) -> None:
        self._t = t + h

    def calls(self) -> tuple[Callable[[], None] | None, Callable[[float, float], None], Callable[[], None]]:
        return None, self.advance, self.get

    def close(self) -> None:
        pass


def reference(name: str, profiles: Mapping[str, Profile]) -> Source:
    """References from profiles; degrees become radians."""
    signals = {}
    for signal, profile in profiles.items():
        unit, factor = computed_in(profile.unit)
        signals[signal] = (unit, profile_function(profile, factor))
    return Source(name, signals)


def playback(name: str, path: Path, names: Container[str] = ()) -> Source:
    """Columns of a CSV file whose first column is `time` [s]; header cells are `name` or `name [unit]`.

    names: that connections use, so that brackets in them are no unit
    Degrees become radians; InputError with every fault of the file.
    """
    table = read_columns(path, names)
    times, signals = table.values["time"], {}
    for column in (c for c in table.columns.values() if c.name != "time"):
        unit, factor = computed_in(column.heading.unit)
        signals[column.name] = (unit, _held(times, [factor * v for v in table.values[column.name]]))
    return Source(name, signals)


def _held(times: Sequence[float], values: Sequence[float]) -> Callable[[float], float]:
    return partial(_last, times, values)


def _last(times: Sequence[float], values: Sequence[float], t: float) -> float:
    return values[max(0, bisect.bisect_right(times, t + 1e-9) - 1)]
