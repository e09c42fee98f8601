"""Linear models: the plant differentiated, and the thesis' five-state design model (eqs 5.33, 5.34, E.2-E.4) in it."""

from __future__ import annotations

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.design_model import design_model
from controller.settings import Settings
from cosim.model import SCALAR
from cosim.model.symbolic.linearize import linearize
from plant.hovercraft import Hovercraft
from tests.test_effects import MOVING

Matrix = NDArray[np.float64]
THESIS = Settings()
COMMAND = (6.5, 6.3, 0.2, -0.1)


def test_linearization_equals_central_differences() -> None:
    """Of the base model and smooth effects; `build --native` compares the equations of each effect in both forms."""
    craft = Hovercraft().with_values(
        {"stribeck_friction.force": 0.02, "battery_sag.drop": 0.1, "com_offset.right": 4e-3}
    )
    x, u = craft.start(MOVING), COMMAND
    model = linearize(craft, x, u, t=2.0)
    derivative, output = craft.equations(SCALAR)

    def both(z: Matrix) -> Matrix:
        arguments = 2.0, tuple(z[: len(x)].tolist()), tuple(z[len(x) :].tolist())
        return np.array([*derivative(*arguments), *output(*arguments)])

    z = np.array([*x, *u])
    steps = 1e-6 * np.eye(z.size)
    numeric = np.array([(both(z + step) - both(z - step)) / 2e-6 for step in steps]).T
    # rounding: 1e-16 of rates of up to 300 over h is 3e-8; curvature: h²/6 of 2·M/(Izz·0.02³) = 1e5 is 2e-8
    assert np.max(np.abs(np.block([[model.A, model.B], [model.C, model.D]]) - numeric)) < 2e-7


# Appendix E: the entries of the thesis' Jacobian.


def test_hover_is_an_equilibrium_with_known_poles() -> None:
    model = linearize(Hovercraft())
    poles = np.linalg.eigvals(model.A)
    assert np.max(poles.real) < 1e-9
    # x, y, X, Y, ψ, ψ̇ integrate; vx, vy die with c/m; both thrusts and tilts lag with 1/τ; the rest is roll
    assert np.count_nonzero(np.abs(poles) < 1e-6) == 6
    assert np.count_nonzero(np.abs(poles + 0.25 / 0.705) < 1e-6) == 2
    assert np.count_nonzero(np.abs(poles + 1 / 0.0884) < 1e-3) == 4  # a fourfold pole: ε^(1/4)
    roll = poles[np.abs(poles) > 15]
    # product of the two = stiffness/Ixx: k_t and the ground effect's own (2π·1.06 Hz)²; 1.06 has three digits
    assert np.prod(roll).real == pytest.approx(5.0 / 0.009377 + (2 * math.pi * 1.06) ** 2, rel=1e-3)
    assert np.sum(roll).real == pytest.approx(-0.45 / 0.009377, rel=1e-9)


# The design model.


def test_design_model_is_eqs_5_33_and_5_34() -> None:
    A, B = design_model(THESIS)
    friction, lag = 0.25 / 0.705, 1 / 0.0884
    assert A.tolist() == [
        [0, 1, 0, 0, 0], [0, -friction, 0, 0, 1], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, -lag],
    ]  # fmt: skip
    # half a unit of the last printed digit
    assert np.round(B, 2).tolist() == [[0, 0], [0, 0], [0, 0], [41.85, -41.85], [40.07, 40.07]]


def test_design_model_is_the_linearized_plant_with_the_differential_lag_residualised() -> None:
    model = linearize(Hovercraft())
    names = ("x", "vx", "psi", "psi_dot", "tilt_right", "tilt_left")
    rows = [model.states.index(name) for name in names]
    assert not np.delete(model.A[rows], rows, axis=1).any()  # at hover these six feel nothing else
    A, B = model.A[np.ix_(rows, rows)], model.B[rows][:, [model.inputs.index(name) for name in names[4:]]]
    T = np.eye(6)
    T[4, 4:], T[5, 4:] = A[1, 4], (1.0, -1.0)  # a = push·(α_R + α_L), d = α_R − α_L
    six = control.ss(T @ A @ np.linalg.inv(T), T @ B, np.eye(6), np.zeros((6, 2)), remove_useless_states=False)
    five = control.model_reduction(six, elim_states=[5], method="matchdc", warn_unstable=False)  # 0 = ḋ
    A_design, B_design = design_model(THESIS)
    assert pytest.approx(A_design, abs=1e-12) == five.A
    assert pytest.approx(B_design, rel=3e-6, abs=1e-12) == five.B  # δ_N is rounded: T_N is 4e-6 N low


def test_eq_e4_is_the_older_thrust_and_lag() -> None:
    # E.4 prints 34.27 and 24.17 and eq 5.50 −8.333, which T_N = 2.0448 N with τ = 0.12 s reproduce and no mixture does
    older = Settings(thrust_nominal=2.0448, lag=0.12)
    A, B = design_model(older)
    assert (round(B[3, 0], 2), round(B[4, 0], 2), round(A[4, 4], 3)) == (34.27, 24.17, -8.333)
    for mixture in (replace(older, lag=0.0884), replace(older, thrust_nominal=2.4973), THESIS):
        _, B = design_model(mixture)
        assert (round(B[3, 0], 2), round(B[4, 0], 2)) != (34.27, 24.17)
