"""Offline stability test of fixed gains in the sampled control loop with actuator lag and filter.

Eqs 5.33/5.34 describe the turn without lag and without sampling. The real loop has both, and it feeds back the
filter's estimate instead of the true state.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from controller.design_model import Matrix, discretize
from controller.full_model import INPUTS, STATES, full_model
from controller.kalman import kalman_filter
from controller.variants import FullSettings

# States that depend on the tilts and act on the IMU: not x, roll, y and thrusts.
PREDICTED = [STATES.index(name) for name in ("vx", "psi", "psi_dot", "tilt_right", "tilt_left")]
TILTS = [INPUTS.index(name) for name in ("tilt_right", "tilt_left")]
PSI, PSI_DOT, RIGHT, LEFT = 1, 2, 3, 4  # indices among these states
TURNING = {PSI, PSI_DOT, 5 + 2, 5 + 3, 10 + 1}  # indices among all states of the loop, without tilts
GROWS = 1e-3  # [rad/s] poles further right grow; uncontrolled poles are at 0 within rounding
MIN_DAMPING = 0.1  # a swing keeps exp(-2π·0.1), more than half of its size, from one to the next
MAX_CHANGE, MAX_UPDATES = 1e-9, 3000  # convergence of the filter gain


class LoopMode(NamedTuple):
    """A pole of the sampled loop, written as s = ln(z)/Δt [rad/s], and the axis of its motion: forward or turning."""

    pole: complex
    axis: str

    @property
    def grows(self) -> bool:
        """Return True if the mode grows: its pole z is outside the unit circle."""
        return self.pole.real > GROWS

    @property
    def damping(self) -> float:
        """Return ζ = −Re s/|s|, 1 without oscillation."""
        return -self.pole.real / abs(self.pole) if self.pole.imag else 1.0


class FlownLoop:
    """Craft, hold and filter at hover with ψ = 0, without saturation and fixes, for varying gains.

         xₖ₊₁ = F·xₖ + G·uₖ,   zₖ₊₁ = H·xₖ₊₁,   x̂ₖ₊₁ = F̂·x̂ₖ + Ĝ·uₖ + L·(zₖ₊₁ − Ĥ·(F̂·x̂ₖ + Ĝ·uₖ)),   uₖ = −K·x̂ₖ −
         K_i·ξₖ

    F, G belong to the craft with lag on both axes and held inputs; F̂, Ĝ, Ĥ to the controller's parameters p, which may
    differ; L is the steady gain of the estimator.

    Raises:
        LinAlgError: The estimator has no steady gain.
    """

    def __init__(self, craft: FullSettings, p: FullSettings) -> None:
        A, B = full_model(craft)
        A, B = A[np.ix_(PREDICTED, PREDICTED)], B[np.ix_(PREDICTED, TILTS)]
        self.sample = p.sample_time
        self.craft = discretize(A, B, p.sample_time)
        self.H = np.vstack([np.eye(len(A))[[PSI, PSI_DOT]], A[:1]])  # a_x = v̇x
        kf = kalman_filter(p, np.zeros(5))
        last = np.zeros((5, 3))
        for _ in range(MAX_UPDATES):
            kf.predict()
            kf.update(np.zeros(3))
            if np.abs(kf.K - last).max() <= MAX_CHANGE:
                break
            last = kf.K.copy()
        self.filter, self.H_hat, self.correction = (kf.F, kf.B), kf.H, kf.K

    def matrix(self, K: Matrix, K_i: Matrix | None = None) -> Matrix:
        """Return the transition matrix of the craft's five states, x̂ and optional integrals of x and ψ."""
        u = -np.hstack([np.zeros((2, 5)), K, *([] if K_i is None else [K_i])])
        n = u.shape[1]
        (F, G), (F_hat, G_hat), now = self.craft, self.filter, np.eye(n)
        x = F @ now[:5] + G @ u
        predicted = F_hat @ now[5:10] + G_hat @ u
        x_hat = predicted + self.correction @ (self.H @ x - self.H_hat @ predicted)
        integrals = now[10:] + self.sample * np.vstack([x_hat[:1], x[PSI : PSI + 1]]) if n > 10 else now[10:]
        return np.vstack([x, x_hat, integrals])

    def modes(self, K: Matrix, K_i: Matrix | None = None) -> list[LoopMode]:
        """Return all modes, fastest growth first."""
        values, vectors = np.linalg.eig(self.matrix(K, K_i))
        pairs = zip(values.tolist(), vectors.T, strict=True)
        modes = [LoopMode(cmath.log(z) / self.sample, _axis(vector)) for z, vector in pairs if z]
        return sorted(modes, key=lambda mode: -mode.pole.real)


def _axis(vector: Matrix) -> str:
    """Return the axis of a mode: common tilt for forward, tilt difference for turning."""
    weight = np.abs(vector) ** 2
    turning = abs(vector[RIGHT] - vector[LEFT]) ** 2 / 2 + sum(weight[k] for k in TURNING if k < len(weight))
    return "turning" if turning > 0.5 * weight.sum() else "forward"


def worst_modes(modes: Sequence[LoopMode]) -> list[LoopMode]:
    """Return the worst growing or weakly damped mode of each axis."""
    by_axis: dict[str, LoopMode] = {}
    for mode in sorted(modes, key=lambda m: (not m.grows, -m.pole.real if m.grows else m.damping)):
        if mode.grows or mode.damping < MIN_DAMPING:
            by_axis.setdefault(mode.axis, mode)
    return list(by_axis.values())


def swing_ratio(damping: float) -> float:
    """Return the ratio of successive swings, exp(−2πζ/√(1 − ζ²))."""
    return math.exp(-2 * math.pi * damping / math.sqrt(1 - damping**2))
