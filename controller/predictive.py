"""Model predictive control on the lagged linearisation with limits, solved by OSQP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import osqp
from filterpy.kalman import KalmanFilter
from scipy.linalg import solve_discrete_are
from scipy.sparse import csc_matrix, triu

from controller.design_model import Matrix
from controller.full_model import INPUTS, STATES, full_model, held
from controller.laws import Seen
from controller.variants import PredictiveSettings

# x_world and y_world say over again what x and y say, and carry no weight: twelve states are predicted of fourteen.
PREDICTED = tuple(k for k, name in enumerate(STATES) if not name.endswith("_world"))
NAMES = tuple(STATES[k] for k in PREDICTED)
ESTIMATED = ("x", "vx", "psi", "psi_dot")  # by the filter of five states; the others by the one here
OWN = tuple(k for k, name in enumerate(NAMES) if name not in ESTIMATED)
BLOCKS = (1, 1, 1, 2, 2, 3, 4, 6)  # steps of the prediction over which a command is held; the last one to its end
SOLVED = 1  # OSQP's status
TOLERANCE = 1e-5  # of the scaled problem, whose commands are within ±1
SPEEDING = 100.0  # weight of (m/s)² beyond speed_max: more than any other, yet no wall


class PredictiveLaw:
    """Commands u of the propellers that minimise, over the horizon of N steps,

        Σ (z' Q z + u' R u)·Δ + z_N' P z_N,   z_{j+1} = F·z_j + G·u_j,   |α| ≤ tilt_max,   δ_min ≤ δ ≤ δ_max

    z the deviation from rest at the references (x, y, ψ), P that of the LQR, so that without limits it is one. x, ẋ, ψ and ψ̇ are
    the filter's; y, roll, thrusts and tilts are predicted from what was commanded, and corrected by fixes of y. A limit of speed
    is given up where it cannot be kept. Where the solver ends by its limit of iterations, its last command is
    taken, within the limits; where it finds none, the command before.
    """

    def __init__(self, p: PredictiveSettings, y_hat: float = 0.0) -> None:
        self.settings = p
        self.observer = _observer(p, y_hat)
        self.rest = np.array([p.duty_nominal, p.duty_nominal, 0.0, 0.0])
        self.low = np.array([p.duty_min, p.duty_min, -p.tilt_max, -p.tilt_max]) - self.rest
        self.high = np.array([p.duty_max, p.duty_max, p.tilt_max, p.tilt_max]) - self.rest
        self.problem = _Problem(p, self.low, self.high)
        self.hot = self.problem.cold()
        self.last = np.zeros(len(INPUTS))
        self.duties = (p.duty_nominal, p.duty_nominal)
        self.fix, self.iterations, self.solved = 0.0, 0, True

    def command(self, x_hat: Sequence[float], seen: Seen) -> tuple[float, ...]:
        """Tilts [rad]; the duties stand in `duties`."""
        if seen.started:
            self.observer.predict(u=self.last)
            if seen.fix and seen.fix != self.fix:
                self.observer.update(np.array([seen.y_meas]))
        self.fix = seen.fix
        z = np.zeros(len(NAMES))
        z[list(OWN)] = self.observer.x
        for name, value in zip(("x", "vx", "psi", "psi_dot"), x_hat, strict=False):
            z[NAMES.index(name)] = value
        for name, reference in (("x", seen.x_ref), ("y", seen.y_ref), ("psi", seen.psi_ref)):
            z[NAMES.index(name)] -= reference
        found = self.problem.solve(z, self.hot)
        self.iterations, self.solved = found.iterations, found.solved
        if found.hot is not None:
            self.hot = found.hot
            self.last = np.clip(found.command, self.low, self.high) + 0.0  # -0.0 is 0.0
        duty_right, duty_left, *tilts = (self.last + self.rest).tolist()
        self.duties = (duty_right, duty_left)
        return tuple(tilts)

    def outputs(self) -> list[float]:
        """ŷ [m] and its standard deviation, iterations, whether they ended in a solution."""
        sigma = math.sqrt(max(0.0, self.observer.P[0, 0]))
        return [float(self.observer.x[0]), sigma, float(self.iterations), float(self.solved)]

    def snapshot(self) -> Any:
        """Its own estimate, last command, where the solver starts from."""
        return {
            "x": self.observer.x.tolist(),
            "P": self.observer.P.tolist(),
            "last": self.last.tolist(),
            "hot": [part.tolist() for part in self.hot],
            "counted": [self.fix, self.iterations, self.solved],
        }

    def restore(self, snapshot: Any) -> None:
        """Bit for bit: the solver keeps nothing from one sample to the next but what it is started from."""
        self.observer.x, self.observer.P = np.array(snapshot["x"]), np.array(snapshot["P"])
        self.last = np.array(snapshot["last"])
        self.hot = (np.array(snapshot["hot"][0]), np.array(snapshot["hot"][1]))
        self.fix, self.iterations, self.solved = snapshot["counted"]
        duty_right, duty_left, *_ = (self.last + self.rest).tolist()
        self.duties = (duty_right, duty_left)


def _observer(p: PredictiveSettings, y_hat: float) -> KalmanFilter:
    """Filter of y, vy, roll, thrusts and tilts, driven by the commands and corrected by fixes of y; P = 0 at rest."""
    A, B = (m[list(PREDICTED)] for m in full_model(p))
    own = np.ix_(OWN, OWN)
    kf = KalmanFilter(dim_x=len(OWN), dim_z=1, dim_u=len(INPUTS))
    kf.F, kf.B = held(A[:, list(PREDICTED)][own], B[list(OWN)], p.sample_time)
    kf.x, kf.P, kf.Q = np.array([y_hat, *[0.0] * (len(OWN) - 1)]), np.zeros((len(OWN),) * 2), np.zeros((len(OWN),) * 2)
    at = [NAMES[k] for k in OWN]
    kf.Q[at.index("vy"), at.index("vy")] = p.process_variance_lateral
    kf.H = np.zeros((1, len(OWN)))
    kf.H[0, at.index("y")] = 1.0
    kf.R = np.eye(1) * 1e-4
    return kf


class _Found:
    """What the solver came to: the first command, where to start next, None where there is neither."""

    def __init__(self, result: Any, scale: Matrix) -> None:
        self.iterations, self.solved = int(result.info.iter), result.info.status_val == SOLVED
        usable = result.x is not None and bool(np.all(np.isfinite(result.x)) and np.all(np.isfinite(result.y)))
        self.hot = (np.array(result.x), np.array(result.y)) if usable else None
        self.command = scale * self.hot[0][: len(scale)] if self.hot is not None else np.zeros(len(scale))


class _Problem:
    """The quadratic program of a sample, in commands alone, scaled to ±1: only its linear term changes with the state."""

    def __init__(self, p: PredictiveSettings, low: Matrix, high: Matrix) -> None:
        A, B = (m[list(PREDICTED)] for m in full_model(p))
        F, G = held(A[:, list(PREDICTED)], B, p.prediction_step)
        steps = max(1, round(p.horizon / p.prediction_step))
        blocks = _blocks(steps)
        inputs = len(INPUTS)
        self.scale = np.maximum(-low, high)
        Q, R = _weights(p)
        Q, R = p.prediction_step * Q, p.prediction_step * R
        last = solve_discrete_are(F, G, Q, R)
        # z_j = free_j·z_0 + forced_j·U
        free, forced = np.eye(len(F)), np.zeros((len(F), inputs * len(blocks)))
        H, self.f = np.zeros((forced.shape[1],) * 2), np.zeros((forced.shape[1], len(F)))
        speeds = []
        block_of = np.repeat(np.arange(len(blocks)), blocks)
        for j in range(steps):
            here = slice(inputs * block_of[j], inputs * (block_of[j] + 1))
            free, forced = F @ free, F @ forced
            forced[:, here] += G * self.scale
            weight = last if j == steps - 1 else Q
            H += forced.T @ weight @ forced
            H[here, here] += np.diag(self.scale) @ R @ np.diag(self.scale)
            self.f += forced.T @ weight @ free
            speeds.append((free[NAMES.index("vx")], forced[NAMES.index("vx")]))
        low, high = np.tile(low / self.scale, len(blocks)), np.tile(high / self.scale, len(blocks))
        rows, self.offset = np.eye(len(H)), np.zeros((len(H), len(F)))
        if p.speed_max > 0:
            H, rows, low, high = self._limited(H, rows, low, high, speeds, p.speed_max)
        self.low, self.high, self.count = low, high, H.shape[0]
        size = np.linalg.eigvalsh(H)
        self.solver = osqp.OSQP()
        self.solver.setup(
            csc_matrix(triu(H)), np.zeros(len(H)), csc_matrix(rows), low, high,
            eps_abs=TOLERANCE, eps_rel=TOLERANCE, max_iter=int(p.iterations_max),
            # by iterations, never by time: same seed, same bytes; nor is anything adapted that a state would have to hold
            rho=0.1 * math.sqrt(max(size[0], 1e-9) * size[-1]), adaptive_rho=0, check_termination=5,
            scaling=0, polishing=False, verbose=False,
        )  # fmt: skip

    def _limited(
        self, H: Matrix, rows: Matrix, low: Matrix, high: Matrix, speeds: list[tuple[Matrix, Matrix]], most: float
    ) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """With |vx| ≤ most + s at every step, s ≥ 0 the one slack: there always is a solution."""
        n, N = len(H), len(speeds)
        with_slack = np.zeros((n + 1, n + 1))
        with_slack[:n, :n], with_slack[n, n] = H, SPEEDING
        forced = np.array([row for _, row in speeds])
        beyond = np.ones((N, 1))
        rows = np.block(
            [
                [rows, np.zeros((len(rows), 1))],
                [forced, -beyond],
                [forced, beyond],
                [np.zeros((1, n)), np.ones((1, 1))],
            ]
        )
        free = np.array([row for row, _ in speeds])
        self.offset = np.vstack([self.offset, free, free, np.zeros((1, free.shape[1]))])
        self.f = np.vstack([self.f, np.zeros((1, self.f.shape[1]))])
        never = np.full(N, np.inf)
        low = np.concatenate([low, -never, np.full(N, -most), [0.0]])
        high = np.concatenate([high, np.full(N, most), never, [np.inf]])
        return with_slack, rows, low, high

    def cold(self) -> tuple[Matrix, Matrix]:
        """Where the first sample starts from: no deviation, no multiplier."""
        return np.zeros(self.count), np.zeros(len(self.low))

    def solve(self, z: Matrix, hot: tuple[Matrix, Matrix]) -> _Found:
        """The best commands from the deviation z on."""
        free = self.offset @ z
        self.solver.update(q=self.f @ z, l=self.low - free, u=self.high - free)
        self.solver.warm_start(x=hot[0], y=hot[1])
        return _Found(self.solver.solve(raise_error=False), self.scale)


def _weights(p: PredictiveSettings) -> tuple[Matrix, Matrix]:
    """Q (12, 12) and R (4, 4), per second."""
    of_state = {name: getattr(p, f"weight_{name}") for name in ("x", "y", "psi", "vx", "vy", "psi_dot")}
    of_input = p.weight_duty, p.weight_duty, p.weight_tilt, p.weight_tilt
    return np.diag([of_state.get(name, 0.0) for name in NAMES]), np.diag(of_input)


def _blocks(steps: int) -> list[int]:
    """Lengths of the blocks: as declared, cut or drawn out to the horizon."""
    blocks: list[int] = []
    for length in BLOCKS:
        if (left := steps - sum(blocks)) > 0:
            blocks.append(min(length, left))
    blocks[-1] += steps - sum(blocks)
    return blocks
