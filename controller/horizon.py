"""The quadratic program of the predictive law: commands over a horizon, within limits, by a dual active set."""

from __future__ import annotations

from typing import NamedTuple

import daqp
import numpy as np
from scipy.linalg import solve_discrete_are

from controller.design_model import Matrix
from controller.full_model import INPUTS, STATES, full_model, held
from controller.variants import PredictiveSettings

# x_world and y_world say over again what x and y say, and carry no weight: twelve states are predicted of fourteen.
PREDICTED = [k for k, name in enumerate(STATES) if not name.endswith("_world")]
NAMES = [STATES[k] for k in PREDICTED]
BLOCKS = (1, 2, 4, 8, 12, 18, 25, 30)  # steps of the prediction over which a command is held; the last one to its end
SOLVED, AT_LIMIT = (1, 2), -4  # DAQP's flags: optimal, and where a soft limit is exceeded; too many iterations
HARD, SOFT = 0, 8  # its kinds of limits
ROUNDING = 1e-9  # multipliers below are those of no limit


class Found(NamedTuple):
    """What the solver came to.

    command: the first one, a deviation from rest
    hot:     multipliers, whose signs say at which limits the next sample starts
    flag:    how it ended, one of DAQP's
    """

    command: Matrix
    hot: Matrix
    iterations: int
    flag: int

    @property
    def solved(self) -> bool:
        """Whether it is the best command."""
        return self.flag in SOLVED


class Condensed(NamedTuple):
    """A cost ½·U'·H·U + (f·z)'·U over the commands U of all blocks, from the deviation z on.

    free, forced: what vx is at each step, free·z + forced·U
    """

    H: Matrix
    f: Matrix
    free: Matrix
    forced: Matrix


def limits(p: PredictiveSettings) -> tuple[Matrix, Matrix, Matrix]:
    """Command at rest, and how far it may go down and up: duties [%], tilts [rad]."""
    rest = np.array([p.duty_nominal, p.duty_nominal, 0.0, 0.0])
    low = np.array([p.duty_min, p.duty_min, -p.tilt_max, -p.tilt_max]) - rest
    high = np.array([p.duty_max, p.duty_max, p.tilt_max, p.tilt_max]) - rest
    return rest, low, high


def predicted(p: PredictiveSettings) -> tuple[Matrix, Matrix]:
    """A (12, 12) and B (12, 4) of the states that are predicted."""
    A, B = full_model(p)
    return A[np.ix_(PREDICTED, PREDICTED)], B[PREDICTED]


def condensed(p: PredictiveSettings, scale: Matrix) -> Condensed:
    """The cost over the horizon: z_{j+1} = F·z_j + G·u_j, weights times the step, at the end the LQR's cost to go."""
    F, G = held(*predicted(p), p.prediction_step)
    Q, R = (p.prediction_step * weight for weight in weights(p))
    blocks, n = block_lengths(round(p.horizon / p.prediction_step)), len(INPUTS)
    last, G = solve_discrete_are(F, G, Q, R), G * scale
    free, forced = np.eye(len(F)), np.zeros((len(F), n * len(blocks)))
    H, f = np.zeros((forced.shape[1],) * 2), np.zeros((forced.shape[1], len(F)))
    speeds, vx = [], NAMES.index("vx")
    of_step = np.repeat(np.arange(len(blocks)), blocks)
    for j, block in enumerate(of_step):
        here = slice(n * block, n * (block + 1))
        # z_j = free·z_0 + forced·U
        free, forced = F @ free, F @ forced
        forced[:, here] += G
        weight = last if j == len(of_step) - 1 else Q
        H += forced.T @ weight @ forced
        H[here, here] += scale[:, None] * R * scale
        f += forced.T @ weight @ free
        speeds.append((free[vx], forced[vx]))
    return Condensed(H, f, np.array([row for row, _ in speeds]), np.array([row for _, row in speeds]))


def weights(p: PredictiveSettings) -> tuple[Matrix, Matrix]:
    """Q (12, 12) and R (4, 4), per second."""
    of_state = {name: getattr(p, f"weight_{name}") for name in ("x", "y", "psi", "vx", "vy", "psi_dot")}
    of_input = p.weight_duty, p.weight_duty, p.weight_tilt, p.weight_tilt
    return np.diag([of_state.get(name, 0.0) for name in NAMES]), np.diag(of_input)


def block_lengths(steps: int) -> list[int]:
    """Lengths of the blocks: as declared, cut or drawn out to the horizon."""
    lengths: list[int] = []
    for length in BLOCKS:
        if (left := steps - sum(lengths)) > 0:
            lengths.append(min(length, left))
    lengths[-1] += steps - sum(lengths)
    return lengths


class Problem:
    """The program, set up once; of a sample only its linear term and the limits of speed are new.

    A limit of speed |vx| ≤ speed_max holds at every step of the prediction, yet is soft: there always is a solution.
    """

    def __init__(self, p: PredictiveSettings) -> None:
        _, low, high = limits(p)
        self.scale = np.maximum(-low, high)
        self.cost = cost = condensed(p, self.scale)
        blocks = len(cost.H) // len(INPUTS)
        self.low, self.high = np.tile(low / self.scale, blocks), np.tile(high / self.scale, blocks)
        limited = slice(len(cost.free) if p.speed_max > 0 else 0)
        self.free, self.most = cost.free[limited], np.full(len(cost.free[limited]), p.speed_max)
        self.rows = np.ascontiguousarray(cost.forced[limited])
        self.kinds = np.array([HARD] * len(cost.H) + [SOFT] * len(self.most), dtype=np.int32)
        self.iterations = int(p.iterations_max)

    def cold(self) -> Matrix:
        """Where the first sample starts from: no limit touched."""
        return np.zeros(len(self.kinds))

    def solve(self, z: Matrix, hot: Matrix) -> Found:
        """The best commands from the deviation z on, started from the multipliers of the sample before.

        Where the limit of iterations comes first: those without limits, cut off at them.
        """
        f, free = self.cost.f @ z, self.free @ z
        high, low = np.concatenate([self.high, self.most - free]), np.concatenate([self.low, -self.most - free])
        U, _, flag, info = daqp.solve(
            self.cost.H, f, self.rows, high, low, self.kinds, iter_limit=self.iterations, dual_start=hot
        )
        if flag in SOLVED:
            hot = np.where(np.abs(info["lam"]) > ROUNDING, info["lam"], 0.0)
        else:  # what it leaves then is not all written
            U, hot = np.clip(-np.linalg.solve(self.cost.H, f), self.low, self.high), self.cold()
        return Found(self.scale * U[: len(self.scale)], hot, int(info["iterations"]), int(flag))
