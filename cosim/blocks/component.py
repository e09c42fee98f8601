"""Interface between the master and its components."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, MutableSequence
from dataclasses import dataclass
from typing import Any

from cosim.core.errors import SimulationError
from cosim.core.units import SI, definition_of

Row = ctypes.Array[ctypes.c_double]
PUT, ADVANCE, GET = range(3)  # numbers of calls in `doing`


class EarlyEnd(SimulationError):
    """End of a simulation at time `reached` [s], requested by an FMU. It is not a failure.

    Attributes:
        readable: True if the outputs are valid at that time.
    """

    def __init__(self, component: str, reached: float, reason: str, *, readable: bool = False) -> None:
        super().__init__(component, reached, reason)
        self.reached, self.readable = reached, readable


@dataclass(frozen=True)
class Signal:
    """An input or output with its unit.

    Attributes:
        definition: SI exponents, factor and offset of the unit; None if undefined.
        kind: FMI type name; "" for a number outside FMUs.
        items: Name → number of an enumeration; its type name is `declared`.
        array: Name of the array that contains this element; "" for a scalar.
        local: True for a signal that is recorded and cannot be connected.
        relative: True for a difference, to which offsets of units do not apply.
        discrete: True if the value is constant between events, by its declared variability.
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
    discrete: bool = False

    @property
    def is_whole(self) -> bool:
        """Return True if all values of the signal's type are integers."""
        return self.kind not in {"", "Real", "Float32", "Float64"}

    def conversion(self, to: Signal) -> tuple[float, float] | None:
        """Return factor and offset to another signal's unit. None: the dimensions differ.

        Units are compared by definition, because two FMUs may define a name differently. If only one side defines a
        unit, the same name on the other side means the same unit.
        """
        is_same_name = self.unit == to.unit
        if not self.unit or not to.unit or (is_same_name and None in (self.definition, to.definition)):
            return 1.0, 0.0
        # The FMU's definition takes precedence over common units.
        here, there = (s.definition or definition_of(s.unit) for s in (self, to))
        if here is None or there is None:
            return None
        powers = len(SI) - is_same_name  # some tools omit rad in units with angles
        if here == there or here[:powers] != there[:powers]:
            return (1.0, 0.0) if here == there else None
        offset = 0.0 if self.relative and to.relative else (here[-1] - there[-1]) / there[-2]
        return here[-2] / there[-2], offset


class Component:
    """A component, called in order: bind, open, (put, get)* during initialization, start, (put, advance, get)*, close.

    The master writes inputs to `row[first:]`; the component writes outputs directly behind them. Values beyond the
    exact range of doubles (text, 64-bit integers) use `beside[first_beside:]` in the same way.

    The default methods suit a component whose signals are all in the row and whose `get` or `advance` reads the inputs.

    Attributes:
        nominal_step: True if all steps have the same length; otherwise each step ends exactly at the start time of the
            next.
        saves: True if `checkpoint` returns a state; otherwise a resumed run repeats all steps.
    """

    name: str
    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...]
    exact_inputs: tuple[Signal, ...] = ()
    exact_outputs: tuple[Signal, ...] = ()
    nominal_step: bool = True

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        """Return True if an output depends directly on an input (direct feedthrough).

        Args:
            outputs: Outputs to consider; None for all.

        Returns:
            True or False; None if the FMU declares no dependencies.
        """

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the indices of the signals in the row and beside it, inputs first."""
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        """Set start values and begin initialization."""

    def start(self) -> None:
        """End initialization."""

    def put(self) -> None:
        """Read the inputs from the row."""

    def get(self) -> None:
        """Write the outputs to the row."""

    def advance(self, t: float, h: float) -> None:
        """Step from `t` to `t + h` [s]; raise EarlyEnd if the component ends the simulation."""

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        """Return a function of (t, h) for a step: put the inputs, advance by h, get the outputs.

        The function, which is `in_turn` or a faster equivalent, is valid after `start`.
        """
        return in_turn(self, doing, first, puts=False)

    def close(self) -> None:
        """Free all resources; repeated calls are harmless."""

    @property
    def saves(self) -> bool:
        return type(self).checkpoint is not Component.checkpoint

    def checkpoint(self) -> Any:
        """Return the state as JSON types and bytes; None if this is impossible."""

    def restore(self, state: Any) -> None:
        """Restore a state from `checkpoint`, perhaps of another process; called after initialization."""


def in_turn(
    component: Component, doing: MutableSequence[int], first: int, *, puts: bool = True
) -> Callable[[float, float], None]:
    """Return a function of (t, h) that puts the inputs, advances and gets the outputs.

    Before each call `doing[0]` becomes `first` + PUT, ADVANCE or GET.

    Args:
        puts: True if any input is connected.
    """
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


def without_step(component: Component, doing: MutableSequence[int], first: int) -> Callable[[], None]:
    """Return a function that puts the inputs and gets the outputs, without a step between."""

    def exchange() -> None:
        doing[0] = first + PUT
        component.put()
        doing[0] = first + GET
        component.get()

    return exchange
