"""Transfer of values by type between an FMU instance, the row and the storage beside the row.

Reals move directly to and from the row, all other types through a buffer.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from typing import Any

from cosim.base.errors import NotFinite, SimulationError
from cosim.blocks.component import PUT, Row
from cosim.blocks.fmi_types import Exchange, as_bytes, element_names, elements, input_aliases, named_bytes, negative
from cosim.blocks.instance import Instance
from cosim.blocks.stepping import Move, Plan, StopReason, move
from cosim.blocks.variable_access import Ports

Arguments = tuple[Any, ...]  # arguments of a function moving doubles directly


class Values:
    """Values put into and read from an instance; call `bind` and `look_up` first.

    Attributes:
        watched: Last inputs of model exchange, because unchanged inputs cause no event.
    """

    def __init__(self, instance: Instance, ports: Ports) -> None:
        self.instance, self.ports = instance, ports
        self._calls, self._fmi3 = instance.calls, ports.fmi3
        prefix, real = instance.calls.prefix, "Float64" if ports.fmi3 else "Real"
        self.setter, self.getter = f"{prefix}Set{real}", f"{prefix}Get{real}"
        self.watched: list[Any] | None = None
        self._variables = {v.name: v for v in instance.description.modelVariables}
        self._aliases = input_aliases(instance.description)

    def bind(self, row: Row, first: int, beside: list[Any] | None, first_beside: int) -> None:
        """Set the places of the signals, inputs first."""
        ports, address = self.ports, ctypes.addressof(row)
        exact = len(ports.exact_inputs) + len(ports.exact_outputs)
        self.row, self._beside = row, [None] * exact if beside is None else beside
        ports.place(first, first_beside)
        self._put_arguments, self._other_puts = ports.split(ports.fed, address)
        self._reading = ports.split(ports.read, address)
        self.out, self._finite = ports.real_outputs()

    def look_up(self) -> None:
        """Look up the C functions that set and get values of the new instance."""
        calls, self._component = self._calls, self.instance.component
        real = "Float64" if self._fmi3 else "Real"
        self._set_real, self._get_real = (calls.bare(calls.exchange, f"{verb}{real}") for verb in ("Set", "Get"))
        kinds = {e.kind.function for e in (*self.ports.inward, *self.ports.read) if e.buffer is not None}
        self._getters = {kind: calls.bare(calls.exchange, f"Get{kind}") for kind in kinds}
        self._setters = {kind: calls.bare(calls.exchange, f"Set{kind}") for kind in kinds}

    def allow_reading(self, allowed: bool) -> None:
        """Enable or disable reading of outputs."""
        self._get_arguments, self._other_gets = self._reading if allowed else (None, ())

    # -- all values --------------------------------------------------------------------------

    def put(self) -> None:
        """Set the inputs of the FMU, or only the changed inputs if changes are watched."""
        if self.watched is not None:
            self._put_if_changed()
        elif self.ports.fed:
            self.put_all()

    def get(self) -> None:
        """Read outputs and recorded variables; raise SimulationError if an output is not finite."""
        arguments = self._get_arguments
        if arguments is not None:
            status = self._get_real(self._component, *arguments)
            if status:
                self.instance.judge(self.getter, status)
            values = self.row[self.out]
            if not math.isfinite(sum(values)):
                self.raise_not_finite(values)
        if self._other_gets:
            for exchange in self._other_gets:
                self.get_from(exchange)

    @property
    def direct_arguments(self) -> tuple[Arguments | None, Arguments] | None:
        """Return the arguments of the C calls that set and get doubles; None if variables of other types occur.

        The first part is None without connected inputs.
        """
        if self._other_puts or self._other_gets or self._get_arguments is None:
            return None
        return self._put_arguments, self._get_arguments

    def _put_if_changed(self) -> None:
        values = [self.content(e) for e in self.ports.fed]
        with self.instance.check_calls():
            has_changed, self.watched = values != self.watched, values
            self._calls.inputs_changed(self.put_all if has_changed else None)

    def put_all(self) -> None:
        """Set all connected inputs, without an event."""
        if self._put_arguments is not None:
            status = self._set_real(self._component, *self._put_arguments)
            if status:
                self.instance.judge(self.setter, status)
        for exchange in self._other_puts:
            self.put_in(exchange)

    # -- single exchanges -------------------------------------------------------------------------

    def read_in(self, exchange: Exchange) -> None:
        """Read values of the FMU."""
        function = exchange.kind.function
        if exchange.buffer is None:
            with self.instance.check_calls():
                values = self.instance.fmu.getBinary(exchange.vrs, exchange.count)
                self._target(exchange)[exchange.places] = [v or b"" for v in values]  # None: NULL, no bytes
            return
        status = self._getters[function](self._component, *exchange.arguments(self._fmi3))
        if status:
            self.instance.judge(f"{self._calls.prefix}Get{function}", status)
        self._target(exchange)[exchange.places] = exchange.decode()

    def get_from(self, exchange: Exchange) -> None:
        """Read values of the FMU; raise SimulationError if an output is not finite."""
        self.read_in(exchange)
        self._check_finite(exchange)

    def content(self, exchange: Exchange) -> list[Any]:
        """Return the values of an exchange, from the row or beside it."""
        values: list[Any] = self._target(exchange)[exchange.places]
        return values

    def put_in(self, exchange: Exchange) -> None:
        """Write values to the FMU."""
        function, values = exchange.kind.function, self.content(exchange)
        try:
            if exchange.buffer is None:
                binaries = [named_bytes(name, v) for name, v in zip(exchange.names, values, strict=True)]
                with self.instance.check_calls():
                    self.instance.fmu.setBinary(exchange.vrs, binaries)
                return
            exchange.encode(values)
        except ValueError as error:
            name, _, reason = str(error).partition(": ")
            component = f"{self.instance.name}.{name}"
            raise SimulationError(
                component,
                self.instance.time,
                f"the input {reason}, the range of its type; scale or limit the value connected to it",
            ) from None
        status = self._setters[function](self._component, *exchange.arguments(self._fmi3))
        if status:
            self.instance.judge(f"{self._calls.prefix}Set{function}", status)

    def set(self, values: Mapping[str, Any]) -> None:
        """Set variables; an array takes a list of values."""
        for name, value in values.items():
            variable = self._variables[name]
            exchange = Exchange(self.ports.kinds[variable.type], [variable])
            scalars = value if isinstance(value, (list, tuple)) else [value] * exchange.count
            function = exchange.kind.function
            if exchange.buffer is None:
                self.instance.fmu.setBinary(exchange.vrs, [as_bytes(v) for v in scalars])
                continue
            exchange.encode(scalars)
            # FMPy's own setters drop the status.
            setter = self._calls.bare(self._calls.exchange, f"Set{function}")
            if status := setter(self._component, *exchange.arguments(self._fmi3)):
                self.instance.judge(f"{self._calls.prefix}Set{function} of {name}", status)

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
                if readable and self._can_read(exchange):
                    continue
                content = [exchange.kind.nothing] * exchange.count
            self._target(exchange)[exchange.places] = content

    def _can_read(self, exchange: Exchange) -> bool:
        """Read values of inputs; return whether the FMU gave them."""
        try:
            self.read_in(exchange)
        except SimulationError:
            if self.instance.fmu is None:
                raise
            return False
        return True

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
                    content = elements(exchange.kind, variable, values[variable.name])
                    self._target(exchange)[slice(place, end)] = content
                place = end

    def _with_aliases(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values with those of the other inputs of their value references."""
        found = dict(values)
        for name in values:
            kind = self._variables[name].type
            for alias, is_negative in self._aliases.get(name, {}).items():
                if alias not in values:
                    found[alias] = negative(kind, values[name]) if is_negative else values[name]
        return found

    def _target(self, exchange: Exchange) -> Any:
        return self._beside if exchange.kind.beside else self.row

    # -- finite values --------------------------------------------------------------------------

    def raise_not_finite(self, values: Sequence[float], names: Sequence[str] | None = None) -> None:
        """Raise SimulationError for a non-finite output."""
        for name, value in zip(self._finite if names is None else names, values, strict=True):
            if not math.isfinite(value):
                component = f"{self.instance.name}.{name}"
                raise NotFinite(
                    component,
                    self.instance.time,
                    (
                        f"the value is {value}, which is no finite number; check the component's inputs and "
                        "parameters, or take a shorter step"
                    ),
                )

    def _finite_of(self, exchange: Exchange) -> tuple[str, ...]:
        """Return scalars that must be finite: leading float outputs."""
        return self.ports.outputs_of(exchange) if exchange.kind.ctype in (ctypes.c_double, ctypes.c_float) else ()

    def _check_finite(self, exchange: Exchange) -> None:
        if names := self._finite_of(exchange):
            first = exchange.places.start
            self.raise_not_finite(self.row[first : first + len(names)], names)

    # -- moved by C ---------------------------------------------------------------------------

    def moves(self) -> tuple[list[Move], list[Move]] | None:
        """Return C's calls to put and get values; None if values beside the row exist."""
        ports = self.ports
        if any(exchange.kind.beside for exchange in (*ports.fed, *ports.read)):
            return None
        puts = [move(self._setters[e.kind.function], e, self.row) for e in ports.fed]
        gets = [move(self._getters[e.kind.function], e, self.row, len(self._finite_of(e))) for e in ports.read]
        return puts, gets

    def raise_error(self, reason: StopReason, plan: Plan) -> None:
        """Raise the error of a transfer by C; warnings are only logged."""
        fed, read = self.ports.fed, self.ports.read
        if reason == StopReason.NOT_FINITE:
            self._check_finite(read[plan.moving])
        elif reason == StopReason.UNFIT:
            self.put_in(fed[plan.moving])
        else:
            verb, exchanges = ("Set", fed) if plan.called == PUT else ("Get", read)
            self.instance.judge(f"{self._calls.prefix}{verb}{exchanges[plan.moving].kind.function}", plan.status)
