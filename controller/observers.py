"""Estimators of a controller or beside one: Kalman filters of the thesis on filterpy, and double integration (§5.6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np
from filterpy.kalman import KalmanFilter

from controller.design_model import Matrix, discrete_model, fix_matrix, measurement_matrix
from controller.settings import FilterSettings


class Stateful:
    """An object whose complete state is in attributes, also of its parts: numbers, lists and arrays.

    Attributes:
        memory: Their names, such as `filter.x`.
    """

    memory: ClassVar[tuple[str, ...]] = ()

    def snapshot(self) -> dict[str, Any]:
        """Return the complete state as plain numbers."""
        values = {name: attrgetter(name)(self) for name in self.memory}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot exactly."""
        for name, value in snapshot.items():
            part, _, own = name.rpartition(".")
            owner = getattr(self, part) if part else self
            is_array = isinstance(getattr(owner, own), np.ndarray)
            setattr(owner, own, np.array(value) if is_array else value)


class Estimator(Stateful):
    """A state estimator, by default a filter of filterpy.

    Attributes:
        fix: Number of the latest position fix.
        nis, fix_nis: Normalised squared innovation of the last sample, and of the last fix.
    """

    memory: ClassVar[tuple[str, ...]] = ("filter.x", "filter.P", "fix", "nis")
    filter: Any
    fix, nis, fix_nis = 0.0, 0.0, 0.0

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
        """Process a sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            command: Duties [%] and tilts [rad] that acted until now.
            fix: Number of the latest position fix.
            position: Latest position fix (x, y) [m].
        """
        raise NotImplementedError

    @property
    def estimate(self) -> tuple[float, ...]:
        """Return (x, ẋ, ψ, ψ̇, a) of the five-state model, then y, 0 where it is not estimated."""
        raise NotImplementedError

    @property
    def sigma(self) -> tuple[float, ...]:
        """Return estimated standard deviations of x, ψ and y."""
        raise NotImplementedError

    def squared_innovation(self) -> float:
        """Return the normalised squared innovation of the last update."""
        return float(self.filter.y @ self.filter.SI @ self.filter.y)


def kalman_filter(p: FilterSettings, x_hat: Matrix) -> KalmanFilter:
    """Return a filter with known start: P = 0, V and W of eqs 5.46 and 5.47."""
    kf = KalmanFilter(dim_x=5, dim_z=3, dim_u=2)
    kf.x = np.array(x_hat, dtype=float)
    kf.P = np.zeros((5, 5))
    kf.F, kf.B = discrete_model(p)
    kf.H = measurement_matrix(p, p.estimator)
    kf.Q = np.diag(p.process_variances)
    kf.R = np.diag(p.measurement_variances)
    return kf


class LinearFilter(Estimator):
    """Kalman filter of the thesis, eqs 5.37-5.41, as in the controller: prediction, update, new fix."""

    def __init__(self, settings: FilterSettings, start: Sequence[float], fix: float = 0.0) -> None:
        self.filter = kalman_filter(settings, np.array(start, dtype=float))
        self.fix_matrix, self.fix_noise = fix_matrix(settings), np.diag((settings.measurement_variance_x,))
        self.fix = fix

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
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
        return *self.filter.x.tolist(), 0.0

    @property
    def sigma(self) -> tuple[float, ...]:
        P = self.filter.P
        return math.sqrt(max(0.0, P[0, 0])), math.sqrt(max(0.0, P[2, 2])), 0.0


class DoubleIntegration(Estimator):
    """Integrated acceleration with measured heading and yaw rate (Figs 5.5-5.7), without fixes.

    v̂ += Δt·a_x,   x̂ += Δt·v̂ + Δt²/2·a_x,   P = F·P·F' + g·W_a·g',   g = (Δt²/2, Δt)
    """

    memory = ("values", "variances")

    def __init__(self, settings: FilterSettings, start: Sequence[float], fix: float = 0.0) -> None:
        self.dt, self.noise = settings.sample_time, settings.measurement_variances
        self.values = [float(v) for v in start]
        self.variances = [0.0, 0.0, 0.0]  # variances of x̂, of x̂ with v̂, and of v̂

    def step(
        self, measured: Sequence[float], command: Sequence[float], fix: float = 0.0, position: Sequence[float] = (0, 0)
    ) -> None:
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
        return *self.values, 0.0

    @property
    def sigma(self) -> tuple[float, ...]:
        return math.sqrt(self.variances[0]), math.sqrt(self.noise[0]), 0.0
