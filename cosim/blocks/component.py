"""What the master asks of a component, and nothing more."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, MutableSequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from cosim.base.errors import SimulationError
from cosim.base.units import parse

Row = ctypes.Array[ctypes.c_double]
PUT, ADVANCE, GET = range(3)  # what is called
SI = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class EndedEarly(SimulationError):
    """An FMU asked to end the simulation, which is no failure; `reached` [s] is the time to which it came.

    readable: its outputs hold for that time
    """

    def __init__(self, component: str, reached: float, reason: str, *, readable: bool = False) -> None:
        super().__init__(component, reached, reason)
        self.reached, self.readable = reached, readable

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), readable=self.readable), (self.component, self.reached, self.reason)


@dataclass(frozen=True)
class Signal:
    """An input or output: its name, its unit, and what the unit is in SI (None where undefined).

    kind:     its type by FMI's name, "" of a number that is no FMU's
    items:    name → number, of an enumeration, whose type's name is `declared`
    array:    of an element, the array's name
    local:    recorded on request; no output, so it is not connected
    relative: a difference, such as of temperatures: a unit's offset is of no matter
    """

    name: str
    unit: str = ""
    definition: tuple[float, ...] | None = None
    kind: str = ""
    items: Mapping[str, int] | None = None
    array: str = ""
    local: bool = False
    relative: bool = False
    declared: str = ""

    @property
    def whole(self) -> bool:
        """Its values are whole numbers."""
        return self.kind not in {"", "Real", "Float32", "Float64"}

    def conversion(self, to: Signal) -> tuple[float, float] | None:
        """Factor and offset from a value in this unit to one in the other's; None where the dimensions differ."""
        if not self.unit or not to.unit or self.unit == to.unit:
            return 1.0, 0.0
        here, there = self._meaning(), to._meaning()
        if here is None or there is None or here[:-2] != there[:-2]:
            return None
        offset = 0.0 if self.relative and to.relative else (here[-1] - there[-1]) / there[-2]
        return here[-2] / there[-2], offset

    def _meaning(self) -> tuple[float, ...] | None:
        """SI exponents, factor and offset: as the FMU defines the unit, else as people write it."""
        if self.definition is not None:
            return self.definition
        unit = parse(self.unit)
        return None if unit is None else (*(float(unit.exponents.get(n, 0)) for n in SI), unit.factor, unit.offset)


class Component(Protocol):
    """Call sequence: bind, open, (put, get)* while initializing, start, then (put, advance, get)* and close.

    inputs are written to `row[first:]` by the master, outputs by the component right behind them; those whose
    values no double holds exactly (text, 64-bit integers) stand likewise in `beside[first_beside:]`.
    """

    name: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    exact_inputs: tuple[Signal, ...]
    exact_outputs: tuple[Signal, ...]
    nominal_step: bool  # its steps are of one length; else each ends at the very number at which the next begins

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        """Does an output, of all or of some, at a time depend on this input at the same time? None: not declared."""

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Tell where in the row, and beside it, the component's signals stand, inputs first."""

    def open(self, start: float, stop: float) -> None:
        """Get ready: start values set, initialization begun."""

    def start(self) -> None:
        """End initialization."""

    def put(self) -> None:
        """Take the inputs from the row."""

    def get(self) -> None:
        """Write the outputs to the row."""

    def advance(self, t: float, h: float) -> None:
        """Step from `t` to `t + h` [s]; EndedEarly where the component ends the simulation."""

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        """What puts, advances by h from t and gets, once it has started: `in_turn`, or the same, faster."""

    def close(self) -> None:
        """Free everything; may be called at any time, more than once."""


def in_turn(
    component: Component, doing: MutableSequence[int], first: int, *, puts: bool = True
) -> Callable[[float, float], None]:
    """Put (where some input is connected), advance, get; `first` + PUT, ADVANCE, GET stand in `doing` before each."""
    put, advance, get = component.put, component.advance, component.get
    putting, advancing, getting = first + PUT, first + ADVANCE, first + GET

    def step(t: float, h: float) -> None:
        if puts:
            doing[0] = putting
            put()
        doing[0] = advancing
        advance(t, h)
        doing[0] = getting
        get()

    return step
