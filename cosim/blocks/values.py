"""Transfer of values by type between an FMU instance, the row and the storage beside the row.

The FMU reads and writes doubles in the row itself; all other types pass through a buffer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from cosim.blocks.component import PUT, Row
from cosim.blocks.instance import Instance
from cosim.blocks.stepping import Move, Plan, StopReason, move
from cosim.blocks.variable_access import Ports
from cosim.core.errors import NotFinite, SimulationError
from cosim.fmi.fmi_types import Exchange, element_names, elements, input_aliases, negative


class Values:
    """Values put into and read from an instance; call `bind` and `look_up` first.

    Attributes:
        watched: Last inputs of model exchange, because unchanged inputs cause no event.
        readable: Whether outputs can be read.
    """

    def __init__(self, instance: Instance, ports: Ports) -> None:
        self.instance, self.ports = instance, ports
        self._calls = instance.calls
        self.watched: list[Any] | None = None
        self.readable = False
        self._variables = {v.name: v for v in instance.description.modelVariables}
        self._aliases = input_aliases(instance.description)

    def bind(self, row: Row, first: int, beside: list[Any] | None, first_beside: int) -> None:
        """Set the places of the signals, inputs first."""
        exact = len(self.ports.exact_inputs) + len(self.ports.exact_outputs)
        self.row, self._beside = row, [None] * exact if beside is None else beside
        self.ports.place(row, first, first_beside)

    def look_up(self) -> None:
        """Look up the functions that set and get values of the new instance."""
        exchanges = (*self.ports.inward, *self.ports.read)
        self._setters, self._getters = ({e: self._function(verb, e) for e in exchanges} for verb in ("Set", "Get"))

    def _function(self, verb: str, exchange: Exchange) -> partial[int]:
        """Return a C function with its arguments, or one of FMPy for binary values."""
        if exchange.kind.ctype is None:
            return partial(self._move_binary, verb, exchange)
        prepared, name = self._calls.prepared, f"{verb}{exchange.kind.function}"
        return prepared(self._calls.exchange, name, self.instance.component, *exchange.arguments)

    def _move_binary(self, verb: str, exchange: Exchange) -> int:
        with self.instance.check_calls():
            if verb == "Set":
                self.instance.fmu.setBinary(exchange.vrs, exchange.buffer)
            else:
                exchange.buffer = self.instance.fmu.getBinary(exchange.vrs, exchange.count)
        return 0

    # -- all values --------------------------------------------------------------------------

    def put(self) -> None:
        """Set the inputs of the FMU, or only the changed inputs if changes are watched."""
        if self.watched is None:
            self.put_all()
            return
        values = [self.content(e) for e in self.ports.fed]
        with self.instance.check_calls():
            has_changed, self.watched = values != self.watched, values
            self._calls.inputs_changed(self.put_all if has_changed else None)

    def put_all(self) -> None:
        """Set all connected inputs, without an event."""
        for exchange in self.ports.fed:
            self.put_in(exchange)

    def get(self) -> None:
        """Read outputs and recorded variables; raise SimulationError if an output is not finite."""
        if self.readable:
            for exchange in self.ports.read:
                self.get_from(exchange)

    # -- single exchanges -------------------------------------------------------------------------

    def get_from(self, exchange: Exchange) -> None:
        """Read values of the FMU; raise SimulationError if an output is not finite."""
        if status := self._getters[exchange]():
            self.instance.judge(f"{self._calls.prefix}Get{exchange.kind.function}", status)
        if not exchange.is_direct:
            self._target(exchange)[exchange.places] = exchange.decode()
        if exchange.finite and not math.isfinite(sum(self.row[exchange.judged])):
            self._raise_not_finite(exchange)

    def content(self, exchange: Exchange) -> list[Any]:
        """Return the values of an exchange, from the row or beside it."""
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
        if status := self._setters[exchange]():
            self.instance.judge(f"{self._calls.prefix}Set{exchange.kind.function}", status)

    def set(self, values: Mapping[str, Any]) -> None:
        """Set variables; an array takes a list of values."""
        for name, value in values.items():
            variable = self._variables[name]
            exchange = Exchange(self.ports.kinds[variable.type], [variable])
            exchange.encode(value if isinstance(value, (list, tuple)) else [value] * exchange.count)
            if status := self._function("Set", exchange)():  # FMPy's own setters drop the status.
                self.instance.judge(f"{self._calls.prefix}Set{exchange.kind.function} of {name}", status)

    def show(self, values: Mapping[str, Any], *, readable: bool) -> None:
        """Store the set values of inputs in the row, else their start values; FMUs need not let inputs be read.

        Args:
            readable: Whether inputs without a start value can be read.
        """
        values = self._with_aliases(values)
        for exchange in self.ports.inward:
            try:
                content = [
                    x for v in exchange.variables for x in elements(exchange.kind, v, values.get(v.name, v.start))
                ]
            except (TypeError, ValueError):  # No start value, or none of its type.
                if readable:
                    try:
                        self.get_from(exchange)
                        continue
                    except SimulationError:
                        if self.instance.fmu is None:
                            raise
                content = [exchange.kind.nothing] * exchange.count
            self._target(exchange)[exchange.places] = content

    def show_outputs(self, exchanges: Sequence[Exchange]) -> None:
        """Store the start values of variables that have no value until an event; without one, zero or no text."""
        for exchange in exchanges:
            nothing = exchange.kind.nothing
            values = ((v, nothing if v.start is None else v.start) for v in exchange.variables)
            self._target(exchange)[exchange.places] = [
                x for v, value in values for x in elements(exchange.kind, v, value)
            ]

    def show_changes(self, values: Mapping[str, Any]) -> None:
        """Store the values that an event has set for unconnected inputs in the row."""
        values = self._with_aliases(values)
        for exchange in self.ports.unfed:
            place = exchange.places.start
            for variable in exchange.variables:
                end = place + len(element_names(variable))
                if variable.name in values:
                    self._target(exchange)[place:end] = elements(exchange.kind, variable, values[variable.name])
                place = end

    def _with_aliases(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values with those of the other inputs of their value references."""
        shown = dict(values)
        for name in values:
            kind = self._variables[name].type
            for alias, is_negative in self._aliases.get(name, {}).items():
                if alias not in values:
                    shown[alias] = negative(kind, values[name]) if is_negative else values[name]
        return shown

    def _target(self, exchange: Exchange) -> Any:
        return self._beside if exchange.kind.beside else self.row

    def _raise_not_finite(self, exchange: Exchange) -> None:
        """Raise SimulationError for the first output that is not finite."""
        for name, value in zip(exchange.names, self.row[exchange.judged], strict=False):
            if not math.isfinite(value):
                raise NotFinite(
                    f"{self.instance.name}.{name}",
                    self.instance.time,
                    f"the value is {value}, which is no finite number; check the component's inputs and parameters, or "
                    "take a shorter step",
                )

    # -- moved by C ---------------------------------------------------------------------------

    def moves(self) -> tuple[list[Move], list[Move]] | None:
        """Return C's calls to put and get values; None if values beside the row exist."""
        ports = self.ports
        if any(exchange.kind.beside for exchange in (*ports.fed, *ports.read)):
            return None
        puts = [move(self._setters[e].func, e, self.row) for e in ports.fed]
        gets = [move(self._getters[e].func, e, self.row) for e in ports.read]
        return puts, gets

    def raise_error(self, reason: StopReason, plan: Plan) -> None:
        """Raise the error of a transfer by C; warnings are only logged."""
        fed, read = self.ports.fed, self.ports.read
        if reason == StopReason.NOT_FINITE:
            self._raise_not_finite(read[plan.moving])
        elif reason == StopReason.UNFIT:
            self.put_in(fed[plan.moving])
        else:
            verb, exchanges = ("Set", fed) if plan.called == PUT else ("Get", read)
            self.instance.judge(f"{self._calls.prefix}{verb}{exchanges[plan.moving].kind.function}", plan.status)
