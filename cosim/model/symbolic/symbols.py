"""Models with symbols as numbers, for Jacobians and generated code, and the dependencies of their outputs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from cosim.model.model import Model, Values
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of


@dataclass(frozen=True)
class SymbolicModel:
    """A model whose parameters, states and inputs are symbols, with all effects active.

    Attributes:
        model: Model with symbols as parameters; Booleans are fixed by `flags`.
        parameters: FMI name, such as `mass` or `coulomb_friction.force` → symbol.
    """

    model: Model
    time: Any
    parameters: dict[str, Any]
    state: Values
    command: Values


def symbolic(
    model: Model, flags: bool | Mapping[str, bool] | None = None, effects: bool | Collection[str] = True
) -> SymbolicModel:
    """Return the model with symbols in place of numbers and with all, some or no effects.

    Args:
        flags: Value of all Booleans, or values by FMI name; default: those of the model.
    """
    import sympy

    symbols: dict[str, Any] = {}

    def as_symbols(owner: Any, prefix: str) -> Any:
        values: dict[str, Any] = {}
        for p in parameters_of(owner):
            if isinstance(p.default, bool):
                flag = flags.get(prefix + p.name) if isinstance(flags, Mapping) else flags
                values[p.name] = getattr(owner, p.name) if flag is None else flag
            else:
                values[p.name] = symbols[prefix + p.name] = sympy.Symbol(prefix + p.name, real=True)
        return replace(owner, **values)

    names = [kind.name for kind in model.catalogue] if effects is True else effects or ()
    terms = tuple(as_symbols(kind(), f"{kind.name}.") for kind in model.catalogue if kind.name in names)
    awake = replace(as_symbols(model, ""), effects=terms)
    # prefixed, since an input and a state may have the same name
    state = tuple(sympy.Symbol(f"state:{q.name}", real=True) for q in awake.states)
    command = tuple(sympy.Symbol(f"input:{q.name}", real=True) for q in awake.inputs)
    return SymbolicModel(awake, sympy.Symbol("time", real=True), symbols, state, command)


def direct_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Return the inputs with direct feedthrough to each output, in input order."""
    s = symbolic(model)
    return {
        q.name: tuple(i.name for i, u in zip(model.inputs, s.command, strict=True) if u in e.free_symbols)
        for q, e in zip(model.outputs, _outputs(s), strict=True)
    }


def initial_dependencies(model: Model) -> dict[str, tuple[str, ...]]:
    """Return the parameters, start values and inputs that affect each initial output."""
    import sympy

    dependencies: dict[str, set[str]] = defaultdict(set)
    flags = [p.name for p in model.parameters if isinstance(p.default, bool)]
    variants = []
    for flag in (True, False):
        s = symbolic(model, flag)
        variants.append(_outputs(s))
        names = {symbol: name for name, symbol in s.parameters.items()}
        names |= {symbol: q.name for symbol, q in zip(s.command, s.model.inputs, strict=True)}
        names |= {symbol: f"{q.name}_start" for symbol, q in zip(s.state, s.model.states, strict=True)}
        # start parameters that depend on other parameters unless set by the host
        own = s.model.start_state(SymbolNamespace())
        follows = {f"{name}_start": sympy.sympify(e).free_symbols for name, e in own.items()}
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
