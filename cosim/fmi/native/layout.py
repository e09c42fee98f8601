"""Variables of a native FMU in the order of their value references, and their dependencies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from cosim.fmi.model_description import Description
from cosim.fmi.native.printing import ModelPrinter
from cosim.fmi.ports import Port, model_ports
from cosim.model.quantities import Quantity

Role = Literal["port", "state", "derivative", "memory", "indicator"]


@dataclass(frozen=True)
class Local:
    """A variable of native FMUs only; `state` is the index of a derivative's state."""

    name: str
    role: Role
    unit: str
    doc: str
    state: int = -1


@dataclass(frozen=True)
class VariableLayout:
    """Variables of a native FMU in the order of their value references: ports, then local variables.

    Attributes:
        dependencies: Output or derivative → names of the inputs and states on which it depends.
    """

    about: Description
    locals: tuple[Local, ...] = ()
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)
    indicators: int = 0

    @property
    def ports(self) -> Sequence[Port]:
        """Return the variables common with the Python FMU."""
        return self.about.ports

    @property
    def variables(self) -> list[Port | Local]:
        """Return all variables in order of value reference."""
        return [*self.ports, *self.locals]

    def of(self, role: Role) -> list[tuple[int, Local]]:
        """Return local variables of a role with value references."""
        return [(len(self.ports) + k, v) for k, v in enumerate(self.locals) if v.role == role]


def per_second(unit: str) -> str:
    """Return the unit of a derivative."""
    return f"{unit}2" if unit.endswith("/s") else f"{unit if unit != '1' else ''}/s" if unit not in ("", "1") else "1/s"


def model_layout(printer: ModelPrinter, about: Description, indicators: int) -> VariableLayout:
    """Return a model's layout with states, derivatives, memory and a number of event indicators (`indicators`)."""
    if list(about.ports) != list(model_ports(printer.model)):
        raise ValueError("the description is of another model")
    names = [q.name for q in printer.states]
    states = [Local(f"{q.name}_state", "state", q.unit, f"state: {q.doc}", k) for k, q in enumerate(printer.states)]
    rates = [_rate(q, k) for k, q in enumerate(printer.states)]
    memory = [
        Local(f"{e.name}.{q.name}_memory", "memory", q.unit, f"remembered: {q.doc}") for e, q in printer.remembering
    ]
    kinks = [
        Local(f"event_indicator_{k + 1}", "indicator", "", "passes through zero at a kink") for k in range(indicators)
    ]
    return VariableLayout(about, (*states, *rates, *memory, *kinks), _dependencies(printer, names), indicators)


def _rate(q: Quantity, k: int) -> Local:
    return Local(f"der({q.name}_state)", "derivative", per_second(q.unit), f"derivative: {q.doc}", k)


def _dependencies(printer: ModelPrinter, names: Sequence[str]) -> dict[str, list[str]]:
    """Return output or derivative → inputs and states on which it depends, for any active effects and switches."""
    sources: dict[str, set[str]] = {}
    inputs, states = [q.name for q in printer.model.inputs], [f"{n}_state" for n in names]
    for trace in printer.variants:
        symbols = (*trace.s.state, *trace.s.command)
        reach = {symbol: {name} for symbol, name in zip(symbols, (*states, *inputs), strict=True)}
        for block in (*trace.shaping, *trace.blocks):
            for symbol, e in (*block.values.items(), *block.dormant.items()):
                reach.setdefault(symbol, set()).update(_sources_of(e, reach))
        for q, e in zip(printer.model.outputs, trace.outputs, strict=True):
            sources.setdefault(q.name, set()).update(_sources_of(e, reach))
        acting = dict(zip(inputs, trace.shaped, strict=True))
        for name, e in zip(states, trace.derivative, strict=True):
            direct = _sources_of(e, reach)  # The acting command is shaped.
            shaped = (_sources_of(acting[n], reach) for n in direct & acting.keys())
            sources.setdefault(f"der({name})", set()).update(direct, *shaped)
    return {name: sorted(direct) for name, direct in sources.items()}


def _sources_of(expression: Any, reach: Mapping[Any, set[str]]) -> set[str]:
    """Return the inputs and states in an expression."""
    return set().union(*(reach.get(s, set()) for s in expression.free_symbols))
