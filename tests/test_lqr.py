"""The regulator of ch. 6: gain, saturation, and noise settings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from controller.design_model import design_model
from controller.loop import feedback
from controller.settings import Settings
from controller.synthesis import Q_THESIS, R_THESIS, lqr_gain

THESIS = Settings()
K_EQ_6_5 = [[0.70711, 0.65934, 0.22361, 0.10170, 0.04958], [0.70711, 0.65934, -0.22361, -0.10170, 0.04958]]
K_APPENDIX_G = [[0.70711, 0.69265, 0.22361, 0.10735, 0.06922], [0.70711, 0.69265, -0.22361, -0.10735, 0.06922]]
property_settings = settings(deadline=None, derandomize=True, max_examples=50)


def test_gain_of_eq_6_5() -> None:
    assert np.round(lqr_gain(THESIS), 5).tolist() == K_EQ_6_5
    # the flying controller carries numbers; the Riccati solver's own accuracy is 1e-12
    assert pytest.approx(lqr_gain(THESIS), rel=1e-11) == np.array(THESIS.gain_matrix)


def test_gain_of_appendix_g_belongs_to_the_older_thrust_and_lag() -> None:
    assert np.round(lqr_gain(Settings(thrust_nominal=2.0448, lag=0.12)), 5).tolist() == K_APPENDIX_G
    for mixture in (Settings(thrust_nominal=2.0448), Settings(lag=0.12)):
        assert np.round(lqr_gain(mixture), 5).tolist() != K_APPENDIX_G


def test_gain_from_a_riccati_solution_of_another_library() -> None:
    A, B = design_model(THESIS)
    Q, R = np.diag(Q_THESIS), np.diag(R_THESIS)
    P = solve_continuous_are(A, B, Q, R)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q  # eq 6.3
    assert np.max(np.abs(residual)) < 1e-9  # P's entries of 1 times a condition of 1e6
    assert pytest.approx(np.linalg.solve(R, B.T @ P), rel=1e-9) == lqr_gain(THESIS)


@property_settings
@given(st.lists(st.floats(-100, 100), min_size=5, max_size=5), st.floats(0, 1))
def test_command_never_exceeds_the_saturation(x_hat: list[float], limit: float) -> None:
    free = -np.array(THESIS.gain_matrix) @ x_hat
    u = feedback(THESIS.gain_matrix, x_hat, limit)
    assert max(map(abs, u)) <= limit
    # and is the linear one where that fits; two orders of summation
    assert u == pytest.approx(np.clip(free, -limit, limit), abs=1e-13)


def test_noise_of_the_settings_is_that_of_eqs_5_46_and_5_47() -> None:
    assert THESIS.measurement_variances == (2.613e-5, 4.564e-4, 0.04479)
    assert THESIS.process_variances == (1e-4, 1e-4, 2.613e-5, 4.564e-4, 1e-4)
    assert THESIS.sample_time == 0.02  # Fig 4.8
