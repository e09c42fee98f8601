"""Which output depends on what, read off the equations themselves by evaluating them with symbols."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from plant.model import Model
from plant.namespaces import SymbolNamespace
from plant.quantities import parameters_of


def direct_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Inputs each output depends on directly (through no state), in the order of the inputs."""
    craft, symbols = _symbolic(model, flags=True)
    state, command = _signals(craft)
    outputs = craft.equations(SymbolNamespace()).output(symbols["time"], state, command)
    return {
        q.name: tuple(i.name for i, u in zip(model.inputs, command, strict=True) if u in e.free_symbols)
        for q, e in zip(model.outputs, _expressions(outputs), strict=True)
    }


def initial_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Parameters, start values among them, that each output depends on in initialization mode."""
    found: dict[str, set[str]] = {q.name: set() for q in model.outputs}
    flags = [p.name for p in model.parameters if isinstance(p.default, bool)]
    variants = []
    for flag in (True, False):
        craft, symbols = _symbolic(model, flag)
        state, command = _signals(craft)
        m = SymbolNamespace()
        outputs = _expressions(craft.equations(m).output(symbols["time"], state, command))
        variants.append(outputs)
        names = {s: name for name, s in symbols.items()}
        starts = {s: f"{q.name}_start" for s, q in zip(state, craft.states, strict=True)}
        follows = _derived_starts(craft)
        for q, e in zip(model.outputs, outputs, strict=True):
            for symbol in e.free_symbols:
                found[q.name].add(starts.get(symbol) or names[symbol])
                found[q.name] |= {names[s] for s in follows.get(starts.get(symbol, ""), ())}
    for q, with_flag, without in zip(model.outputs, *variants, strict=True):
        if with_flag != without:
            found[q.name].update(flags)
    return {name: tuple(sorted(names - {"time"})) for name, names in found.items()}


def _symbolic(model: Model, flags: bool) -> tuple[Model, dict[str, Any]]:
    """The model with every effect awake and every number a symbol named as its FMI variable."""
    import sympy

    symbols: dict[str, Any] = {"time": sympy.Symbol("time", real=True)}

    def as_symbols(owner: Any, prefix: str) -> Any:
        values = {}
        for p in parameters_of(owner):
            symbol = sympy.Symbol(prefix + p.name, positive=True)
            if not isinstance(p.default, bool):
                symbols[prefix + p.name] = symbol
            values[p.name] = flags if isinstance(p.default, bool) else symbol
        return replace(owner, **values)

    effects = tuple(as_symbols(kind(), f"{kind.name}.") for kind in model.catalogue)
    return replace(as_symbols(model, ""), effects=effects), symbols


def _signals(model: Model) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Symbols for the state and the command; none has the name of a parameter."""
    import sympy

    state = tuple(sympy.Symbol(f"state:{q.name}", real=True) for q in model.states)
    return state, tuple(sympy.Symbol(f"input:{q.name}", real=True) for q in model.inputs)


def _derived_starts(model: Model) -> dict[str, set[Any]]:
    """Start parameters that follow from other parameters until the host sets them."""
    import sympy

    return {f"{name}_start": sympy.sympify(e).free_symbols for name, e in model.start_state(SymbolNamespace()).items()}


def _expressions(values: tuple[Any, ...]) -> list[Any]:
    import sympy

    return [sympy.sympify(v) for v in values]
