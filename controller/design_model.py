"""Design model of the thesis, eqs 5.33 and 5.34, and the models of its filters.

The design model has the state (x, ẋ, ψ, ψ̇, a): distance along the craft's axis, its rate, heading,
yaw rate, thrust acceleration (F_Rx + F_Lx)/m, and the input (α_R, α_L). The thesis has the lag on the forward axis
only, the plant on both axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controller.settings import FilterSettings

Matrix = NDArray[np.float64]


def design_model(p: FilterSettings) -> tuple[Matrix, Matrix]:
    """Return A (5, 5) and B (5, 2) of eqs 5.33/5.34, with yaw damping d.

    The thesis has d = 0. A₁₂ = 1, A₂₂ = −c/m, A₂₅ = 1, A₃₄ = 1, A₄₄ = −d/Izz, A₅₅ = −1/τ;  B₄ = ±L·T_N/Izz, B₅ =
    T_N/(τ·m). Eq E.4 prints 34.27 and 24.17, from an older T_N and τ; eqs 5.36 and 6.5 need 41.85 and 40.07.
    """
    A, B = _zeros(p, 5, 5), _zeros(p, 5, 2)
    A[0, 1] = A[1, 4] = A[2, 3] = 1.0
    A[1, 1] = -p.friction / p.mass
    A[3, 3] = -p.yaw_damping / p.izz
    A[4, 4] = -1.0 / p.lag
    turn = p.arm * p.thrust_nominal / p.izz
    push = p.thrust_nominal / (p.lag * p.mass)
    B[3] = turn, -turn
    B[4] = push, push
    return A, B


def measurement_matrix(p: FilterSettings, estimator: str) -> Matrix:
    """Return H (3, 5) for the measurements (ψ, ψ̇, a_x), eq 5.43.

    The thesis equates the accelerometer with x₅. By Newton's law, the accelerometer measures total acceleration,
    a_x = x₅ − (c/m)·x₂: variant `consistent`, with observable ẋ.
    """
    H = _zeros(p, 3, 5)
    H[0, 2] = H[1, 3] = H[2, 4] = 1.0
    if estimator == "consistent":
        H[2, 1] = -p.friction / p.mass
    return H


def fix_matrix(p: FilterSettings) -> Matrix:
    """Return the measurement matrix H (1, 5) of a position fix with age T: x(t − T) = x − T·ẋ to first order."""
    H = _zeros(p, 1, 5)
    H[0, 0], H[0, 1] = 1.0, -p.fix_latency
    return H


def _zeros(p: FilterSettings, *shape: int) -> Matrix:
    """Return a zero matrix for floats, or for symbols of a printed design."""
    return np.zeros(shape, dtype=float if isinstance(p.mass, (int, float)) else object)


def discrete_model(p: FilterSettings) -> tuple[Matrix, Matrix]:
    """Return F (5, 5) and G (5, 2) of x̂ₖ₊₁ = F·x̂ₖ + G·uₖ.

    `appendix_f`: F = I + Δt·A, with an acceleration without memory: the last row of F is 0, that of G is T_N/m.
    `lagged`, `consistent`: eqs E.3/E.4 with their lag and held inputs, exact over Δt.
    """
    A, B = design_model(p)
    dt = p.sample_time
    if p.estimator == "appendix_f":
        F, G = np.eye(5) + dt * A, dt * B
        F[4], G[4] = 0.0, p.thrust_nominal / p.mass
        return F, G
    return discretize(A, B, dt)


def discretize(A: Matrix, B: Matrix, step: float) -> tuple[Matrix, Matrix]:
    """Return F and G of xₖ₊₁ = F·xₖ + G·uₖ for held inputs.

    Exact: [F G; 0 I] = exp(Δt·[A B; 0 0]).
    """
    from scipy.linalg import expm

    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    both = expm(step * block)
    return both[:n, :n], both[:n, n:]
