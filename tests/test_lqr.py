"""The regulator of ch. 6: gain, poles, saturation, and what its design refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from controller.design_model import design_model
from controller.gains import ESTIMATORS, Settings
from controller.lqr import feedback
from controller.synthesis import Q_THESIS, R_THESIS, lqr_gain

THESIS = Settings()
K_EQ_6_5 = [[0.70711, 0.65934, 0.22361, 0.10170, 0.04958], [0.70711, 0.65934, -0.22361, -0.10170, 0.04958]]
K_APPENDIX_G = [[0.70711, 0.69265, 0.22361, 0.10735, 0.06922], [0.70711, 0.69265, -0.22361, -0.10735, 0.06922]]
property_settings = settings(deadline=None, derandomize=True, max_examples=50)


def test_gain_of_eq_6_5() -> None:
    assert np.round(lqr_gain(THESIS), 5).tolist() == K_EQ_6_5


def test_gain_of_appendix_g_belongs_to_the_older_thrust_and_lag() -> None:
    assert np.round(lqr_gain(Settings(thrust_nominal=2.0448, lag=0.12)), 5).tolist() == K_APPENDIX_G
    for mixture in (Settings(thrust_nominal=2.0448), Settings(lag=0.12)):
        assert np.round(lqr_gain(mixture), 5).tolist() != K_APPENDIX_G


def test_frozen_gain_is_the_designed_one() -> None:
    # the flying controller carries numbers; the Riccati solver's own accuracy is 1e-12
    assert pytest.approx(lqr_gain(THESIS), rel=1e-11) == np.array(THESIS.gain_matrix)


def test_gain_from_a_riccati_solution_of_another_library() -> None:
    A, B = design_model(THESIS)
    Q, R = np.diag(Q_THESIS), np.diag(R_THESIS)
    P = solve_continuous_are(A, B, Q, R)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q  # eq 6.3
    assert np.max(np.abs(residual)) < 1e-9  # P's entries of 1 times a condition of 1e6
    assert pytest.approx(np.linalg.solve(R, B.T @ P), rel=1e-9) == lqr_gain(THESIS)


def test_gains_that_a_scalar_calculation_gives() -> None:
    # both inputs share each axis: k_x = √(q_x/2), k_ψ = √(q_ψ/2), whatever the craft weighs
    for craft in (THESIS, Settings(mass=1.4, izz=0.03, lag=0.2)):
        K = lqr_gain(craft)
        assert K[:, 0] == pytest.approx([math.sqrt(0.5)] * 2, rel=1e-9)
        assert K[:, 2] == pytest.approx([math.sqrt(0.05), -math.sqrt(0.05)], rel=1e-9)


def test_closed_loop_poles() -> None:
    A, B = design_model(THESIS)
    poles = np.sort_complex(np.linalg.eigvals(A - B @ np.array(THESIS.gain_matrix)))
    # the yaw axis in closed form: s² + 2B₄·k_ψ̇·s + 2B₄·k_ψ, k_ψ = √(q_ψ/2), k_ψ̇ = √(q_ψ̇/2 + k_ψ/B₄)
    b4 = 0.17145 * 2.4973 / 0.01023
    k_psi = math.sqrt(0.05)
    damping = b4 * math.sqrt(0.005 + k_psi / b4)
    turning = damping * -1 + 1j * math.sqrt(2 * b4 * k_psi - damping**2)
    assert poles.tolist() == pytest.approx([-10.683, turning.conjugate(), turning, -3.3943, -1.5628], abs=1e-4)
    # the sheet gives this pair as −4.2566 ± 0.7744j, from numbers already rounded; exact is −4.25645 ± 0.77468j
    assert turning == pytest.approx(-4.2566 + 0.7744j, abs=4e-4)


@pytest.mark.parametrize(
    ("Q", "R"),
    [
        ((1.0, 0.5, 0.1, 0.01, -1.0), (1.0, 1.0)),
        ((1.0, 0.5, 0.1, 0.01, 0.0), (1.0, 0.0)),
        ((1.0, 0.5, 0.1, 0.01), (1.0, 1.0)),
    ],
)
def test_weights_of_no_regulator_are_refused(Q: tuple[float, ...], R: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="Q has five"):
        lqr_gain(THESIS, Q, R)


@pytest.mark.parametrize(
    "Q",
    [
        (0.0, 0.5, 0.1, 0.01, 0.0),  # no weight on x leaves its integrator to itself: a pole at 0
        (1.0, 0.5, 0.0, 0.01, 0.0),  # likewise ψ
        (1.0, 0.5, 0.0, 0.0, 0.0),  # and a double one
        (0.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
def test_weights_that_leave_an_integrator_free_are_refused(Q: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="stabilising"):
        lqr_gain(THESIS, Q)


def test_a_gain_grows_with_the_weight_of_its_state() -> None:
    assert lqr_gain(THESIS, (4.0, 0.5, 0.1, 0.01, 0.0))[0, 0] == pytest.approx(math.sqrt(2), rel=1e-9)


@property_settings
@given(st.lists(st.floats(-100, 100), min_size=5, max_size=5), st.floats(0, 1))
def test_command_never_exceeds_the_saturation(x_hat: list[float], limit: float) -> None:
    free = -np.array(THESIS.gain_matrix) @ x_hat
    u = feedback(THESIS.gain_matrix, x_hat, (0.0,) * 5, limit)
    assert max(map(abs, u)) <= limit
    # and is the linear one where that fits; two orders of summation
    assert u == pytest.approx(np.clip(free, -limit, limit), abs=1e-13)


def test_craft_on_its_reference_is_left_alone() -> None:
    on = (1.5, 0.0, -math.pi / 2, 0.0, 0.0)
    u = feedback(THESIS.gain_matrix, on, on, THESIS.tilt_max)
    assert u == (0.0, 0.0)
    assert [math.copysign(1.0, v) for v in u] == [1.0, 1.0]  # not −0.0: every file reads 0


def test_signs_of_the_feedback() -> None:
    behind = feedback(THESIS.gain_matrix, (0, 0, 0, 0, 0), (0.1, 0, 0, 0, 0), 1.0)
    assert behind[0] == behind[1] > 0  # behind its goal: both forward
    left = feedback(THESIS.gain_matrix, (0, 0, 0, 0, 0), (0, 0, 0.1, 0, 0), 1.0)
    assert left[0] == -left[1] > 0  # the goal to the left: right propeller forward


def test_saturation_of_the_vehicle_is_12_degrees() -> None:
    assert THESIS.tilt_max == math.radians(12)  # App G


# What the settings refuse.


def test_settings_out_of_bounds_are_refused_all_at_once() -> None:
    bad = {"mass": -1.0, "k_2_3": math.nan, "sample_time": 0.0, "measurement_variance_ax": -0.1}
    with pytest.raises(ValueError, match="mass") as refusal:
        Settings(**bad)
    assert all(name in str(refusal.value) for name in bad)


def test_unknown_estimator_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="kalmann") as refusal:
        Settings(estimator="kalmann")
    assert all(name in str(refusal.value) for name in ESTIMATORS)


def test_unknown_estimator_is_named_beside_the_other_faults() -> None:
    with pytest.raises(ValueError, match="mass") as refusal:
        Settings(mass=-1.0, estimator="kalmann")
    assert "kalmann" in str(refusal.value)


def test_noise_of_the_settings_is_that_of_eqs_5_46_and_5_47() -> None:
    assert THESIS.measurement_variances == (2.613e-5, 4.564e-4, 0.04479)
    assert THESIS.process_variances == (1e-4, 1e-4, 2.613e-5, 4.564e-4, 1e-4)
    assert THESIS.sample_time == 0.02  # Fig 4.8
