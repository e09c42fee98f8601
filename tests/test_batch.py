"""One body of equations for a float, an array and a symbol: all three give the same numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sympy

from cosim.model import Stepper
from cosim.model.namespaces import SCALAR, SymbolNamespace, arrays
from plant.effects import CATALOGUE
from plant.hovercraft import Hovercraft
from tests.independent import HOLD, excitation, flown

COUNT = 6
# Each row one value a craft. The last craft has every effect at its neutral value: awake in the batch, yet nothing.
BATCH: dict[str, list[float]] = {
    "mass": [0.6, 0.705, 0.8, 0.9, 0.7, 0.705],
    "lag": [0.07, 0.0884, 0.1, 0.12, 0.05, 0.0884],
    "friction": [0.0, 0.25, 0.5, 0.1, 0.2, 0.25],
    "height": [0.08, 0.095, 0.1, 0.12, 0.15, 0.095],
    "actuator_delay.time": [0.02, 0.033, 0.0, 0.06, 0.0071, 0.0],
    "servo_backlash.width": [0.02, 0.0, 0.05, 0.1, 0.01, 0.0],
    "tilt_offset.right": [0.01, -0.02, 0.0, 0.03, 0.0, 0.0],
    "tilt_offset.left": [0.0, 0.02, 0.0, -0.03, 0.01, 0.0],
    "servo_dead_band.width": [0.0, 0.02, 0.01, 0.03, 0.005, 0.0],
    "actuator_second_order.natural_frequency": [15.0, 0.0, 20.0, 0.0, 12.0, 0.0],
    "servo_rate_limit.rate": [0.0, 1.0, 2.0, 3.0, 0.0, 0.0],
    "thrust_asymmetry.ratio": [0.02, -0.03, 0.0, 0.05, 0.01, 0.0],
    "battery_sag.drop": [0.1, 0.0, 0.2, 0.05, 0.3, 0.0],
    "inflow_thrust_loss.coefficient": [0.1, 0.2, 0.0, 0.05, 0.15, 0.0],
    "coulomb_friction.force": [0.05, 0.0, 0.1, 0.02, 0.08, 0.0],
    "stribeck_friction.force": [0.01, 0.0, 0.02, 0.03, 0.0, 0.0],
    "stribeck_friction.static_force": [0.05, 0.0, 0.02, 0.01, 0.04, 0.0],
    "quadratic_drag.coefficient": [0.2, 0.0, 0.3, 0.1, 0.5, 0.0],
    "yaw_damping.coefficient": [0.01, 0.0, 0.02, 0.005, 0.0, 0.0],
    "yaw_coulomb_friction.moment": [0.003, 0.0, 0.005, 0.001, 0.0, 0.0],
    "com_offset.right": [0.002, -0.003, 0.0, 0.004, 0.001, 0.0],
    "table_tilt.x": [0.01, 0.0, -0.01, 0.02, 0.0, 0.0],
    "table_tilt.y": [0.0, 0.01, 0.02, -0.01, 0.0, 0.0],
    "coriolis.gain": [1.0, 0.0, 1.0, 0.5, 0.0, 0.0],
}
BASE = [name for name in BATCH if "." not in name]
GROUPS = {"base": [], **{kind.name: [n for n in BATCH if n.startswith(kind.name + ".")] for kind in CATALOGUE}}
GROUPS["everything"] = [name for names in GROUPS.values() for name in names]


@pytest.mark.thorough
@pytest.mark.parametrize("group", GROUPS)
def test_a_batch_of_craft_equals_the_craft_one_by_one(group: str) -> None:
    names = [*BASE, *GROUPS[group]]
    together = Stepper(Hovercraft().with_values({name: np.array(BATCH[name]) for name in names}), arrays())
    commands = np.stack([excitation(30, seed=seed) for seed in range(COUNT)])  # (craft, step, input)
    moment = together.start(0.0, {"vx": np.linspace(-0.5, 0.5, COUNT), "psi_dot": 0.4})
    for k in range(30):
        moment = together.step(moment, tuple(commands[:, k].T), HOLD)
    outputs = together.output(moment.t, moment.state, ())
    for craft in range(COUNT):
        alone = Stepper(Hovercraft().with_values({name: BATCH[name][craft] for name in names}))
        expected = flown(alone, commands[craft], {"vx": np.linspace(-0.5, 0.5, COUNT)[craft].item(), "psi_dot": 0.4})
        got = {q.name: np.broadcast_to(v, COUNT)[craft] for q, v in zip(Hovercraft.outputs, outputs, strict=True)}
        # one body: only sin, cos, exp, tanh and pow of another library differ, by one rounding each
        assert got == pytest.approx({name: trace[-1] for name, trace in expected.items()}, rel=1e-12, abs=1e-13)


STATE = (0.3, -0.2, 1.0, -2.0, 0.7, 0.4, -0.3, 0.2, 0.05, -0.3, 2.0, 2.5, 0.15, -0.1)
COMMAND = (6.5, 6.3, 0.2, -0.1)


def evaluated(expressions: Any, numbers: dict[Any, float]) -> list[float]:
    """Expressions at numbers. Shared parts are evaluated once: a speed stands in every friction."""
    code = sympy.lambdify(list(numbers), list(map(sympy.sympify, expressions)), modules="math", cse=True)
    return [float(value) for value in code(*numbers.values())]


@pytest.mark.parametrize("group", GROUPS)
def test_symbolic_derivative_evaluates_to_the_scalar_one(group: str) -> None:
    craft = Hovercraft().with_values({name: BATCH[name][0] for name in [*BASE, *GROUPS[group]]})
    state = STATE + tuple(0.1 * (k + 1) for k in range(len(craft.states) - 14))
    x = sympy.symbols([f"x{k}" for k in range(len(state))], real=True)
    u = sympy.symbols("u0:4", real=True)
    t = sympy.Symbol("t", real=True)
    numbers = dict(zip((t, *x, *u), (2.5, *state, *COMMAND), strict=True))
    for symbols, scalars in zip(craft.equations(SymbolNamespace()), craft.equations(SCALAR), strict=True):
        # sympy orders sums and products its own way: rounding, over a few cancelling terms
        got = evaluated(symbols(t, tuple(x), tuple(u)), numbers)
        assert got == pytest.approx(scalars(2.5, state, COMMAND), rel=1e-12, abs=1e-13)
