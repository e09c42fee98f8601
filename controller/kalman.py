"""Kalman filter of the thesis (Appendix F) on filterpy, and two variants closer to the craft."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter

from controller.design_model import Matrix, design_model, discretize, measurement_matrix
from controller.gains import Settings


def discrete_model(p: Settings) -> tuple[Matrix, Matrix]:
    """Return F (5, 5) and G (5, 2) of x̂ₖ₊₁ = F·x̂ₖ + G·uₖ.

    `appendix_f`: F = I + Δt·A, with a memoryless acceleration: last row of F zero, of G T_N/m.
    `lagged`, `consistent`: eqs E.3/E.4 with their lag and held inputs, exact over Δt.
    """
    A, B = design_model(p)
    dt = p.sample_time
    if p.estimator == "appendix_f":
        F, G = np.eye(5) + dt * A, dt * B
        F[4], G[4] = 0.0, p.thrust_nominal / p.mass
        return F, G
    return discretize(A, B, dt)


def kalman_filter(p: Settings, x_hat: Matrix) -> KalmanFilter:
    """Return a filter with known start: P = 0, V and W of eqs 5.46 and 5.47."""
    kf = KalmanFilter(dim_x=5, dim_z=3, dim_u=2)
    kf.x = np.array(x_hat, dtype=float)
    kf.P = np.zeros((5, 5))
    kf.F, kf.B = discrete_model(p)
    kf.H = measurement_matrix(p, p.estimator)
    kf.Q = np.diag(p.process_variances)
    kf.R = np.diag(p.measurement_variances)
    return kf
