"""Variables of an FMU to transfer, their calls, and their places in the row and beside the row."""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Any

from cosim.blocks.component import Signal
from cosim.blocks.description import enumeration_items, is_difference, unit_definition, unit_of
from cosim.blocks.fmi_types import Exchange, element_names, is_negated, kinds_of


class Ports:
    """Inputs, outputs and recorded variables of an FMU.

    Attributes:
        fed: Connected inputs.
        unfed: Unconnected inputs.
        read: Variables to read after each step: outputs, then recorded variables.
        inward: Variables to set: all inputs except unconnected optional ones.
        clock_inputs: Triggered clocks; their places, behind the inputs, hold the number of ticks.
        clock_outputs: All other clocks, likewise behind the outputs.

    Args:
        part: Function of a variable; variables of different parts are moved by calls of their own.
        clocks: Signals of triggered input clocks, and of all other clocks.
    """

    def __init__(
        self,
        description: Any,
        connected: frozenset[str],
        recorded: frozenset[str],
        optional: frozenset[str] = frozenset(),
        *,
        part: Callable[[Any], Hashable] = lambda variable: None,
        clocks: tuple[tuple[Signal, ...], tuple[Signal, ...]] = ((), ()),
    ) -> None:
        self.description, self._part = description, part
        self.clock_inputs, self.clock_outputs = clocks
        self.kinds, self.fmi3 = kinds_of(description.fmiVersion), description.fmiVersion.startswith("3")
        supported = [v for v in description.modelVariables if v.type in self.kinds]
        inputs = [v for v in supported if v.causality == "input" and v.name not in optional - connected]
        fed, unfed = list[Any](), list[Any]()
        for v in inputs:
            (unfed if connected.isdisjoint({v.name, *element_names(v)}) else fed).append(v)
        outputs = [v for v in supported if v.causality == "output"]
        others = [v for v in supported if v.name in recorded and v.causality not in {"input", "output"}]
        self._outputs = frozenset(itertools.chain.from_iterable(map(element_names, outputs)))
        self.fed = self._exchanges(fed)
        self.unfed = self._exchanges(unfed)
        self.read = self._exchanges([*outputs, *others])
        self.inward = (*self.fed, *self.unfed)
        self.inputs = self._signals(self.inward, beside=False) + self.clock_inputs
        self.exact_inputs = self._signals(self.inward, beside=True)
        self.outputs = self._signals(self.read, beside=False) + self.clock_outputs
        self.exact_outputs = self._signals(self.read, beside=True)

    def place(self, first: int, first_beside: int) -> None:
        """Assign places to all exchanges, inputs first."""
        place = {False: first, True: first_beside}
        for exchanges in (self.inward, self.read):
            for exchange in exchanges:
                begin = place[exchange.kind.beside]
                exchange.places = slice(begin, begin + exchange.count)
                place[exchange.kind.beside] += exchange.count
            if exchanges is self.inward:
                place[False] += len(self.clock_inputs)

    def split(self, exchanges: Sequence[Exchange], address: int) -> tuple[tuple[Any, ...] | None, tuple[Exchange, ...]]:
        """Return direct arguments for doubles, and the remaining exchanges.

        Args:
            address: Address of the row.
        """
        doubles = _doubles(exchanges)
        arguments = None if doubles is None else doubles.arguments(self.fmi3, address + 8 * doubles.places.start)
        return arguments, tuple(e for e in exchanges if e is not doubles)

    @staticmethod
    def c_arguments(arguments: Any) -> tuple[Any, ...]:
        """Return arguments as reusable C objects."""
        references, count, place, *scalars = arguments
        first = ctypes.c_void_p(references), ctypes.c_size_t(count), ctypes.c_void_p(place)
        return *first, *(ctypes.c_size_t(n) for n in scalars)

    def real_outputs(self) -> tuple[slice, tuple[str, ...]]:
        """Return places and names of necessarily finite outputs."""
        doubles = _doubles(self.read)
        if doubles is None:
            return slice(0, 0), ()
        names = self.outputs_of(doubles)
        return slice(doubles.places.start, doubles.places.start + len(names)), names

    def outputs_of(self, exchange: Exchange) -> tuple[str, ...]:
        """Return the leading scalars that are outputs."""
        return tuple(name for name in exchange.names if name in self._outputs)

    def _exchanges(self, variables: Iterable[Any]) -> tuple[Exchange, ...]:
        """Return an exchange per type, part and sign, doubles first."""
        groups: dict[tuple[Any, Hashable], list[Any]] = {}
        for variable in variables:
            part = self._part(variable), is_negated(variable)
            groups.setdefault((self.kinds[variable.type], part), []).append(variable)
        keys = sorted(groups, key=lambda key: key[0].ctype is not ctypes.c_double)
        return tuple(Exchange(key[0], groups[key]) for key in keys)

    def _signals(self, exchanges: Iterable[Exchange], *, beside: bool) -> tuple[Signal, ...]:
        """Return the signals in the row, or beside the row."""
        variables = (v for e in exchanges if e.kind.beside == beside for v in e.variables)
        return tuple(self._signal(v, name) for v in variables for name in element_names(v))

    def _signal(self, variable: Any, name: str) -> Signal:
        unit, declared = unit_of(variable), variable.declaredType
        items = enumeration_items(variable) if variable.type == "Enumeration" and declared else None
        relative = is_difference(variable)
        local = variable.causality not in {"input", "output"}
        array = variable.name if variable.shape else ""
        meaning = unit_definition(self.description, unit)
        type_name = declared.name if items is not None else ""
        discrete = variable.variability not in (None, "continuous")
        return Signal(name, unit, meaning, variable.type, items, array, local, relative, type_name, discrete)


def _doubles(exchanges: Iterable[Exchange]) -> Exchange | None:
    """Return the exchange that moves doubles to and from the row as they are."""
    return next((e for e in exchanges if e.kind.ctype is ctypes.c_double and not e.negated), None)
