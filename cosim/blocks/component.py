"""Interface between the master and its components."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, MutableSequence
from dataclasses import dataclass
from typing import Any

from cosim.core.errors import SimulationError
from cosim.core.units import SI, definition_of

Row = ctypes.Array[ctypes.c_double]
PUT, ADVANCE, GET = range(3)  # calls counted in `doing`


class EarlyEnd(SimulationError):
    """End of a simulation at time `reached` [s], requested by an FMU. It is not a failure.

    Attributes:
        readable: Whether the outputs are valid at that time.
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
        array: Name of the array of an element.
        local: Whether the signal is recorded only and cannot be connected.
        relative: Whether the signal is a difference, so that unit offsets do not count.
        discrete: Whether its value holds between events, by its declared variability.
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
        """Return whether all values are whole numbers."""
        return self.kind not in {"", "Real", "Float32", "Float64"}

    def conversion(self, to: Signal) -> tuple[float, float] | None:
        """Return factor and offset to another signal's unit. None means different dimensions.

        Units are compared by definition: the definitions of two FMUs may give one name different sizes. A unit that
        only one side defines is the same as one of its name on the other side.
        """
        is_same_name = self.unit == to.unit
        if not self.unit or not to.unit or (is_same_name and None in (self.definition, to.definition)):
            return 1.0, 0.0
        # The FMU's definition takes precedence over common units.
        here, there = (s.definition or definition_of(s.unit) for s in (self, to))
        if here is None or there is None:
            return None
        powers = len(SI) - is_same_name  # Tools write angles of one unit with rad and without dimension.
        if here == there or here[:powers] != there[:powers]:
            return (1.0, 0.0) if here == there else None
        offset = 0.0 if self.relative and to.relative else (here[-1] - there[-1]) / there[-2]
        return here[-2] / there[-2], offset


class Component:
    """A component, called in order: bind, open, (put, get)* during initialization, start, (put, advance, get)*, close.

    The master writes inputs to `row[first:]`; the component writes outputs directly behind them. Values beyond the
    exact range of doubles (text, 64-bit integers) use `beside[first_beside:]` in the same way.

    The methods with a body are those of a component with all its signals in the row, whose `get` or `advance` reads the
    inputs.

    Attributes:
        nominal_step: Whether steps have nominal length; else each step ends exactly at the start time of the next.
        saves: Whether `checkpoint` gives a state; otherwise a resumed run makes all steps again.
    """

    name: str
    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...]
    exact_inputs: tuple[Signal, ...] = ()
    exact_outputs: tuple[Signal, ...] = ()
    nominal_step: bool = True

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        """Return whether an output depends directly on an input.

        Args:
            outputs: Outputs to consider; None for all.

        Returns:
            None if the FMU declares no dependencies.
        """

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the places of the signals, inputs first."""
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

        The function is `in_turn` or a faster equivalent. It is valid after `start`.
        """
        return in_turn(self, doing, first, puts=False)

    def close(self) -> None:
        """Free all resources; repeated calls are harmless."""

    @property
    def saves(self) -> bool:
        return type(self).checkpoint is not Component.checkpoint

    def checkpoint(self) -> Any:
        """Return the state in JSON types and bytes, if possible."""

    def restore(self, state: Any) -> None:
        """Restore a state of another process, after initialization."""


def in_turn(
    component: Component, doing: MutableSequence[int], first: int, *, puts: bool = True
) -> Callable[[float, float], None]:
    """Return a function that puts, advances and gets.

    Before each call `doing[0]` becomes `first` + PUT, ADVANCE or GET.

    Args:
        puts: Whether any input is connected.
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
    """Return a function that puts and gets, as `in_turn` without advancing."""

    def exchange() -> None:
        doing[0] = first + PUT
        component.put()
        doing[0] = first + GET
        component.get()

    return exchange
