"""The quadratic program of the predictive law: commands over a horizon, within limits, solved by OSQP."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import osqp
from scipy.linalg import solve_discrete_are
from scipy.sparse import csc_matrix, triu

from controller.design_model import Matrix
from controller.full_model import INPUTS, STATES, full_model, held
from controller.variants import PredictiveSettings

# x_world and y_world say over again what x and y say, and carry no weight: twelve states are predicted of fourteen.
PREDICTED = [k for k, name in enumerate(STATES) if not name.endswith("_world")]
NAMES = [STATES[k] for k in PREDICTED]
BLOCKS = (1, 1, 1, 2, 2, 3, 4, 6)  # steps of the prediction over which a command is held; the last one to its end
SOLVED = 1  # OSQP's status
TOLERANCE = 1e-5  # of commands, which are scaled to ±1: 1e-4 degrees
SPEEDING = 100.0  # weight of (m/s)² beyond speed_max: more than any other, yet no wall


class Found(NamedTuple):
    """What the solver came to. Where it has no finite iterate, `hot` is None and the command says nothing.

    command: the first one, a deviation from rest
    hot:     commands and multipliers, where the next sample starts from
    """

    command: Matrix
    hot: tuple[Matrix, Matrix] | None
    iterations: int
    solved: bool


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

    With a limit of speed |vx| ≤ speed_max + s at every step, s ≥ 0 one slack for all: there always is a solution.
    """

    def __init__(self, p: PredictiveSettings) -> None:
        _, low, high = limits(p)
        self.scale = np.maximum(-low, high)
        cost = condensed(p, self.scale)
        n, N = len(cost.H), len(cost.free)
        blocks = n // len(INPUTS)
        self.f, self.low, self.high = cost.f, np.tile(low / self.scale, blocks), np.tile(high / self.scale, blocks)
        H, rows, self.offset = cost.H, np.eye(n), np.zeros((n, cost.f.shape[1]))
        if p.speed_max > 0:
            H = np.block([[H, np.zeros((n, 1))], [np.zeros((1, n)), np.full((1, 1), SPEEDING)]])
            slack = np.ones((N, 1))
            rows = np.block([[rows, 0.0 * slack[:1].repeat(n, 0)], [cost.forced, -slack], [cost.forced, slack]])
            rows = np.vstack([rows, np.eye(n + 1)[-1:]])
            nothing = np.zeros((1, cost.f.shape[1]))
            self.f, self.offset = np.vstack([cost.f, nothing]), np.vstack([self.offset, cost.free, cost.free, nothing])
            never, most = np.full(N, np.inf), np.full(N, p.speed_max)
            self.low = np.concatenate([self.low, -never, -most, [0.0]])
            self.high = np.concatenate([self.high, most, never, [np.inf]])
        self.solver = _solver(H, rows, self.low, self.high, int(p.iterations_max))

    def cold(self) -> tuple[Matrix, Matrix]:
        """Where the first sample starts from: no deviation, no multiplier."""
        return np.zeros(len(self.f)), np.zeros(len(self.low))

    def solve(self, z: Matrix, hot: tuple[Matrix, Matrix]) -> Found:
        """The best commands from the deviation z on."""
        free = self.offset @ z
        self.solver.update(q=self.f @ z, l=self.low - free, u=self.high - free)
        self.solver.warm_start(x=hot[0], y=hot[1])
        result = self.solver.solve(raise_error=False)
        command, usable = np.zeros(len(self.scale)), False
        if result.x is not None:
            usable = bool(np.isfinite(result.x).all() and np.isfinite(result.y).all())
        if usable:
            command, hot = self.scale * result.x[: len(self.scale)], (np.array(result.x), np.array(result.y))
        status = result.info.status_val == SOLVED and usable
        return Found(command, hot if usable else None, int(result.info.iter), status)


def _solver(H: Matrix, rows: Matrix, low: Matrix, high: Matrix, iterations: int) -> Any:
    """OSQP, that ends by iterations and never by time, and adapts nothing that a state would have to hold."""
    size = np.linalg.eigvalsh(H)
    solver = osqp.OSQP()
    solver.setup(
        csc_matrix(triu(H)),
        np.zeros(len(H)),
        csc_matrix(rows),
        low,
        high,
        eps_abs=TOLERANCE,
        eps_rel=TOLERANCE,
        max_iter=iterations,
        check_termination=5,
        rho=0.1 * math.sqrt(max(float(size[0]), 1e-9) * float(size[-1])),
        adaptive_rho=0,
        scaling=0,
        polishing=False,
        verbose=False,
    )
    return solver
