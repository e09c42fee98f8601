"""Estimators beside a controller: Kalman filters of the thesis, and double integration (§5.6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from controller.design_model import fix_matrix
from controller.gains import ESTIMATORS, Settings
from controller.kalman import kalman_filter

DOUBLE_INTEGRATION = "double_integration"
OBSERVERS = (*ESTIMATORS, DOUBLE_INTEGRATION)
# Double integration of a held a_x over a sample: x̂ += Δt·v̂ + Δt²/2·a, v̂ += Δt·a.


class SampledFilter:
    """A filterpy filter with a state for the FMU."""

    filter: Any
    fix, nis, fix_nis = 0.0, 0.0, 0.0

    def snapshot(self) -> dict[str, Any]:
        """Return the complete state, and the displayed NIS."""
        return {"x": self.filter.x.tolist(), "P": self.filter.P.tolist(), "fix": self.fix, "nis": self.nis}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot exactly."""
        self.filter.x, self.filter.P = np.array(snapshot["x"]), np.array(snapshot["P"])
        self.fix, self.nis = snapshot["fix"], snapshot["nis"]

    def squared_innovation(self) -> float:
        """Return the normalised squared innovation of the last update."""
        return float(self.filter.y @ self.filter.SI @ self.filter.y)


class LinearFilter(SampledFilter):
    """Kalman filter of the thesis, eqs 5.37-5.41, as in the controller: prediction, update, new fix."""

    def __init__(self, settings: Settings, start: Sequence[float], fix: float = 0.0) -> None:
        self.filter = kalman_filter(settings, np.array(start, dtype=float))
        self.fix_matrix, self.fix_noise = fix_matrix(settings), np.diag(settings.fix_variances)
        self.fix = fix

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
        """Process a sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            command: Duties [%] and tilts [rad] until now.
            fix: Number of the latest position fix.
            position: Latest position fix (x, y) [m].
        """
        kf = self.filter
        kf.predict(u=np.array(command[2:]))
        kf.update(np.array(measured))
        self.nis = self.squared_innovation()
        if fix != self.fix:
            self.fix = fix
            kf.update(np.array(position[:1]), self.fix_noise, self.fix_matrix)
            self.fix_nis = self.squared_innovation()

    @property
    def estimate(self) -> tuple[float, ...]:
        """Return (x, ẋ, ψ, ψ̇, a), then 0 for y."""
        return *self.filter.x.tolist(), 0.0

    @property
    def sigma(self) -> tuple[float, ...]:
        """Return estimated standard deviations of x, ψ and y."""
        P = self.filter.P
        return math.sqrt(max(0.0, P[0, 0])), math.sqrt(max(0.0, P[2, 2])), 0.0


class DoubleIntegration:
    """Integrated acceleration with measured heading and yaw rate (Figs 5.5-5.7), without fixes.

    v̂ += Δt·a_x,   x̂ += Δt·v̂ + Δt²/2·a_x,   P = F·P·F' + g·W_a·g',   g = (Δt²/2, Δt)
    """

    nis = 0.0

    def __init__(self, settings: Settings, start: Sequence[float], fix: float = 0.0) -> None:
        self.dt, self.noise = settings.sample_time, settings.measurement_variances
        self.values = [float(v) for v in start]
        self.variances = [0.0, 0.0, 0.0]  # variances of x̂, of x̂ with v̂, and of v̂
        self.fix = fix

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
        """Process a sample of (ψ, ψ̇, a_x); further arguments are unused."""
        dt, W = self.dt, self.noise[2]
        x, v, *_ = self.values
        psi, psi_dot, ax = measured
        self.values = [x + dt * v + 0.5 * dt * dt * ax, v + dt * ax, psi, psi_dot, ax]
        xx, xv, vv = self.variances
        self.variances = [
            xx + dt * (2.0 * xv + dt * vv) + 0.25 * dt**4 * W,
            xv + dt * vv + 0.5 * dt**3 * W,
            vv + dt * dt * W,
        ]

    @property
    def estimate(self) -> tuple[float, ...]:
        """Return (x, ẋ, ψ, ψ̇, a), then 0 for y."""
        return *self.values, 0.0

    @property
    def sigma(self) -> tuple[float, ...]:
        """Return the standard deviations of x, ψ and y from sensor noise."""
        return math.sqrt(self.variances[0]), math.sqrt(self.noise[0]), 0.0

    def snapshot(self) -> dict[str, Any]:
        """Return estimates and their variances, for a later restore."""
        return {"values": self.values, "variances": self.variances}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot exactly."""
        self.values, self.variances = list(snapshot["values"]), list(snapshot["variances"])
