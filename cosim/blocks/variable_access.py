"""Variables of an FMU to transfer, their calls, and their places in the row and beside the row."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from typing import Any

from cosim.blocks.component import Row, Signal
from cosim.fmi.description import enumeration_items, is_difference, unit_definition, unit_of
from cosim.fmi.fmi_types import Exchange, element_names, is_negated, kinds_of


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
        fed, unfed, outputs, others = list[Any](), list[Any](), list[Any](), list[Any]()
        seen = set[str]()
        for v in description.modelVariables:
            if v.type not in self.kinds or v.name in seen:  # a name that stands twice means its first variable
                continue
            seen.add(v.name)
            if v.causality == "output":
                outputs.append(v)
            elif v.causality != "input":
                others += [v] if v.name in recorded else []
            elif not connected.isdisjoint({v.name, *element_names(v)}):
                fed.append(v)
            elif v.name not in optional:
                unfed.append(v)
        self.fed, self.unfed = self._exchanges(fed), self._exchanges(unfed)
        self.read = self._exchanges([*outputs, *others], {name for v in outputs for name in element_names(v)})
        self.inward = (*self.fed, *self.unfed)
        self.inputs = self._signals(self.inward, beside=False) + self.clock_inputs
        self.exact_inputs = self._signals(self.inward, beside=True)
        self.outputs = self._signals(self.read, beside=False) + self.clock_outputs
        self.exact_outputs = self._signals(self.read, beside=True)

    def place(self, row: Row, first: int, first_beside: int) -> None:
        """Assign places to all exchanges, inputs first."""
        place = {False: first, True: first_beside}
        for exchanges in (self.inward, self.read):
            for exchange in exchanges:
                begin = place[exchange.kind.beside]
                exchange.places = slice(begin, begin + exchange.count)
                exchange.judged = slice(begin, begin + exchange.finite)
                if exchange.is_direct:
                    exchange.move_by((ctypes.c_double * exchange.count).from_buffer(row, 8 * begin))
                place[exchange.kind.beside] += exchange.count
            if exchanges is self.inward:
                place[False] += len(self.clock_inputs)

    def _exchanges(self, variables: Iterable[Any], outputs: Iterable[str] = ()) -> tuple[Exchange, ...]:
        """Return an exchange per type, part and sign, doubles first."""
        groups: dict[tuple[Any, Hashable], list[Any]] = {}
        for variable in variables:
            part = self._part(variable), is_negated(variable)
            groups.setdefault((self.kinds[variable.type], part), []).append(variable)
        exchanges = (Exchange(kind, group, {*outputs}) for (kind, _), group in groups.items())
        return tuple(sorted(exchanges, key=lambda exchange: exchange.kind.ctype is not ctypes.c_double))

    def _signals(self, exchanges: Iterable[Exchange], *, beside: bool) -> tuple[Signal, ...]:
        """Return the signals in the row, or beside the row."""
        signals = []
        for v in (v for e in exchanges if e.kind.beside == beside for v in e.variables):
            unit, declared = unit_of(v), v.declaredType
            items = enumeration_items(v) if v.type == "Enumeration" and declared else None
            signal = Signal(
                v.name,
                unit,
                unit_definition(self.description, unit),
                v.type,
                items,
                v.name if v.shape else "",
                v.causality not in {"input", "output"},
                is_difference(v),
                declared.name if items is not None else "",
                v.variability not in (None, "continuous"),
            )
            signals += [replace(signal, name=name) for name in element_names(v)]
        return tuple(signals)
