"""Offline stability test of fixed gains in the sampled control loop with actuator lag and filter.

Eqs 5.33/5.34 describe the turn without lag and without sampling. The real loop has both, and it feeds back the
filter's estimate instead of the true state.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from controller.design_model import PLANT_INPUTS, Matrix, discretize, full_model
from controller.observers import kalman_filter
from controller.settings import PLANT_STATES, FullSettings

# States that depend on the tilts and act on the IMU: not x, roll, y and thrusts.
SEEN = [PLANT_STATES.index(name) for name in ("vx", "psi", "psi_dot", "tilt_right", "tilt_left")]
TILTS = [PLANT_INPUTS.index(name) for name in ("tilt_right", "tilt_left")]
PSI, PSI_DOT, RIGHT, LEFT = 1, 2, 3, 4  # indices among these states
TURNING = {PSI, PSI_DOT, 5 + 2, 5 + 3, 10 + 1}  # indices among all states of the loop, without tilts
MAX_GROWTH = 1e-3  # [rad/s] poles further right grow; uncontrolled poles are at 0 within rounding
MIN_DAMPING = 0.1  # a swing keeps exp(-2π·0.1), more than half of its size, from one to the next
MAX_CHANGE, MAX_UPDATES = 1e-9, 3000  # convergence of the filter gain


class LoopMode(NamedTuple):
    """A pole of the sampled loop, written as s = ln(z)/Δt [rad/s], and the axis of its motion: forward or turning."""

    pole: complex
    axis: str

    @property
    def grows(self) -> bool:
        """Return True if the mode grows: its pole z is outside the unit circle."""
        return self.pole.real > MAX_GROWTH

    @property
    def damping(self) -> float:
        """Return ζ = −Re s/|s|, 1 without oscillation."""
        return -self.pole.real / abs(self.pole) if self.pole.imag else 1.0


def flown_modes(p: FullSettings, K: Matrix, K_i: Matrix | None = None) -> list[LoopMode]:
    """Return the modes of craft, hold and filter at hover with ψ = 0, without saturation and fixes, fastest first.

         xₖ₊₁ = F·xₖ + G·uₖ,   zₖ₊₁ = H·xₖ₊₁,   x̂ₖ₊₁ = F̂·x̂ₖ + Ĝ·uₖ + L·(zₖ₊₁ − Ĥ·(F̂·x̂ₖ + Ĝ·uₖ)),   uₖ = −K·x̂ₖ −
         K_i·ξₖ

    F, G belong to the craft with lag on both axes and held inputs; F̂, Ĝ, Ĥ to the design model, both with the numbers
    p of the controller; L is the steady gain of the estimator. The modes are those of the craft's five states, x̂ and
    optional integrals ξ of x and ψ.

    Raises:
        LinAlgError: The estimator has no steady gain.
    """
    A, B = full_model(p)
    A, B = A[np.ix_(SEEN, SEEN)], B[np.ix_(SEEN, TILTS)]
    F, G = discretize(A, B, p.sample_time)
    H = np.vstack([np.eye(len(A))[[PSI, PSI_DOT]], A[:1]])  # a_x = v̇x
    kf, last = kalman_filter(p, np.zeros(5)), np.zeros((5, 3))
    for _ in range(MAX_UPDATES):
        kf.predict()
        kf.update(np.zeros(3))
        if np.abs(kf.K - last).max() <= MAX_CHANGE:
            break
        last = kf.K.copy()
    u = -np.hstack([np.zeros((2, 5)), K, *([] if K_i is None else [K_i])])
    n = u.shape[1]
    now = np.eye(n)
    x = F @ now[:5] + G @ u
    predicted = kf.F @ now[5:10] + kf.B @ u
    x_hat = predicted + kf.K @ (H @ x - kf.H @ predicted)
    integrals = now[10:] + p.sample_time * np.vstack([x_hat[:1], x[PSI : PSI + 1]]) if n > 10 else now[10:]
    values, vectors = np.linalg.eig(np.vstack([x, x_hat, integrals]))
    modes = []
    for z, vector in zip(values.tolist(), vectors.T, strict=True):
        if z:  # common tilt for forward, tilt difference for turning
            weight = np.abs(vector) ** 2
            turning = abs(vector[RIGHT] - vector[LEFT]) ** 2 / 2 + sum(weight[k] for k in TURNING if k < n)
            axis = "turning" if turning > 0.5 * weight.sum() else "forward"
            modes.append(LoopMode(cmath.log(z) / p.sample_time, axis))
    return sorted(modes, key=lambda mode: -mode.pole.real)


def worst_modes(modes: Sequence[LoopMode]) -> list[LoopMode]:
    """Return the worst growing or weakly damped mode of each axis."""
    by_axis: dict[str, LoopMode] = {}
    for mode in sorted(modes, key=lambda m: (not m.grows, -m.pole.real if m.grows else m.damping)):
        if mode.grows or mode.damping < MIN_DAMPING:
            by_axis.setdefault(mode.axis, mode)
    return list(by_axis.values())
