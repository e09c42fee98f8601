"""Model predictive control with limits: what every predictive law does, and the one that is linearised once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter

from controller.design_model import Matrix
from controller.full_model import INPUTS, held
from controller.horizon import AT_LIMIT, NAMES, Condensed, Program, condensed, limits, predicted, steady
from controller.laws import OfLinearFilter, Seen
from controller.variants import PredictionSettings, PredictiveSettings

ESTIMATED = [NAMES.index(name) for name in ("x", "vx", "psi", "psi_dot")]  # by the filter of five states
OWN = [k for k in range(len(NAMES)) if k not in ESTIMATED]  # by the one here
POSITIONS = [NAMES.index(name) for name in ("x", "y", "psi")]


class Predicting:
    """The best command of each sample within the limits, its solver started from the sample before."""

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
        )  # how many; of those without a solution how many, the first, its flag

    @property
    def duties(self) -> tuple[float, float]:
        """Duties [%] of the last command, right and left."""
        right, left, *_ = (self.last + self.rest).tolist()
        return right, left

    def best(self, cost: Condensed) -> Matrix:
        """Solve for the next command, which `last` then is; return the scaled commands of every block."""
        found = self.program.solve(cost, self.hot)
        self.hot, self.iterations, self.solved = found.hot, found.iterations, found.solved
        if not found.solved:
            count, *first = self.given_up
            self.given_up = [count + 1, *(first if count else (self.samples, found.flag))]
        self.samples += 1
        self.last = np.clip(found.command, self.low, self.high) + 0.0  # within a rounding; -0.0 is 0.0
        return found.every

    @property
    def tilts(self) -> tuple[float, ...]:
        """Tilts [rad] of the last command, right and left."""
        return tuple((self.last + self.rest).tolist()[2:])

    def words(self, start: float) -> str:
        """That the solver gave up, how often and when first."""
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
        """Its last command, and where the solver starts from."""
        return {
            "last": self.last.tolist(),
            "hot": self.hot.tolist(),
            "told": [self.iterations, self.solved],
            "given_up": [self.samples, *self.given_up],
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Bit for bit: the solver keeps nothing from one sample to the next but what it is started from."""
        self.last, self.hot = np.array(snapshot["last"]), np.array(snapshot["hot"])
        self.iterations, self.solved = snapshot["told"]
        self.samples, *self.given_up = snapshot["given_up"]


class PredictiveLaw(Predicting, OfLinearFilter):
    """Commands u of both motors and both tilts that minimise, over the N steps of the horizon,

        Σ (z'·Q·z + u'·R·u)·Δ + z_N'·P·z_N,   z_{j+1} = F·z_j + G·u_j,   |α| ≤ tilt_max,   duty_min ≤ δ ≤ duty_max

    z the deviation from rest at the references of x, y and ψ; P the cost to go of the LQR, which this law is where no
    limit is touched. x, ẋ, ψ and ψ̇ are the filter's; y, roll, thrusts and tilts follow from what was commanded,
    corrected by fixes of y. A limit of speed is given up where it cannot be kept. Where the solver comes to its
    limit of iterations, the command is that without limits, cut off at them, and `solved` is 0.
    """

    def __init__(self, p: PredictiveSettings, y_hat: float = 0.0) -> None:
        super().__init__(p)
        self.observer = _observer(p, y_hat)
        self.cost = condensed(p, steady(p), np.eye(len(NAMES)), self.program.scale)
        self.fix = 0.0

    def command(self, x_hat: Sequence[float], seen: Seen) -> tuple[float, ...]:
        """Tilts [rad]; the duties stand in `duties`."""
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
        """ŷ [m] and its standard deviation, iterations, whether they ended in a solution."""
        sigma = math.sqrt(max(0.0, self.observer.P[0, 0]))
        return [float(self.observer.x[0]), sigma, float(self.iterations), float(self.solved)]

    def snapshot(self) -> dict[str, Any]:
        """Its own estimate too."""
        own = {"x": self.observer.x.tolist(), "P": self.observer.P.tolist(), "fix": self.fix}
        return {**own, **super().snapshot()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Its own estimate too."""
        self.observer.x, self.observer.P = np.array(snapshot["x"]), np.array(snapshot["P"])
        self.fix = snapshot["fix"]
        super().restore(snapshot)


def _observer(p: PredictiveSettings, y_hat: float) -> KalmanFilter:
    """Filter of y, vy, roll, thrusts and tilts, driven by the commands and corrected by fixes of y; P = 0, at rest."""
    A, B = predicted(p)
    n, at = len(OWN), [NAMES[k] for k in OWN]
    kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=len(INPUTS))
    kf.F, kf.B = held(A[np.ix_(OWN, OWN)], B[OWN], p.sample_time)
    kf.x, kf.P, kf.Q, kf.H = np.zeros(n), np.zeros((n, n)), np.zeros((n, n)), np.zeros((1, n))
    y, vy = at.index("y"), at.index("vy")
    kf.x[y] = y_hat
    kf.Q[y, y], kf.Q[vy, vy] = p.process_variance_x, p.process_variance_vx  # as along the craft's axis
    kf.H[0, y], kf.H[0, vy] = 1.0, -p.fix_latency
    kf.R = np.eye(1) * p.measurement_variance_x  # one sensor gives both
    return kf
