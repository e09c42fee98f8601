"""One body of equations for a float and a symbol: both give the same numbers."""

from __future__ import annotations

from typing import Any

import pytest
import sympy

from cosim.model.namespaces import SCALAR, SymbolNamespace
from plant.effects import CATALOGUE
from plant.hovercraft import Hovercraft

VALUES = {
    "mass": 0.6,
    "lag": 0.07,
    "friction": 0.25,
    "height": 0.08,
    "actuator_delay.time": 0.02,
    "servo_backlash.width": 0.02,
    "tilt_offset.right": 0.01,
    "tilt_offset.left": 0.02,
    "servo_dead_band.width": 0.02,
    "actuator_second_order.natural_frequency": 15.0,
    "servo_rate_limit.rate": 1.0,
    "thrust_asymmetry.ratio": 0.02,
    "battery_sag.drop": 0.1,
    "inflow_thrust_loss.coefficient": 0.1,
    "coulomb_friction.force": 0.05,
    "stribeck_friction.force": 0.01,
    "stribeck_friction.static_force": 0.05,
    "quadratic_drag.coefficient": 0.2,
    "yaw_damping.coefficient": 0.01,
    "yaw_coulomb_friction.moment": 0.003,
    "com_offset.right": 0.002,
    "table_tilt.x": 0.01,
    "table_tilt.y": 0.01,
    "coriolis.gain": 1.0,
}
BASE = [name for name in VALUES if "." not in name]
GROUPS = {"base": [], **{kind.name: [n for n in VALUES if n.startswith(kind.name + ".")] for kind in CATALOGUE}}
GROUPS["everything"] = [name for names in GROUPS.values() for name in names]


STATE = (0.3, -0.2, 1.0, -2.0, 0.7, 0.4, -0.3, 0.2, 0.05, -0.3, 2.0, 2.5, 0.15, -0.1)
COMMAND = (6.5, 6.3, 0.2, -0.1)


def evaluated(expressions: Any, numbers: dict[Any, float]) -> list[float]:
    """Expressions at numbers. Shared parts are evaluated once: a speed stands in every friction."""
    code = sympy.lambdify(list(numbers), list(map(sympy.sympify, expressions)), modules="math", cse=True)
    return [float(value) for value in code(*numbers.values())]


@pytest.mark.parametrize("group", GROUPS)
def test_symbolic_derivative_evaluates_to_the_scalar_one(group: str) -> None:
    craft = Hovercraft().with_values({name: VALUES[name] for name in [*BASE, *GROUPS[group]]})
    state = STATE + tuple(0.1 * (k + 1) for k in range(len(craft.states) - 14))
    x = sympy.symbols([f"x{k}" for k in range(len(state))], real=True)
    u = sympy.symbols("u0:4", real=True)
    t = sympy.Symbol("t", real=True)
    numbers = dict(zip((t, *x, *u), (2.5, *state, *COMMAND), strict=True))
    for symbols, scalars in zip(craft.equations(SymbolNamespace()), craft.equations(SCALAR), strict=True):
        # sympy orders sums and products its own way: rounding, over a few cancelling terms
        got = evaluated(symbols(t, tuple(x), tuple(u)), numbers)
        assert got == pytest.approx(scalars(2.5, state, COMMAND), rel=1e-12, abs=1e-13)
