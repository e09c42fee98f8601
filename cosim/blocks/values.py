"""Variables of an FMU: their indices in and beside the row, and the transfer of values by type.

The FMU reads and writes doubles in the row itself; all other types pass through a buffer.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from cosim.blocks.component import PUT, Component, Row, Signal
from cosim.blocks.instance import Instance
from cosim.blocks.stepping import Move, Slot, StopReason, move
from cosim.core.errors import NotFinite, SimulationError
from cosim.fmi.description import enumeration_items, is_difference, unit_definition, unit_of
from cosim.fmi.fmi_types import Exchange, element_names, elements, input_aliases, is_negated, kinds_of, negative


class FmuVariables(Component):
    """A component that sets inputs, and gets outputs and recorded variables, of an FMU instance.

    Order of calls: `list_variables`, `bind`, `look_up` for each new instance, then methods for values.

    Attributes:
        fed: Connected inputs.
        unfed: Unconnected inputs.
        read: Variables to read after each step: outputs, then recorded variables.
        inward: Variables to set: all inputs except unconnected optional ones.
        variables: All variables by name.
        clock_inputs: Triggered input clocks. The row contains their numbers of ticks after the inputs.
        clock_outputs: All other clocks. The row contains their numbers of ticks after the outputs.
        watched: Last inputs in model exchange, where unchanged inputs cause no event; otherwise None.
        readable: True if outputs can be read.
    """

    instance: Instance
    watched: list[Any] | None = None
    readable = False

    def list_variables(
        self,
        connected: frozenset[str],
        recorded: frozenset[str],
        optional: frozenset[str] = frozenset(),
        *,
        part: Callable[[Any], Hashable] = lambda variable: None,
        clocks: tuple[tuple[Signal, ...], tuple[Signal, ...]] = ((), ()),
    ) -> None:
        """Determine the variables to set and get, and their signals.

        Args:
            part: Function of a variable. Variables with different results are set and read by separate calls.
            clocks: Signals of triggered input clocks, and of all other clocks.
        """
        description = self.instance.description
        self.clock_inputs, self.clock_outputs = clocks
        self.variables: dict[str, Any] = {}
        for v in description.modelVariables:  # if a name occurs twice, the first variable counts
            self.variables.setdefault(v.name, v)
        self._aliases = input_aliases(description)
        self.kinds = kinds_of(description.fmiVersion)
        movable = [v for v in self.variables.values() if v.type in self.kinds]
        inputs, outputs = ([v for v in movable if v.causality == kind] for kind in ("input", "output"))
        others = [v for v in movable if v.name in recorded and v.causality not in {"input", "output"}]
        fed = [v for v in inputs if not connected.isdisjoint({v.name, *element_names(v)})]
        left_out = {v.name for v in fed} | optional

        def exchanges(variables: Iterable[Any], outputs: Iterable[str] = ()) -> tuple[Exchange, ...]:
            """Return one exchange per type, part and sign, doubles first."""
            groups: dict[tuple[Any, Hashable], list[Any]] = {}
            for variable in variables:
                key = self.kinds[variable.type], (part(variable), is_negated(variable))
                groups.setdefault(key, []).append(variable)
            every = (Exchange(kind, group, {*outputs}) for (kind, _), group in groups.items())
            return tuple(sorted(every, key=lambda exchange: exchange.kind.ctype is not ctypes.c_double))

        self.fed, self.unfed = exchanges(fed), exchanges(v for v in inputs if v.name not in left_out)
        self.read = exchanges([*outputs, *others], {name for v in outputs for name in element_names(v)})
        self.inward = (*self.fed, *self.unfed)
        self.inputs = self._signals(self.inward, beside=False) + self.clock_inputs
        self.exact_inputs = self._signals(self.inward, beside=True)
        self.outputs = self._signals(self.read, beside=False) + self.clock_outputs
        self.exact_outputs = self._signals(self.read, beside=True)

    def _signals(self, exchanges: Iterable[Exchange], *, beside: bool) -> tuple[Signal, ...]:
        """Return the signals stored in the row, or those stored beside it."""
        signals = []
        for v in (v for e in exchanges if e.kind.beside == beside for v in e.variables):
            unit, declared = unit_of(v), v.declaredType
            items = enumeration_items(v) if v.type == "Enumeration" and declared else None
            signal = Signal(
                v.name,
                unit,
                unit_definition(self.instance.description, unit),
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

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        self._row = row
        self._beside = [None] * (len(self.exact_inputs) + len(self.exact_outputs)) if beside is None else beside
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

    def bind_nothing(self) -> None:
        """Bind the signals to a row of this component's own."""
        self.bind((ctypes.c_double * max(1, len(self.inputs) + len(self.outputs)))(), 0)

    def look_up(self) -> None:
        """Look up the functions that set and get values of the new instance."""
        for exchange in (*self.inward, *self.read):
            exchange.set, exchange.get = self._function("Set", exchange), self._function("Get", exchange)

    def _function(self, verb: str, exchange: Exchange) -> partial[int]:
        """Return a C function that sets or gets an exchange, with its arguments; for binary values, FMPy's method."""
        if exchange.kind.ctype is None:
            return partial(self._move_binary, verb, exchange)
        return self.instance.prepared(f"{verb}{exchange.kind.function}", *exchange.arguments)

    def _move_binary(self, verb: str, exchange: Exchange) -> int:
        if verb == "Set":
            self.instance.call("setBinary", exchange.vrs, exchange.buffer)
        else:
            exchange.buffer = self.instance.call("getBinary", exchange.vrs, exchange.count)
        return 0

    def _judge(self, verb: str, exchange: Exchange, status: int, of: str = "") -> None:
        """Handle a status other than OK of a set or get call."""
        self.instance.judge(f"{self.instance.prefix}{verb}{exchange.kind.function}{of}", status)

    # -- all values --------------------------------------------------------------------------

    def put(self) -> None:
        """Set the inputs of the FMU; in model exchange, only if one of them has changed."""
        if self.watched is None:
            self.put_all()
            return
        values = [self.content(e) for e in self.fed]
        with self.instance.check_calls():
            has_changed, self.watched = values != self.watched, values
            self.instance.inputs_changed(self.put_all if has_changed else None)

    def put_all(self) -> None:
        """Set all connected inputs, without causing an event."""
        for exchange in self.fed:
            self.put_in(exchange)

    def get(self) -> None:
        """Read outputs and recorded variables; raise SimulationError if an output is not finite."""
        if self.readable:
            for exchange in self.read:
                self.get_from(exchange)

    # -- single exchanges -------------------------------------------------------------------------

    def get_from(self, exchange: Exchange) -> None:
        """Read values of the FMU; raise SimulationError if an output is not finite."""
        if status := exchange.get():
            self._judge("Get", exchange, status)
        if not exchange.is_direct:
            self._target(exchange)[exchange.places] = exchange.decode()
        if exchange.finite and not math.isfinite(sum(self._row[exchange.judged])):
            self._raise_not_finite(exchange)

    def content(self, exchange: Exchange) -> list[Any]:
        """Return the values of an exchange, from the row or from the storage beside it."""
        values: list[Any] = self._target(exchange)[exchange.places]
        return values

    def put_in(self, exchange: Exchange) -> None:
        """Write values to the FMU."""
        if not exchange.is_direct:
            try:
                exchange.encode(self.content(exchange))
            except ValueError as error:
                name, _, reason = str(error).partition(": ")
                raise SimulationError(
                    f"{self.instance.name}.{name}",
                    self.instance.time,
                    f"the input {reason}, the range of its type; scale or limit the value connected to it",
                ) from None
        if status := exchange.set():
            self._judge("Set", exchange, status)

    def set_variables(self, values: Mapping[str, Any]) -> None:
        """Set variables; an array takes a list of values."""
        for name, value in values.items():
            variable = self.variables[name]
            exchange = Exchange(self.kinds[variable.type], [variable])
            exchange.encode(value if isinstance(value, (list, tuple)) else [value] * exchange.count)
            if status := self._function("Set", exchange)():  # FMPy's setters do not return the status
                self._judge("Set", exchange, status, f" of {name}")

    def show(
        self,
        exchanges: Iterable[Exchange],
        values: Mapping[str, Any],
        *,
        readable: bool = False,
        completed: bool = False,
    ) -> None:
        """Store values, or else start values, in the row, because FMUs need not return inputs.

        Args:
            readable: True if variables without a start value can be read from the FMU.
            completed: Store zero or empty text for each single variable without a start value.
        """
        values = self._with_aliases(values)
        for exchange in exchanges:
            kind = exchange.kind
            default = kind.nothing if completed else None
            pairs = [(v, values.get(v.name, v.start)) for v in exchange.variables]
            try:
                shown = [x for v, value in pairs for x in elements(kind, v, default if value is None else value)]
            except (TypeError, ValueError):  # there is no start value, or it has another type
                shown = [kind.nothing] * exchange.count
                if readable:
                    try:
                        self.get_from(exchange)
                        continue
                    except SimulationError:
                        if self.instance.fmu is None:
                            raise
            self._target(exchange)[exchange.places] = shown

    def show_changes(self, values: Mapping[str, Any]) -> None:
        """Store the values that an event of the scenario has set for unconnected inputs in the row."""
        values = self._with_aliases(values)
        for exchange in self.unfed:
            place = exchange.places.start
            for variable in exchange.variables:
                end = place + len(element_names(variable))
                if variable.name in values:
                    self._target(exchange)[place:end] = elements(exchange.kind, variable, values[variable.name])
                place = end

    def _with_aliases(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values, and the resulting values of other inputs with the same value references."""
        shown = dict(values)
        for name in values:
            kind = self.variables[name].type
            for alias, is_negative in self._aliases.get(name, {}).items():
                if alias not in values:
                    shown[alias] = negative(kind, values[name]) if is_negative else values[name]
        return shown

    def _target(self, exchange: Exchange) -> Any:
        return self._beside if exchange.kind.beside else self._row

    def _raise_not_finite(self, exchange: Exchange) -> None:
        """Raise SimulationError for the first output that is not finite."""
        for name, value in zip(exchange.names, self._row[exchange.judged], strict=False):
            if not math.isfinite(value):
                raise NotFinite(
                    f"{self.instance.name}.{name}",
                    self.instance.time,
                    f"the value is {value}, not a finite number; check the component's inputs and parameters, or "
                    "use a shorter step",
                )

    # -- moved by C ---------------------------------------------------------------------------

    def moves(self, cells: Any) -> tuple[list[Move], list[Move]] | None:
        """Return C structures of the calls that set and get values; None if there are binary values.

        Args:
            cells: Values beside the row.
        """
        if any(exchange.kind.ctype is None for exchange in (*self.fed, *self.read)):
            return None
        puts = [move(e.set.func, e, self._row, cells) for e in self.fed]
        gets = [move(e.get.func, e, self._row, cells) for e in self.read]
        return puts, gets

    def raise_error_of_move(self, reason: StopReason, slot: Slot) -> None:
        """Raise the error of a set or get call in C; a warning is only logged."""
        if reason == StopReason.NOT_FINITE:
            self._raise_not_finite(self.read[slot.moving])
        elif reason == StopReason.UNFIT:
            self.put_in(self.fed[slot.moving])
        else:
            verb, exchanges = ("Set", self.fed) if slot.called == PUT else ("Get", self.read)
            self._judge(verb, exchanges[slot.moving], slot.status)
