"""Quadratic program of the predictive law: limited commands over a horizon, solved by a dual active set."""

from __future__ import annotations

from typing import NamedTuple

import daqp
import numpy as np
from scipy.linalg import solve_discrete_are

from controller.design_model import Matrix, discretize
from controller.full_model import INPUTS, STATES, full_model
from controller.variants import PredictionSettings, PredictiveSettings

# x_world and y_world repeat x and y without weight, so twelve of fourteen states are predicted.
PREDICTED = [k for k, name in enumerate(STATES) if not name.endswith("_world")]
NAMES = [STATES[k] for k in PREDICTED]
BLOCKS = (1, 2, 4, 8, 12, 18, 25, 30)  # steps with a constant command; the last block extends to the horizon
VX = NAMES.index("vx")
SOLVED, AT_LIMIT = (1, 2), -4  # flags of DAQP: optimal, also with an exceeded soft limit; too many iterations
HARD, SOFT = 0, 8  # kinds of limits in DAQP
ROUNDING = 1e-9  # multipliers below are zero


class Solution(NamedTuple):
    """Result of the solver.

    Attributes:
        command: First command, a deviation from rest.
        every: All commands, scaled.
        hot: Multipliers; their signs mark the active limits for the next sample.
        flag: Exit flag of DAQP.
    """

    command: Matrix
    hot: Matrix
    iterations: int
    flag: int
    every: Matrix

    @property
    def solved(self) -> bool:
        """Return True for the optimal command."""
        return self.flag in SOLVED


class Condensed(NamedTuple):
    """Cost ½·U'·H·U + f'·U of the commands U of all blocks, and the states free + forced·U at each step.

    For an open initial deviation z, f and free have one column per component.
    """

    H: Matrix
    f: Matrix
    free: Matrix
    forced: Matrix

    def at(self, z: Matrix) -> Condensed:
        """Return the cost of the horizon that starts with the deviation z."""
        return self._replace(f=self.f @ z, free=self.free @ z)


class PredictionSteps(NamedTuple):
    """Prediction z_{j+1} = F_j·z_j + G_j·u_j + e_j for steps j of N, and its weights.

    F (N, n, n), G (N, n, m), e (N, n, 1); Q, R of a step, P (n, n) of the last state.
    """

    F: Matrix
    G: Matrix
    e: Matrix
    Q: Matrix
    R: Matrix
    P: Matrix


def limits(p: PredictionSettings) -> tuple[Matrix, Matrix, Matrix]:
    """Return the rest command and both its margins.

    Duties are in %, tilts in rad.
    """
    rest = np.array([p.duty_nominal, p.duty_nominal, 0.0, 0.0])
    low = np.array([p.duty_min, p.duty_min, -p.tilt_max, -p.tilt_max]) - rest
    high = np.array([p.duty_max, p.duty_max, p.tilt_max, p.tilt_max]) - rest
    return rest, low, high


def predicted(p: PredictiveSettings) -> tuple[Matrix, Matrix]:
    """Return A (12, 12) and B (12, 4) of the predicted states."""
    A, B = full_model(p)
    return A[np.ix_(PREDICTED, PREDICTED)], B[PREDICTED]


def steady(p: PredictiveSettings) -> PredictionSteps:
    """Return the steps of a prediction linearized at hover."""
    F, G = discretize(*predicted(p), p.prediction_step)
    n, (Q, R) = len(of_steps(p)), (p.prediction_step * weight for weight in weights(p))
    return PredictionSteps(
        np.tile(F, (n, 1, 1)), np.tile(G, (n, 1, 1)), np.zeros((n, len(F), 1)), Q, R, cost_to_go(F, G, Q, R)
    )


def cost_to_go(F: Matrix, G: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return P of the LQR cost z'·P·z after the horizon."""
    return np.asarray(solve_discrete_are(F, G, Q, R))


def condensed(p: PredictionSettings, steps: PredictionSteps, start: Matrix, scale: Matrix) -> Condensed:
    """Return the horizon cost as a function of the scaled commands alone.

    The cost is Σ (z'·Q·z + u'·R·u) + z_N'·P·z_N.

    Args:
        start: z_0 as a column, or the unit matrix for an open start.
    """
    of_step, k, m = of_steps(p), start.shape[1], len(INPUTS)
    columns = k + m * of_step[:, None] + np.arange(m)  # columns of each step's commands
    added = np.zeros((len(of_step), len(start), k + m * (of_step[-1] + 1)))
    added[:, :, :k] = steps.e
    np.put_along_axis(added, columns[:, None], steps.G * scale, axis=2)
    both = np.zeros((len(of_step) + 1, *added.shape[1:]))
    both[0, :, :k] = start
    for F, before, after, more in zip(steps.F, both[:-1], both[1:], added, strict=True):
        np.dot(F, before, after)  # z_j = free·z_0 + forced·U
        after += more
    found, last = both[1:], both[-1]
    counts = np.flatnonzero(np.diag(steps.Q))
    weighed = np.sqrt(np.diag(steps.Q)[counts])[:, None] * found[:-1, counts]
    # One small product per step: threads would make the last digits of a large product random, and slower.
    costs = (weighed[..., k:].transpose(0, 2, 1) @ weighed).sum(axis=0) + last[:, k:].T @ steps.P @ last
    H = costs[:, k:] + np.kron(np.diag(np.bincount(of_step)), scale[:, None] * steps.R * scale)
    return Condensed(H, costs[:, :k], found[:, :, :k], found[:, :, k:])


def weights(p: PredictionSettings) -> tuple[Matrix, Matrix]:
    """Return Q (12, 12) and R (4, 4), per second."""
    of_state = {name: getattr(p, f"weight_{name}") for name in ("x", "y", "psi", "vx", "vy", "psi_dot")}
    of_input = p.weight_duty, p.weight_duty, p.weight_tilt, p.weight_tilt
    return np.diag([of_state.get(name, 0.0) for name in NAMES]), np.diag(of_input)


def of_steps(p: PredictionSettings) -> Matrix:
    """Return the command block of each prediction step."""
    lengths = block_lengths(round(p.horizon / p.prediction_step))
    return np.repeat(np.arange(len(lengths)), lengths)


def block_lengths(steps: int) -> list[int]:
    """Return block lengths, cut or extended to the horizon."""
    lengths: list[int] = []
    for length in BLOCKS:
        if (left := steps - sum(lengths)) > 0:
            lengths.append(min(length, left))
    lengths[-1] += steps - sum(lengths)
    return lengths


class Program:
    """Quadratic program of a sample: condensed cost, command limits, and an optional speed limit.

    The limit |vx| ≤ speed_max at every prediction step is soft, so that a solution always exists.
    """

    def __init__(self, p: PredictionSettings) -> None:
        _, low, high = limits(p)
        of_step = of_steps(p)
        self.scale = np.maximum(-low, high)
        blocks = int(of_step[-1]) + 1
        self.low, self.high = np.tile(low / self.scale, blocks), np.tile(high / self.scale, blocks)
        self.limited = slice(len(of_step) if p.speed_max > 0 else 0)
        self.most = np.full(len(of_step[self.limited]), p.speed_max)
        self.kinds = np.array([HARD] * len(self.low) + [SOFT] * len(self.most), dtype=np.int32)
        self.iterations = int(p.iterations_max)

    def cold(self) -> Matrix:
        """Return the first sample's start, without active limits."""
        return np.zeros(len(self.kinds))

    def solve(self, cost: Condensed, hot: Matrix) -> Solution:
        """Return the optimal commands, started from the previous multipliers.

        At the iteration limit, the unconstrained commands are clipped instead.
        """
        free, rows = cost.free[self.limited, VX], np.ascontiguousarray(cost.forced[self.limited, VX])
        high, low = np.concatenate([self.high, self.most - free]), np.concatenate([self.low, -self.most - free])
        U, _, flag, info = daqp.solve(
            cost.H, cost.f, rows, high, low, self.kinds, iter_limit=self.iterations, dual_start=hot
        )
        if flag in SOLVED:
            hot = np.where(np.abs(info["lam"]) > ROUNDING, info["lam"], 0.0)
        else:  # The solver's output is then incomplete.
            U, hot = np.clip(-np.linalg.solve(cost.H, cost.f), self.low, self.high), self.cold()
        return Solution(self.scale * U[: len(self.scale)], hot, int(info["iterations"]), int(flag), np.array(U))
