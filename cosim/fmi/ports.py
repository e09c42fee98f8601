"""FMI variables as data, for slaves at run time and for model descriptions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from cosim.model.model import Model
from cosim.model.quantities import INFINITY, Parameter, Quantity, parameters_of

Value = float | bool | str
Kind = Literal["Real", "Boolean", "String"]
Causality = Literal["input", "output", "parameter"]


@dataclass(frozen=True)
class Port:
    """An FMI variable; its index in the tuple of ports is its value reference.

    Attributes:
        optional: Whether the input may stay unconnected without record or warning.
    """

    name: str
    causality: Causality
    start: Value
    unit: str = ""
    doc: str = ""
    bounds: tuple[float, float] = (-INFINITY, INFINITY)
    optional: bool = False

    @property
    def kind(self) -> Kind:
        """Return the FMI type of the start value."""
        return "Boolean" if isinstance(self.start, bool) else "String" if isinstance(self.start, str) else "Real"


def parameter_port(p: Parameter, start: Value, prefix: str = "") -> Port:
    """Return the FMU variable of a model parameter, with its start value."""
    return Port(prefix + p.name, "parameter", start, p.unit, p.doc, p.bounds)


def quantity_port(q: Quantity, causality: Causality, start: float | None = None, name: str | None = None) -> Port:
    """Return the port of a signal or of a start value."""
    return Port(name or q.name, causality, q.start if start is None else start, q.unit, q.doc)


def with_starts(ports: Iterable[Port], values: Mapping[str, Value]) -> tuple[Port, ...]:
    """Return ports with other start values, by name."""
    return tuple(replace(port, start=values.get(port.name, port.start)) for port in ports)


def model_ports(model: Model) -> tuple[Port, ...]:
    """Return all variables of a model.

    Order: inputs, outputs, parameters, effects, start values.
    """
    return (*_signals(model), *_parameters(model), *_starts(model))


def _signals(model: Model) -> Iterator[Port]:
    for q, start in zip(model.inputs, model.start_command(), strict=True):
        yield quantity_port(q, "input", start)
    for q in model.outputs:
        yield quantity_port(q, "output")


def _parameters(model: Model) -> Iterator[Port]:
    for p in model.parameters:
        yield parameter_port(p, getattr(model, p.name))
    present: dict[type, Any] = {type(e): e for e in model.effects}
    for kind in model.catalogue:
        effect = present.get(kind) or kind()
        for p in parameters_of(kind):
            yield parameter_port(p, getattr(effect, p.name), f"{kind.name}.")


def _starts(model: Model) -> Iterator[Port]:
    starts, command = model.start_state(), dict(zip((q.name for q in model.inputs), model.start_command(), strict=True))
    for q in model.base_states:
        yield Port(f"{q.name}_start", "parameter", starts.get(q.name, q.start), q.unit, f"start value: {q.doc}")
    for kind in model.catalogue:
        for q in (*kind.states, *kind.memory):
            start = command.get(q.name, q.start) if q in kind.memory else q.start
            yield Port(f"{kind.name}.{q.name}_start", "parameter", start, q.unit, f"start value: {q.doc}")
