"""Linear models of the craft: the design model of the thesis, and the plant's fourteen states at hover.

The design model, eqs 5.33 and 5.34, has the state (x, ẋ, ψ, ψ̇, a): distance along the craft's axis, its rate, heading,
yaw rate, thrust acceleration (F_Rx + F_Lx)/m, and the input (α_R, α_L). The thesis has the lag on the forward axis
only, the plant on both axes (linearized in `cosim.model.symbolic.linearize`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controller.settings import PLANT_STATES, FilterSettings, FullSettings
from plant.hovercraft import INPUTS

Matrix = NDArray[np.float64]
PLANT_INPUTS = tuple(q.name for q in INPUTS)


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


def full_model(p: FullSettings) -> tuple[Matrix, Matrix]:
    """Return A (14, 14) and B (14, 4) about hover at ψ = 0, eqs 5.9-5.14 with 4.20 and 4.29.

    v̇x = −c/m·vx + T_N/m·(α_R + α_L)          v̇y = −c/m·vy − 2·T_N/m·φ
    ψ̈ = −d/Izz·ψ̇ + L·T_N/Izz·(α_R − α_L)      φ̈ = −k/Ixx·φ − d_φ/Ixx·φ̇ + L·Γ/Ixx·(T_R − T_L)
    Ṫ = (dT/dδ·δ − T)/τ                        α̇ = (α_cmd − α)/τ                 Ẋ = vx,  Ẏ = −vy

    States and inputs are those of the plant. Both axes have the lag; each propeller has its own thrust and tilt.
    """
    push, turn, lift = p.thrust_nominal / p.mass, p.arm * p.thrust_nominal / p.izz, p.arm * p.ground_gain / p.ixx
    drag, damping = -p.friction / p.mass, -p.yaw_damping / p.izz
    slopes = {
        "x": {"vx": 1.0},
        "y": {"vy": 1.0},
        "x_world": {"vx": 1.0},
        "y_world": {"vy": -1.0},
        "psi": {"psi_dot": 1.0},
        "phi": {"phi_dot": 1.0},
        "vx": {"vx": drag, "tilt_right": push, "tilt_left": push},
        "vy": {"vy": drag, "phi": -2.0 * push},
        "psi_dot": {"psi_dot": damping, "tilt_right": turn, "tilt_left": -turn},
        "phi_dot": {
            "phi": -p.roll_stiffness / p.ixx,
            "phi_dot": -p.roll_damping / p.ixx,
            "thrust_right": lift,
            "thrust_left": -lift,
        },
    }
    A, B, at = np.zeros((14, 14)), np.zeros((14, 4)), PLANT_STATES.index
    for k, state in enumerate(("thrust_right", "thrust_left", "tilt_right", "tilt_left")):
        slopes[state] = {state: -1.0 / p.lag}
        B[at(state), k] = (p.thrust_per_duty if k < 2 else 1.0) / p.lag
    for row, entries in slopes.items():
        for column, value in entries.items():
            A[at(row), at(column)] = value
    return A, B
