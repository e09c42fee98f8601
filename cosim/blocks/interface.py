"""What the master asks of a component, and nothing more."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Protocol

Row = ctypes.Array[ctypes.c_double]


@dataclass(frozen=True)
class Signal:
    """An input or output: its name, its unit, and what the unit is in SI (None where undefined)."""

    name: str
    unit: str = ""
    definition: tuple[float, ...] | None = None

    def agrees(self, other: Signal) -> bool:
        """Units are the same, or one side has none."""
        if not self.unit or not other.unit or self.unit == other.unit:
            return True
        return self.definition is not None and self.definition == other.definition


class Component(Protocol):
    """Call sequence: bind, open, (put, get)* while initializing, start, then (put, advance, get)* and close.

    inputs are written to `row[first:]` by the master, outputs by the component right behind them.
    """

    name: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]

    def depends_on(self, name: str) -> bool | None:
        """Does an output at a time depend on this input at the same time? None: not declared."""

    def bind(self, row: Row, first: int) -> None:
        """Tell where in the row the component's signals stand, inputs first."""

    def open(self, start: float, stop: float) -> None:
        """Get ready: start values set, initialization begun."""

    def start(self) -> None:
        """End initialization."""

    def put(self) -> None:
        """Take the inputs from the row."""

    def get(self) -> None:
        """Write the outputs to the row."""

    def advance(self, t: float, h: float) -> None:
        """Step from `t` to `t + h` [s]."""

    def close(self) -> None:
        """Free everything; may be called at any time, more than once."""
