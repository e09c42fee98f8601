"""What runs in the loop at each sample: predict, update, feed back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from controller.gains import Settings
from controller.kalman import kalman_filter
from controller.lqr import feedback


class Loop:
    """The controller at run time. Order at a sample: predict with the last command, update with (ψ, ψ̇, a_x), feed back.

        x̂ = F·x̂ + G·u,   P = F·P·F' + V                                             (5.37, 5.38)
        K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P               (5.39-5.41)
        u = sat(−K_lqr·(x̂ − x_ref), ±tilt_max),   x_ref = (x_ref, 0, psi_ref, 0, 0)  (6.1)

    State (x, vx, ψ, ψ̇, a), a the thrust acceleration. At the start there is no update: u₀ = sat(−K·(x̂₀ − x_ref)),
    P = 0. x is not observable with these sensors: the filter must be told where it starts.
    """

    def __init__(self, settings: Settings, x_hat: Sequence[float], x_ref: float, psi_ref: float) -> None:
        self.settings = settings
        self.gain = settings.gain_matrix
        self.filter = kalman_filter(settings, np.array(x_hat, dtype=float))
        self.command = self._feedback(x_ref, psi_ref)

    def step(self, measured: Sequence[float], x_ref: float, psi_ref: float) -> tuple[float, ...]:
        """Tilt commands [rad] from the measurements (ψ, ψ̇, a_x) and references of one sample."""
        self.filter.predict(u=np.array(self.command))
        self.filter.update(np.array(measured))
        self.command = self._feedback(x_ref, psi_ref)
        return self.command

    @property
    def estimate(self) -> list[float]:
        """x̂ = (x, ẋ, ψ, ψ̇, a)."""
        x_hat: list[float] = self.filter.x.tolist()
        return x_hat

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviations of x [m] and ψ [rad] the filter believes in; a rounding below zero counts as zero."""
        P = self.filter.P
        return math.sqrt(max(0.0, P[0, 0])), math.sqrt(max(0.0, P[2, 2]))

    def snapshot(self) -> dict[str, Any]:
        """All that decides the future, as plain numbers: x̂, P, last command."""
        return {"x": self.estimate, "P": self.filter.P.tolist(), "command": list(self.command)}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot, bit for bit."""
        self.filter.x = np.array(snapshot["x"])
        self.filter.P = np.array(snapshot["P"])
        self.command = tuple(snapshot["command"])

    def _feedback(self, x_ref: float, psi_ref: float) -> tuple[float, ...]:
        return feedback(self.gain, self.estimate, (x_ref, 0.0, psi_ref, 0.0, 0.0), self.settings.tilt_max)
