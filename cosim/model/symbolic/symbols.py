"""Models with symbols as numbers, for dependencies, Jacobians and generated code."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

from cosim.model.model import Model, Values
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
