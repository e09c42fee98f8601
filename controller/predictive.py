"""Model predictive control with limits: the common part of all predictive laws, and the law linearized once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from controller.design_model import Matrix, discretize
from controller.full_model import INPUTS
from controller.horizon import AT_LIMIT, NAMES, Condensed, Program, condensed, limits, predicted, steady
from controller.laws import LawInput, OfLinearFilter
from controller.variants import PredictionSettings, PredictiveSettings

ESTIMATED = [NAMES.index(name) for name in ("x", "vx", "psi", "psi_dot")]  # states from the five-state filter
OWN = [k for k in range(len(NAMES)) if k not in ESTIMATED]  # states from the observer of this law
POSITIONS = [NAMES.index(name) for name in ("x", "y", "psi")]


class Predicting:
    """Optimal command of each sample within limits, started from the previous solution."""

    def __init__(self, p: PredictionSettings) -> None:
        self.rest, self.low, self.high = limits(p)
        self.program = Program(p)
        self.hot = self.program.cold()
        self.last = np.zeros(len(INPUTS))
        self.iterations, self.solved = 0, True
        self.sample = p.sample_time
        self.samples, self.given_up = (
            0,
            [0, 0, 0],
        )  # samples; failures: number, first sample, its flag

    @property
    def duties(self) -> tuple[float, float]:
        """Return the last command's duties [%], right and left."""
        right, left, *_ = (self.last + self.rest).tolist()
        return right, left

    def best(self, cost: Condensed) -> Matrix:
        """Update the command and return the scaled commands of every block."""
        found = self.program.solve(cost, self.hot)
        self.hot, self.iterations, self.solved = found.hot, found.iterations, found.solved
        if not found.solved:
            count, *first = self.given_up
            self.given_up = [count + 1, *(first if count else (self.samples, found.flag))]
        self.samples += 1
        self.last = np.clip(found.command, self.low, self.high) + 0.0  # clip rounding errors; -0.0 becomes 0.0
        return found.every

    @property
    def tilts(self) -> tuple[float, ...]:
        """Return the tilts [rad] of the last command, right and left."""
        return tuple((self.last + self.rest).tolist()[2:])

    def words(self, start: float) -> str:
        """Return a remark on solver failures: number and first time."""
        count, first, flag = self.given_up
        if not count:
            return ""
        at = start + first * self.sample
        why = f"its limit of {self.program.iterations} iterations (iterations_max) came first"
        return (
            f"the solver gave up in {count} of {self.samples} samples, first at t = {at:.6g} s:"
            f" {why if flag == AT_LIMIT else f'there it found no solution (flag {flag} of daqp)'}; the command is then"
            " the one without limits, cut off at them"
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the last command and the solver's start."""
        return {
            "last": self.last.tolist(),
            "hot": self.hot.tolist(),
            "told": [self.iterations, self.solved],
            "given_up": [self.samples, *self.given_up],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot exactly, since the solver has no other memory."""
        self.last, self.hot = np.array(snapshot["last"]), np.array(snapshot["hot"])
        self.iterations, self.solved = snapshot["told"]
        self.samples, *self.given_up = snapshot["given_up"]


class PredictiveLaw(Predicting, OfLinearFilter):
    """Predictive law for motors and tilts, optimal over the N steps of the horizon.

    The commands u minimise

         Σ (z'·Q·z + u'·R·u)·Δ + z_N'·P·z_N,   z_{j+1} = F·z_j + G·u_j,   |α| ≤ tilt_max,   duty_min ≤ δ ≤ duty_max

    with z the deviation from rest at the references of x, y and ψ, and P the cost to go of the LQR. Without active
    limits, the law equals the LQR. The filter provides x, ẋ, ψ and ψ̇; y, roll, thrusts and tilts follow from the
    commands, with corrections by fixes of y. An infeasible speed limit is exceeded. At the solver's iteration limit,
    the unconstrained command is clipped and `solved` is 0.
    """

    def __init__(self, p: PredictiveSettings, y_hat: float = 0.0) -> None:
        super().__init__(p)
        self.observer = _observer(p, y_hat)
        self.cost = condensed(p, steady(p), np.eye(len(NAMES)), self.program.scale)
        self.fix = 0.0

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad]; `duties` holds the duties."""
        if seen.started:
            self.observer.predict(u=self.last)
            if seen.fix != self.fix:
                self.observer.update(np.array([seen.y_meas]))
        self.fix = seen.fix
        z = np.zeros(len(NAMES))
        z[OWN], z[ESTIMATED] = self.observer.x, x_hat[: len(ESTIMATED)]
        z[POSITIONS] -= seen.x_ref, seen.y_ref, seen.psi_ref
        self.best(self.cost.at(z))
        return self.tilts

    def outputs(self) -> list[float]:
        """Return ŷ [m], its standard deviation, iterations, and 1 for solved."""
        sigma = math.sqrt(max(0.0, self.observer.P[0, 0]))
        return [float(self.observer.x[0]), sigma, float(self.iterations), float(self.solved)]

    def snapshot(self) -> dict[str, Any]:
        """Return the state with the law's own estimate."""
        own = {"x": self.observer.x.tolist(), "P": self.observer.P.tolist(), "fix": self.fix}
        return {**own, **super().snapshot()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state with the law's own estimate."""
        self.observer.x, self.observer.P = np.array(snapshot["x"]), np.array(snapshot["P"])
        self.fix = snapshot["fix"]
        super().restore(snapshot)


def _observer(p: PredictiveSettings, y_hat: float) -> KalmanFilter:
    """Return the filter of y, vy, roll, thrusts and tilts, started at rest with P = 0.

    Commands drive the filter; fixes of y correct it.
    """
    A, B = predicted(p)
    n, at = len(OWN), [NAMES[k] for k in OWN]
    kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=len(INPUTS))
    kf.F, kf.B = discretize(A[np.ix_(OWN, OWN)], B[OWN], p.sample_time)
    kf.x, kf.P, kf.Q, kf.H = np.zeros(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros((1, n))
    y, vy = at.index("y"), at.index("vy")
    kf.x[y] = y_hat
    kf.Q[y, y], kf.Q[vy, vy] = p.process_variance_x, p.process_variance_vx  # equal to the noise along the craft's axis
    kf.H[0, y], kf.H[0, vy] = 1.0, -p.fix_latency
    kf.R = np.eye(1) * p.measurement_variance_x  # same sensor as for x
    return kf
