"""FMI variables as data, for slaves at run time and for model descriptions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from cosim.model.model import Model
from cosim.model.quantities import INFINITY, Parameter, parameters_of

Value = float | bool | str
Kind = Literal["Real", "Boolean", "String"]
Causality = Literal["input", "output", "parameter", "state", "derivative", "memory", "indicator"]


@dataclass(frozen=True)
class Port:
    """An FMI variable; its index in the tuple of ports is its value reference.

    Attributes:
        causality: FMI causality; for a local variable of a native FMU, the role of the variable (state, derivative,
            memory, …).
        optional: True if the input may stay unconnected without a warning and without an entry in the manifest.
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
    """Return the FMU variable for a model parameter, with a start value."""
    return Port(prefix + p.name, "parameter", start, p.unit, p.doc, p.bounds)


def with_starts(ports: Iterable[Port], values: Mapping[str, Value]) -> tuple[Port, ...]:
    """Return ports with the start values that `values` has under their names."""
    return tuple(replace(port, start=values.get(port.name, port.start)) for port in ports)


def model_ports(model: Model) -> tuple[Port, ...]:
    """Return all variables of a model.

    Order: inputs, outputs, parameters, parameters of effects, start values.
    """
    commands = dict(zip((q.name for q in model.inputs), model.start_command(), strict=True))
    ports = [Port(q.name, "input", commands[q.name], q.unit, q.doc) for q in model.inputs]
    ports += [Port(q.name, "output", q.start, q.unit, q.doc) for q in model.outputs]
    ports += [parameter_port(p, getattr(model, p.name)) for p in model.parameters]
    present: dict[type, Any] = {type(e): e for e in model.effects}
    for kind in model.catalogue:
        effect = present.get(kind) or kind()
        ports += [parameter_port(p, getattr(effect, p.name), f"{kind.name}.") for p in parameters_of(kind)]
    states = model.start_state()
    starts = [("", q, states.get(q.name, q.start)) for q in model.base_states]
    for kind in model.catalogue:
        starts += [(f"{kind.name}.", q, q.start) for q in kind.states]
        starts += [(f"{kind.name}.", q, commands.get(q.name, q.start)) for q in kind.memory]  # past inputs
    for prefix, q, start in starts:
        ports.append(Port(f"{prefix}{q.name}_start", "parameter", start, q.unit, f"start value: {q.doc}"))
    return tuple(ports)
