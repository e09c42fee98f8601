"""One body of equations for a float and a symbol: both give the same numbers."""

from __future__ import annotations

from typing import Any

import pytest
import sympy

from cosim.model import parameters_of
from cosim.model.namespaces import SCALAR, SymbolNamespace
from plant.effects import CATALOGUE
from plant.hovercraft import Hovercraft

BASE = {"mass": 0.6, "lag": 0.07, "friction": 0.25, "height": 0.08}
STATE = (0.3, -0.2, 1.0, -2.0, 0.7, 0.4, -0.3, 0.2, 0.05, -0.3, 2.0, 2.5, 0.15, -0.1)
COMMAND = (6.5, 6.3, 0.2, -0.1)
# each effect with its parameters a little off their defaults
EFFECTS = {
    kind.name: {f"{kind.name}.{p.name}": p.default + 0.05 * (p.bounds[1] - p.default) for p in parameters_of(kind)}
    for kind in CATALOGUE
}
EVERYTHING = {name: value for values in EFFECTS.values() for name, value in values.items()}


def evaluated(expressions: Any, numbers: dict[Any, float]) -> list[float]:
    """Expressions at numbers. Shared parts are evaluated once: a speed stands in every friction."""
    code = sympy.lambdify(list(numbers), list(map(sympy.sympify, expressions)), modules="math", cse=True)
    return [float(value) for value in code(*numbers.values())]


@pytest.mark.parametrize("values", [{}, *EFFECTS.values(), EVERYTHING], ids=["base", *EFFECTS, "everything"])
def test_symbolic_derivative_evaluates_to_the_scalar_one(values: dict[str, float]) -> None:
    craft = Hovercraft().with_values(BASE | values)
    state = STATE + tuple(0.1 * (k + 1) for k in range(len(craft.states) - 14))
    t, *x = sympy.symbols(f"t x:{len(state)}", real=True)
    u = sympy.symbols("u:4", real=True)
    numbers = dict(zip((t, *x, *u), (2.5, *state, *COMMAND), strict=True))
    for symbols, scalars in zip(craft.equations(SymbolNamespace()), craft.equations(SCALAR), strict=True):
        # sympy orders sums and products its own way: rounding, over a few cancelling terms
        got = evaluated(symbols(t, tuple(x), tuple(u)), numbers)
        assert got == pytest.approx(scalars(2.5, state, COMMAND), rel=1e-12, abs=1e-13)
