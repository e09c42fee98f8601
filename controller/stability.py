"""Whether fixed gains are stable as they fly, where the design model of the thesis only promises it: offline.

Eqs 5.33/5.34 have no lag of the turn, and no sample. What flies has both, and feeds back what its filter believes.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from controller.design_model import Matrix
from controller.full_model import INPUTS, STATES, full_model, held
from controller.kalman import kalman_filter
from controller.variants import FullSettings

# Of the fourteen states those that tilts move and the IMU sees. x is in no measurement and moves nothing; roll, y and
# thrusts no tilt moves.
MOVED = [STATES.index(name) for name in ("vx", "psi", "psi_dot", "tilt_right", "tilt_left")]
TILTS = [INPUTS.index(name) for name in ("tilt_right", "tilt_left")]
PSI, PSI_DOT, RIGHT, LEFT = 1, 2, 3, 4  # places among them
TURNING = {PSI, PSI_DOT, 5 + 2, 5 + 3, 10 + 1}  # of all states of the loop, tilts apart
GROWS = 1e-3  # [rad/s] a pole further to the right grows; what no gain moves stands at 0, to a rounding
LEAST_DAMPING = 0.1  # a swing keeps exp(-2π·0.1), more than half of its size, from one to the next
SETTLED, MOST_UPDATES = 1e-9, 3000  # the filter's gain is steady


class Mode(NamedTuple):
    """A pole of the sampled loop as s = ln(z)/Δt [rad/s], and the axis that it is of: forward or turning."""

    pole: complex
    axis: str

    @property
    def grows(self) -> bool:
        """Whether it is outside the unit circle."""
        return self.pole.real > GROWS

    @property
    def damping(self) -> float:
        """ζ = −Re s/|s|; 1 where nothing swings."""
        return -self.pole.real / abs(self.pole) if self.pole.imag else 1.0


class FlownLoop:
    """Craft, hold and filter about hover at ψ = 0, no tilt saturated, without fixes; of a law only its gains are new.

        xₖ₊₁ = F·xₖ + G·uₖ,   zₖ₊₁ = H·xₖ₊₁,   x̂ₖ₊₁ = F̂·x̂ₖ + Ĝ·uₖ + L·(zₖ₊₁ − Ĥ·(F̂·x̂ₖ + Ĝ·uₖ)),   uₖ = −K·x̂ₖ − K_i·ξₖ

    F, G of the craft with its lag on both axes, inputs held; F̂, Ĝ, Ĥ by the numbers p of the controller, which may be
    others than the craft's, L its estimator's gain once steady. Raises LinAlgError where that estimator has none.
    """

    def __init__(self, craft: FullSettings, p: FullSettings) -> None:
        A, B = full_model(craft)
        A, B = A[np.ix_(MOVED, MOVED)], B[np.ix_(MOVED, TILTS)]
        self.sample = p.sample_time
        self.craft = held(A, B, p.sample_time)
        self.seen = np.vstack([np.eye(len(A))[[PSI, PSI_DOT]], A[:1]])  # a_x = v̇x
        kf = kalman_filter(p, np.zeros(5))
        last = np.zeros((5, 3))
        for _ in range(MOST_UPDATES):
            kf.predict()
            kf.update(np.zeros(3))
            if np.abs(kf.K - last).max() <= SETTLED:
                break
            last = kf.K.copy()
        self.filter, self.believed, self.correction = (kf.F, kf.B), kf.H, kf.K

    def matrix(self, K: Matrix, K_i: Matrix | None = None) -> Matrix:
        """From one sample to the next: the craft's five states, x̂ and, with K_i (2, 2), the integrals of x and ψ."""
        gains = [np.zeros((2, 5)), K, *([] if K_i is None else [K_i])]
        u = -np.hstack(gains)
        n = u.shape[1]
        (F, G), (F_hat, G_hat), now = self.craft, self.filter, np.eye(n)
        x = F @ now[:5] + G @ u
        predicted = F_hat @ now[5:10] + G_hat @ u
        x_hat = predicted + self.correction @ (self.seen @ x - self.believed @ predicted)
        grown = now[10:] + self.sample * np.vstack([x_hat[:1], x[PSI : PSI + 1]]) if n > 10 else now[10:]
        return np.vstack([x, x_hat, grown])

    def modes(self, K: Matrix, K_i: Matrix | None = None) -> list[Mode]:
        """Every mode, that which grows fastest first."""
        values, vectors = np.linalg.eig(self.matrix(K, K_i))
        found = [
            Mode(cmath.log(z) / self.sample, _axis(v)) for z, v in zip(values.tolist(), vectors.T, strict=True) if z
        ]
        return sorted(found, key=lambda mode: -mode.pole.real)


def _axis(vector: Matrix) -> str:
    """Where a mode is: the tilts together move the craft forward, against each other they turn it."""
    weight = np.abs(vector) ** 2
    turning = abs(vector[RIGHT] - vector[LEFT]) ** 2 / 2 + sum(weight[k] for k in TURNING if k < len(weight))
    return "turning" if turning > 0.5 * weight.sum() else "forward"


def worst(modes: Sequence[Mode]) -> list[Mode]:
    """Of each axis the mode that grows, or swings hardly damped, if there is one."""
    told: dict[str, Mode] = {}
    for mode in sorted(modes, key=lambda m: (not m.grows, -m.pole.real if m.grows else m.damping)):
        if mode.grows or mode.damping < LEAST_DAMPING:
            told.setdefault(mode.axis, mode)
    return list(told.values())


def kept(damping: float) -> float:
    """What a swing keeps of its size from one to the next: exp(−2πζ/√(1 − ζ²))."""
    return math.exp(-2 * math.pi * damping / math.sqrt(1 - damping**2))
