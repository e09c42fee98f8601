"""Linear models: the plant differentiated, and the thesis' five-state design model (eqs 5.33, 5.34, E.2-E.4) in it."""

from __future__ import annotations

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from numpy.typing import NDArray

from controller.design_model import design_model, measurement_matrix
from controller.settings import Settings
from cosim.model import SCALAR
from cosim.model.symbolic.linearize import LinearModel, linearize
from plant.effects import (
    ActuatorSecondOrder,
    BatterySag,
    ComOffset,
    Coriolis,
    CoulombFriction,
    InflowThrustLoss,
    QuadraticDrag,
    StribeckFriction,
    TableTilt,
    ThrustAsymmetry,
    YawCoulombFriction,
    YawDamping,
)
from plant.hovercraft import Hovercraft

Matrix = NDArray[np.float64]
THESIS = Settings()
FIVE = ("x", "vx", "psi", "psi_dot", "a")
SMOOTH_EFFECTS = (
    ActuatorSecondOrder(natural_frequency=14.0, damping_ratio=0.5),
    ThrustAsymmetry(ratio=0.03),
    BatterySag(drop=0.1, time=10.0),
    InflowThrustLoss(coefficient=0.1),
    CoulombFriction(force=0.05),
    StribeckFriction(force=0.02, static_force=0.06, speed=0.2),
    QuadraticDrag(coefficient=0.3),
    YawDamping(coefficient=0.01),
    YawCoulombFriction(moment=0.005),
    ComOffset(right=0.004),
    TableTilt(x=0.01, y=0.02),
    Coriolis(gain=1.0),
)
AWAY = {
    "x": 0.3, "y": -0.2, "x_world": 1.0, "y_world": -2.0, "psi": 0.7, "vx": 0.4, "vy": -0.3, "psi_dot": 0.2,
    "phi": 0.05, "phi_dot": -0.3, "thrust_right": 2.0, "thrust_left": 2.5, "tilt_right": 0.15, "tilt_left": -0.1,
    "actuator_second_order.tilt_rate_right": 0.3,
}  # fmt: skip
COMMAND = (6.5, 6.3, 0.2, -0.1)


def entry(model: LinearModel, row: str, column: str) -> float:
    """∂(d row/dt)/∂ column, column a state."""
    return float(model.A[model.states.index(row), model.states.index(column)])


@pytest.mark.parametrize("effects", [(), SMOOTH_EFFECTS], ids=["base", "smooth effects"])
@pytest.mark.parametrize("point", ["hover", "away"])
def test_linearization_equals_central_differences(effects: tuple[object, ...], point: str) -> None:
    craft = Hovercraft(effects=effects)
    x0 = craft.start(AWAY if point == "away" else {"vx": 0.1} if effects else {})
    u0 = COMMAND if point == "away" else craft.start_command()
    model = linearize(craft, x0, u0, t=2.0)
    derivative, output = craft.equations(SCALAR)
    z0 = np.array([*x0, *u0])
    h = 1e-6
    columns = []
    for k in range(len(z0)):
        ahead, behind = z0.copy(), z0.copy()
        ahead[k] += h
        behind[k] -= h
        (f1, g1), (f0, g0) = (
            (
                derivative(2.0, tuple(z[: len(x0)].tolist()), tuple(z[len(x0) :].tolist())),
                output(2.0, tuple(z[: len(x0)].tolist()), tuple(z[len(x0) :].tolist())),
            )
            for z in (ahead, behind)
        )
        columns.append(np.array([*(np.subtract(f1, f0) / (2 * h)), *(np.subtract(g1, g0) / (2 * h))]))
    numeric = np.array(columns).T
    n = len(x0)
    symbolic = np.block([[model.A, model.B], [model.C, model.D]])
    # rounding: 1e-16 of rates of up to 300 over h is 3e-8; curvature: h²/6 of 2·M/(Izz·0.02³) = 1e5 is 2e-8
    assert symbolic.shape == (n + len(craft.outputs), n + 4)
    assert np.max(np.abs(symbolic - numeric)) < 2e-7


def test_dry_friction_at_rest_is_steep_viscous_friction() -> None:
    # tanh(s/0.01)·vx/s → vx/0.01: A₂₂ = −(c + F/0.01)/m, finite though s stands in a denominator
    craft = Hovercraft(effects=(CoulombFriction(force=0.1), YawCoulombFriction(moment=0.005)))
    model = linearize(craft)
    assert entry(model, "vx", "vx") == pytest.approx(-(0.25 + 0.1 / 0.01) / 0.705, rel=1e-12)
    assert entry(model, "vy", "vx") == 0.0
    assert entry(model, "psi_dot", "psi_dot") == pytest.approx(-0.005 / 0.02 / 0.01023, rel=1e-12)


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
    by_hand = np.array(
        [
            [0, 1, 0, 0, 0],
            [0, -0.25 / 0.705, 0, 0, 1],
            [0, 0, 0, 1, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, -1 / 0.0884],
        ]
    )
    assert np.array_equal(A, by_hand)
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


# Structure: what can be steered and what can be seen (§5.5).


def observability(A: Matrix, H: Matrix) -> Matrix:
    return np.vstack([H @ np.linalg.matrix_power(A, k) for k in range(5)])


@pytest.mark.parametrize(("estimator", "rank"), [("appendix_f", 3), ("lagged", 3), ("consistent", 4)])
def test_rank_of_observability(estimator: str, rank: int) -> None:
    A, _ = design_model(THESIS)
    O = observability(A, measurement_matrix(THESIS, estimator))  # noqa: E741 - the field's letter
    assert np.linalg.matrix_rank(O) == rank
    # x stands in no measurement and in no derivative of one: the position is unobservable under all three
    assert not O[:, FIVE.index("x")].any()
    assert O[:, FIVE.index("vx")].any() == (estimator == "consistent")
