"""Model predictive control with limits, linearized along the planned motion or, with constant matrices, at hover.

Each horizon is condensed to a quadratic program in the commands, which a dual active-set method solves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import daqp
import numpy as np
from scipy.linalg import solve_discrete_are

from controller.design_model import Matrix
from controller.loop import Law, LawInput
from controller.observers import PREDICTED, PREDICTED_STATES, Estimator, ExtendedFilter, HoverFilter, Slopes, level_tilt
from controller.settings import PLANT_STATES, Floats, Numbers, PredictiveSettings, TimeVariantSettings, craft_of
from cosim.model.namespaces import arrays
from plant.hovercraft import Hovercraft

COMMANDS = len(Hovercraft.inputs)
COMMAND_BLOCKS = (1, 2, 4, 8, 12, 18, 25, 30)  # steps with a constant command; the last block extends to the horizon
VX = PREDICTED_STATES.index("vx")
POSITIONS = [PREDICTED_STATES.index(name) for name in ("x", "y", "psi")]
SOLVED = (1, 2)  # flags of DAQP: optimal, also with an exceeded soft limit
HARD, SOFT = 0, 8  # kinds of limits in DAQP
ZERO_MULTIPLIER = 1e-9  # multipliers below are zero
SERIES_LIMIT = 0.25  # largest h·|A| of a short step in the series of the exponential


class Condensed(NamedTuple):
    """Cost ½·U'·H·U + f'·U of the commands U of all blocks, and the states free + forced·U at each step.

    If the initial deviation z is left open, f and free have one column per component of z.
    """

    H: Matrix
    f: Matrix
    free: Matrix
    forced: Matrix

    def at(self, z: Matrix) -> Condensed:
        """Return the cost of the horizon that starts with the deviation z."""
        return self._replace(f=self.f @ z, free=self.free @ z)


class PredictiveLaw(Law):
    """Optimal commands within limits at each sample; the solver starts from the previous solution.

    The commands u minimise

         Σ (z'·Q·z + u'·R·u)·Δ + z_N'·P·z_N,   |α| ≤ tilt_max,   duty_min ≤ δ ≤ duty_max

    with z the deviation from rest at the references of x, y and ψ, and P the cost to go of the LQR at hover. Without
    active limits at hover, the law then equals the LQR. The limit |vx| ≤ speed_max at every prediction step is soft, so
    that a solution always exists. At the solver's iteration limit, the unconstrained command is clipped and `solved` is
    0. The motion is predicted by the craft's equations along the plan,

         ż = f(x̄, ū) + A(t)·(x − x̄) + B(t)·(u − ū),   A(t) = ∂f/∂x, B(t) = ∂f/∂u at x̄(t), ū(t)

    x̄, ū are motion and commands planned at the previous sample, shifted by one sample. At the first sample x̄ is the
    estimate and ū the command at rest. Commands, A and B are held over a prediction step. With one program per sample,
    the plan follows a changed reference within some samples (real-time iteration, Diehl, Bock, Schlöder 2005).

    With `PredictiveSettings`, A and B are those of hover, and the horizon is condensed once; with
    `TimeVariantSettings`, those along the plan.

    Args:
        printed: Jacobians of the craft, which the extended filter uses too.
        y_hat: Initial estimate of the position to the right [m].

    Attributes:
        filter: Estimator of the predicted states.
        last: Deviation of the last command from rest.
        hot: Multipliers; their signs mark the active limits for the next sample.
        given_up: Failures of the solver.
        cost: Cost of a horizon that starts with an open deviation, with A and B of hover.
    """

    memory: tuple[str, ...] = ("last", "hot", "iterations", "solved", "samples", "given_up", "path", "plan")
    filter: HoverFilter | ExtendedFilter
    cost: Condensed | None = None

    def __init__(self, p: PredictiveSettings, printed: Mapping[str, Any], y_hat: float = 0.0) -> None:
        self.p, self.printed, self.y_hat = p, printed, y_hat
        self.rest = np.array([p.duty_nominal, p.duty_nominal, 0.0, 0.0])
        self.low = np.array([p.duty_min, p.duty_min, -p.tilt_max, -p.tilt_max]) - self.rest
        self.high = np.array([p.duty_max, p.duty_max, p.tilt_max, p.tilt_max]) - self.rest
        self.scale = np.maximum(-self.low, self.high)
        steps = round(p.horizon / p.prediction_step)
        ends = [
            min(sum(COMMAND_BLOCKS[: k + 1]), steps)
            for k in range(len(COMMAND_BLOCKS))
            if sum(COMMAND_BLOCKS[:k]) < steps
        ]
        lengths = np.diff([0, *ends[:-1], steps])
        self.of_step = np.repeat(np.arange(len(lengths)), lengths)  # block of each step
        self.limits = [np.tile(limit / self.scale, len(lengths)) for limit in (self.low, self.high)]
        self.limited = slice(steps if p.speed_max > 0 else 0)
        self.most = np.full(len(self.of_step[self.limited]), p.speed_max)
        self.kinds = np.array([HARD] * len(self.limits[0]) + [SOFT] * len(self.most), dtype=np.int32)
        self.most_iterations, self.sample = int(p.iterations_max), p.sample_time
        of_state = {name: getattr(p, f"weight_{name}") for name in ("x", "y", "psi", "vx", "vy", "psi_dot")}
        of_input = p.weight_duty, p.weight_duty, p.weight_tilt, p.weight_tilt
        self.Q = p.prediction_step * np.diag([of_state.get(name, 0.0) for name in PREDICTED_STATES])
        self.R = p.prediction_step * np.diag(of_input)
        self.hot, self.last = np.zeros(len(self.kinds)), np.zeros(COMMANDS)
        self.iterations, self.solved, self.samples, self.given_up = 0, True, 0, 0
        self.path, self.plan = np.zeros((0, len(PREDICTED_STATES))), np.zeros((0, COMMANDS))  # no plan yet
        self.craft = craft_of(p)
        self.slopes, self.rates = Slopes(self.craft, printed), self.craft.acting(arrays()).derivative
        hover = np.array([self.craft.start()])
        A, B = self._linear(hover, self.rest[None])
        self.hover = hover[0, PREDICTED], A[0], B[0]
        fastest = p.prediction_step * float(np.abs(np.linalg.eigvals(A[0])).max())
        self.doublings = max(0, math.ceil(math.log2(max(fastest, SERIES_LIMIT) / SERIES_LIMIT)))
        F, held = self._zero_order_hold(A)
        G, n = held @ B, len(self.of_step)
        self.P = solve_discrete_are(F[0], G[0], self.Q, self.R)
        if not isinstance(p, TimeVariantSettings):
            self.cost = self.condensed(np.tile(F, (n, 1, 1)), np.tile(G, (n, 1, 1)), 0.0, np.eye(len(PREDICTED_STATES)))

    @property
    def duties(self) -> tuple[float, float]:  # type: ignore[override]
        right, left, *_ = (self.last + self.rest).tolist()
        return right, left

    def condensed(self, F: Matrix, G: Matrix, e: Matrix | float, start: Matrix) -> Condensed:
        """Return the cost as a function of scaled commands only, for z_{j+1} = F_j·z_j + G_j·u_j + e_j.

        Args:
            F, G, e: (N, n, n), (N, n, m) and (N, n, 1) of each step.
            start: z_0 as a column, or the unit matrix if z_0 is left open.
        """
        of_step, k, m = self.of_step, start.shape[1], COMMANDS
        columns = k + m * of_step[:, None] + np.arange(m)  # columns of each step's commands
        added = np.zeros((len(of_step), len(start), k + m * (of_step[-1] + 1)))
        added[:, :, :k] = e
        np.put_along_axis(added, columns[:, None], G * self.scale, axis=2)
        both = np.zeros((len(of_step) + 1, *added.shape[1:]))
        both[0, :, :k] = start
        for of, before, after, more in zip(F, both[:-1], both[1:], added, strict=True):
            np.dot(of, before, after)  # z_j = free·z_0 + forced·U
            after += more
        found, last = both[1:], both[-1]
        counts = np.flatnonzero(np.diag(self.Q))
        weighed = np.sqrt(np.diag(self.Q)[counts])[:, None] * found[:-1, counts]
        # One small product per step: with threads, the last digits of a large product vary, and it is slower.
        costs = (weighed[..., k:].transpose(0, 2, 1) @ weighed).sum(axis=0) + last[:, k:].T @ self.P @ last
        H = costs[:, k:] + np.kron(np.diag(np.bincount(of_step)), self.scale[:, None] * self.R * self.scale)
        return Condensed(H, costs[:, :k], found[:, :, :k], found[:, :, k:])

    def solve(self, cost: Condensed) -> Matrix:
        """Update the command and return the scaled commands of every block."""
        low, high = self.limits
        free, rows = cost.free[self.limited, VX], np.ascontiguousarray(cost.forced[self.limited, VX])
        upper, lower = np.concatenate([high, self.most - free]), np.concatenate([low, -self.most - free])
        U, _, flag, info = daqp.solve(
            cost.H, cost.f, rows, upper, lower, self.kinds, iter_limit=self.most_iterations, dual_start=self.hot
        )
        self.iterations, self.solved = int(info["iterations"]), flag in SOLVED
        if self.solved:
            self.hot = np.where(np.abs(info["lam"]) > ZERO_MULTIPLIER, info["lam"], 0.0)
        else:  # The solver's output is then incomplete.
            U, self.hot = np.clip(-np.linalg.solve(cost.H, cost.f), low, high), np.zeros(len(self.kinds))
            self.given_up += 1
        self.samples += 1
        # clip rounding errors; -0.0 becomes 0.0
        self.last = np.clip(self.scale * U[:COMMANDS], self.low, self.high) + 0.0
        return np.array(U)

    def words(self) -> str:
        """Return a sentence on failures of the solver; "" if there were none."""
        if not self.given_up:
            return ""
        text = (
            f"no solution within iterations_max = {self.most_iterations} in {self.given_up} of {self.samples} samples"
        )
        return f"{text}; the command is then computed without limits and clipped"

    def estimator(self, p: Any, x_hat: Numbers, fix: float) -> Estimator:
        """Return the filter of the predicted states, started at x_hat with the tilts that cause its acceleration."""
        if self.cost is not None:
            self.filter = HoverFilter(p, self.hover, x_hat, fix, self.y_hat)
            return self.filter
        x, vx, psi, psi_dot, a = x_hat
        tilt = level_tilt(self.craft, a)
        start = {"x": x, "vx": vx, "psi": psi, "psi_dot": psi_dot, "y": self.y_hat, "tilt_right": tilt}
        self.filter = ExtendedFilter(self.craft, p, self.printed, {**start, "tilt_left": tilt}, fix)
        return self.filter

    def command(self, x_hat: Numbers, seen: LawInput) -> Floats:
        x, target = self.filter.predicted, self.hover[0].copy()
        target[POSITIONS] += seen.x_ref, seen.y_ref, seen.psi_ref
        if self.cost is not None:
            self.solve(self.cost.at(x - target))
        else:
            cost = self._along_plan(x, target)
            scaled = self.solve(cost)
            self.path = target + np.vstack([x - target, cost.free + cost.forced @ scaled])
            self.plan = self.rest + (scaled.reshape(-1, COMMANDS) * self.scale)[self.of_step]
        return tuple((self.last + self.rest).tolist()[2:])

    def outputs(self) -> list[float]:
        """Return ŷ [m], its standard deviation [m], iterations of the solver, and 1 if it found the optimum, else 0."""
        return [self.filter.estimate[5], self.filter.sigma[2], float(self.iterations), float(self.solved)]

    def _along_plan(self, x: Matrix, target: Matrix) -> Condensed:
        """Return the cost of a horizon from the state x, with the equations linearized along the previous plan."""
        n, step = len(self.of_step), self.p.prediction_step
        path, plan = np.tile(x, (n, 1)), np.tile(self.rest, (n, 1))
        if len(self.path):  # at each step, from the previous plan
            at = np.minimum(np.arange(n) + self.sample / step, n)
            before = np.minimum(np.floor(at + 1e-9).astype(int), n - 1)
            share = (at - before)[:, None]
            path, plan = (1.0 - share) * self.path[before] + share * self.path[before + 1], self.plan[before]
        states = np.zeros((n, len(PLANT_STATES)))
        states[:, PREDICTED] = path
        A, B = self._linear(states, plan)
        rates = np.stack(np.broadcast_arrays(*self.rates(0.0, tuple(states.T), tuple(plan.T))), axis=1)[:, PREDICTED]
        # deviations are from target and rest command
        drift = rates[..., None] + A @ (target - path)[..., None] + B @ (self.rest - plan)[..., None]
        F, held = self._zero_order_hold(A)
        return self.condensed(F, held @ B, held @ drift, (x - target)[:, None]).at(np.ones(1))

    def _linear(self, states: Matrix, commands: Matrix) -> tuple[Matrix, Matrix]:
        """Return the Jacobians along the horizon: A (N, 12, 12) by predicted states, B (N, 12, 4) by commands."""
        A, B = (self.slopes.along(name, states, commands)[:, PREDICTED] for name in ("state", "command"))
        return A[:, :, PREDICTED], B

    def _zero_order_hold(self, A: Matrix) -> tuple[Matrix, Matrix]:
        """Return F = exp(h·A) and ∫₀ʰ exp(s·A) ds = h·φ₁(h·A) of each A over a prediction step.

        The step h consists of 2^doublings short ones with
        h·φ₁(h·A) = h·(I + h·A/2 + (h·A)²/6 + (h·A)³/24);   F = I + A·h·φ₁(h·A);   h·φ₁ → h·φ₁ + F·h·φ₁,   F → F·F.
        """
        h, unit = self.p.prediction_step / 2**self.doublings, np.eye(A.shape[-1])
        hA = h * A
        held = h * (unit + hA @ (unit / 2.0 + hA @ (unit / 6.0 + hA / 24.0)))
        F = unit + A @ held
        for _ in range(self.doublings):
            held, F = held + F @ held, F @ F
        return F, held
