"""The estimator of ch. 5 and Appendix F, its two variants, and their unobservable states."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from controller.design_model import design_model, fix_matrix, measurement_matrix
from controller.loop import Loop
from controller.settings import ESTIMATORS, Settings

Matrix = NDArray[np.float64]
DT, M, C, TAU, T_N = 0.02, 0.705, 0.25, 0.0884, 2.4973  # Fig 4.8, §5.2, §5.5, eqs 4.29, 5.36
B4 = 0.17145 * T_N / 0.01023
V = np.diag([1e-4, 1e-4, 2.613e-5, 4.564e-4, 1e-4])  # eq 5.47
W = np.diag([2.613e-5, 4.564e-4, 0.04479])  # eq 5.46


def matrices(estimator: str) -> tuple[Matrix, Matrix, Matrix]:
    """F, G, H: of Appendix F by hand; else ẍ = −c/m·ẋ + a, ψ̈ = ±B₄·u, ȧ = (T_N/m·u − a)/τ under held inputs."""
    H, push = np.zeros((3, 5)), T_N / M
    H[[0, 1, 2], [2, 3, 4]] = 1.0
    A, B = np.zeros((5, 5)), np.zeros((5, 2))
    A[[0, 1, 1, 2], [1, 1, 4, 3]] = 1.0, -C / M, 1.0, 1.0
    B[3] = B4, -B4
    if estimator == "appendix_f":
        F, G = np.eye(5) + DT * A, DT * B
        F[4, 4], G[4] = 0.0, push
        return F, G, H
    if estimator == "consistent":
        H[2, 1] = -C / M
    A[4, 4], B[4] = -1 / TAU, push / TAU
    moved = expm(DT * np.block([[A, B], [np.zeros((2, 7))]]))
    return moved[:5, :5], moved[:5, 5:], H


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_loop_predicts_updates_and_feeds_back_in_this_order(estimator: str) -> None:
    settings = Settings(estimator=estimator, fix_latency=0.06, measurement_variance_x=4e-4)
    start, limit, fix = (0.4, 0.1, -0.2, 0.05, 0.3), settings.tilt_max, np.array([[1.0, -0.06, 0.0, 0.0, 0.0]])
    loop, x, P = Loop(settings, start, 0.0, 0.0), np.array(start), np.zeros((5, 5))
    (F, G, H), K, rng = matrices(estimator), np.array(settings.gain_matrix), np.random.default_rng(7)
    # at the start there is no update: u₀ = sat(−K·(x̂₀ − x_ref)), P = 0
    assert loop.estimate == list(start)
    assert loop.sigma == (0.0, 0.0)
    assert loop.command == pytest.approx(np.clip(-K @ start, -limit, limit), rel=1e-13)
    for k in range(200):
        z, x_meas, count = rng.normal(0.0, (0.1, 0.1, 0.3)), rng.normal(0.5, 0.1), max(0, k // 5 - 20)
        reference = np.array([0.1 * math.sin(0.1 * k), 0.0, 0.3 * math.cos(0.1 * k), 0.0, 0.0])
        x, P = F @ x + G @ loop.command, F @ P @ F.T + V
        updates = [(H, z, W)]
        if count and k % 5 == 0:  # a fix, from the 105th sample on, is a second update
            updates.append((fix, np.array([x_meas]), np.array([[4e-4]])))
        for read, values, noise in updates:
            gain = np.linalg.solve(read @ P @ read.T + noise, read @ P).T
            x, P = x + gain @ (values - read @ x), (np.eye(5) - gain @ read) @ P
        command = loop.step(z.tolist(), reference[0], reference[2], x_meas, 0.0, float(count))
        # two forms of the covariance update (Joseph's and the short one), 200 samples of rounding
        assert loop.estimate == pytest.approx(x, rel=1e-9, abs=1e-11)
        assert command == pytest.approx(np.clip(-K @ (x - reference), -limit, limit), rel=1e-9, abs=1e-11)
        assert loop.sigma == pytest.approx(np.sqrt(np.diag(P)[[0, 2]]), rel=1e-9)


def test_position_uncertainty_grows_without_bound() -> None:
    # x is unobservable: from P = 0, σ(x̂) of the Appendix F filter. Half a unit of the last digit.
    loop, sigma = Loop(Settings(), (0.0,) * 5, 0.0, 0.0), {}
    for k in range(1, 3001):
        loop.step((0.0, 0.0, 0.0), 0.0, 0.0)
        sigma[k] = loop.sigma[0]
    for updates, printed in {50: 0.0791, 500: 0.5348, 1000: 0.8530, 3000: 1.5870}.items():
        assert sigma[updates] == pytest.approx(printed, abs=5e-5), updates
    # a random walk in the end: σ² grows by the same amount each step
    assert (sigma[3000] ** 2 - sigma[2500] ** 2) / (sigma[2500] ** 2 - sigma[2000] ** 2) == pytest.approx(1.0, abs=1e-3)


# -- fixes of the position ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("estimator", "without", "with_fixes"), [(e, 4 if e == "consistent" else 3, 5) for e in ESTIMATORS]
)
def test_a_fix_makes_the_system_observable(estimator: str, without: int, with_fixes: int) -> None:
    settings = Settings(estimator="lagged")  # appendix F's own F has no inverse
    A, _ = design_model(settings)
    H = measurement_matrix(settings, estimator)
    for seen, rank in ((H, without), (np.vstack([H, fix_matrix(settings)]), with_fixes)):
        assert np.linalg.matrix_rank(control.obsv(A, seen), tol=1e-9) == rank  # entries lie between 1e-1 and 1e4
