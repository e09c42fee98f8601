"""Dependencies of outputs, from a symbolic evaluation of the equations."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from cosim.model.model import Model
from cosim.model.namespaces import SymbolNamespace
from cosim.model.symbolic.symbols import SymbolicModel, symbolic


def direct_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Return the inputs with direct feedthrough to each output, in input order."""
    s = symbolic(model)
    return {
        q.name: tuple(i.name for i, u in zip(model.inputs, s.command, strict=True) if u in e.free_symbols)
        for q, e in zip(model.outputs, _outputs(s), strict=True)
    }


def initial_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Return the parameters, start values and inputs that affect each initial output."""
    dependencies: dict[str, set[str]] = defaultdict(set)
    flags = [p.name for p in model.parameters if isinstance(p.default, bool)]
    variants = []
    for flag in (True, False):
        s = symbolic(model, flag)
        variants.append(_outputs(s))
        names = {symbol: name for name, symbol in s.parameters.items()}
        names |= {symbol: q.name for symbol, q in zip(s.command, s.model.inputs, strict=True)}
        names |= {symbol: f"{q.name}_start" for symbol, q in zip(s.state, s.model.states, strict=True)}
        follows = _derived_starts(s)
        for q, expression in zip(model.outputs, variants[-1], strict=True):
            direct = {names[symbol] for symbol in expression.free_symbols - {s.time}}
            dependencies[q.name].update(direct, *({names[other] for other in follows.get(name, ())} for name in direct))
    for q, with_flag, without in zip(model.outputs, *variants, strict=True):
        if with_flag != without:
            dependencies[q.name].update(flags)
    return {name: tuple(sorted(names)) for name, names in dependencies.items()}


def _outputs(s: SymbolicModel) -> list[Any]:
    import sympy

    outputs = s.model.acting(SymbolNamespace()).output(s.time, s.state, s.command)
    return [sympy.sympify(e) for e in outputs]


def _derived_starts(s: SymbolicModel) -> dict[str, set[Any]]:
    """Return start parameters that depend on other parameters unless set by the host."""
    import sympy

    own = s.model.start_state(SymbolNamespace())
    return {f"{name}_start": sympy.sympify(e).free_symbols for name, e in own.items()}
