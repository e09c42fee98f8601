"""Output-error maximum likelihood by Levenberg and Marquardt's method, for expensive and rough simulations.

The noise level of each output is concentrated out: −ln L = Σ_c n_c·ln σ_c + ½ Σ ((p − p₀)/σ_p)², σ_c² = Σ e_c²/n_c.
Its gradient is that of least squares with the weights 1/σ_c². The slopes are differences; between two sets of
differences Broyden's update follows the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cosim.calibration.simulations import Logs, Unknown
from cosim.core.arrays import Array, Flags
from cosim.core.linear_algebra import solution

SMALLEST = 1e-8  # least standard deviation of a residual, relative to the spread of its channel
STEP, SMALL, TINY = 1e-2, 1e-3, 1e-4  # steps of differences, relative to the scale of an unknown
ALIKE = 0.02  # relative difference of two slopes up to which the smaller step is trusted
ITERATIONS = 40
SETTLED = 1e-3  # expected gain in log-likelihood below which the estimate has settled, 0.04 standard errors
FAITHFUL = 0.7  # actual over expected gain from which slopes are updated and not measured again
LARGEST_STEP = 0.7  # of an unknown, relative to its scale
MOST_DAMPING, LEAST_DAMPING = 1e8, 1e-9
Jacobian = list[Array]  # for each log (rows, channels, unknowns); NaN where the residual is


@dataclass(frozen=True, eq=False)
class Point:
    """Values of the unknowns with the residuals of all logs.

    Attributes:
        tables: For each log (rows, channels), NaN without a value.
        counts, sigma: Number of values and standard deviation of each channel.
        cost: −log-likelihood with the noise levels concentrated out, up to a constant: Σ n·ln σ and the priors.
    """

    x: Array
    tables: tuple[Array, ...]
    counts: Array
    sigma: Array
    cost: float


@dataclass
class Likelihood:
    """The likelihood of the logs as a function of the unknowns.

    Attributes:
        given: Values of further parameters, set in every simulation.
        steps: Relative step of the differences of each unknown, chosen at the first slopes.
    """

    logs: Logs
    unknowns: Sequence[Unknown]
    given: Mapping[str, float] = field(default_factory=dict)
    steps: Array = field(default_factory=lambda: np.zeros(0))
    best: Point | None = None

    def __post_init__(self) -> None:
        parameters = [u.parameter for u in self.unknowns]
        self.low, self.high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
        self.prior = np.array([p.start for p in parameters])
        self.precision = np.array([p.sigma**-2 for p in parameters])
        self.scales = np.array([p.scale for p in parameters])
        for j, unknown in enumerate(self.unknowns):  # a shown start value has the spread of its output
            if unknown.log is not None and unknown.is_shown:
                for output, p in self.logs.starts[unknown.log].items():
                    if p.name == unknown.name:
                        self.scales[j] = 0.1 * self.logs.spread[output] / abs(p.gain)
                        break
        self.least = SMALLEST * np.array([self.logs.spread[n] for n in self.logs.channels])
        if not self.steps.size:
            self.steps = np.zeros(len(self.unknowns))

    # -- residuals ----------------------------------------------------------------------------

    def values(self, x: Array, k: int) -> dict[str, float]:
        """Return the values to set in log k."""
        chosen = {u.name: float(v) for u, v in zip(self.unknowns, x, strict=True) if u.log in (None, k)}
        return {**self.given, **chosen}

    def table(self, x: Array, k: int) -> Array | None:
        """Return residuals of log k, None after failure."""
        return self.logs.errors(k, self.values(x, k))

    def point(self, x: Array) -> Point | None:
        """Return residuals and cost, None if a simulation fails."""
        tables = []
        for k in range(len(self.logs.drives)):
            if (table := self.table(x, k)) is None:
                return None
            tables.append(table)
        counts = np.asarray(sum(np.isfinite(t).sum(axis=0) for t in tables), float)
        squares = sum(np.nansum(t * t, axis=0) for t in tables)
        sigma = np.maximum(np.sqrt(squares / np.maximum(counts, 1)), self.least)
        cost = float(counts @ np.log(sigma)) + 0.5 * float(self.precision @ (x - self.prior) ** 2)
        if not np.isfinite(cost):
            return None
        point = Point(x, tuple(tables), counts, sigma, cost)
        if self.best is None or point.cost < self.best.cost:
            self.best = point
        return point

    def restricted(self, kept: Flags, point: Point) -> tuple[Likelihood, Point]:
        """Return the likelihood of some of the unknowns, the others held at a point, and that point."""
        held = {
            u.name: float(v) for u, v, k in zip(self.unknowns, point.x, kept, strict=True) if not k and u.log is None
        }
        unknowns = [u for u, k in zip(self.unknowns, kept, strict=True) if k]
        inner = Likelihood(self.logs, unknowns, {**self.given, **held}, self.steps[kept])
        x = point.x[kept]
        cost = float(point.counts @ np.log(point.sigma)) + 0.5 * float(inner.precision @ (x - inner.prior) ** 2)
        inner.best = replace(point, x=x, cost=cost)
        return inner, inner.best

    # -- slopes -------------------------------------------------------------------------------

    def jacobian(self, point: Point, central: bool = False) -> Jacobian:
        """Return the slopes of the residuals by differences."""
        slopes = [np.full((*t.shape, len(self.unknowns)), np.nan) for t in point.tables]
        for slope, table in zip(slopes, point.tables, strict=True):
            slope[np.isfinite(table)] = 0.0
        for j, unknown in enumerate(self.unknowns):
            known: dict[int, Array | None] = {}
            if not self.steps[j] and unknown.is_shown:
                self.steps[j] = STEP  # the effect of a start value is nearly linear
            elif not self.steps[j]:
                known[unknown.log or 0] = self._choose_step(point, j)
            for k in range(len(slopes)) if unknown.log is None else (unknown.log,):
                if k not in known:
                    known[k] = self._slope(point, j, k, self.steps[j], central and not unknown.is_shown)
                if (column := known[k]) is not None:
                    slopes[k][..., j] = column
        return slopes

    def _choose_step(self, point: Point, j: int) -> Array | None:
        """Choose the step of an unknown, small unless the rounding of the solver shows; return the slope with it.

        The slope is that of the unknown's log, or of the first log.
        """

        def size(slope: Array) -> float:
            return float(np.sqrt(np.nansum(slope * slope)))

        k = self.unknowns[j].log or 0
        large, small = (self._slope(point, j, k, step) for step in (STEP, SMALL))
        self.steps[j] = SMALL
        if large is None or small is None or size(small - large) <= ALIKE * size(large):
            return small
        tiny = self._slope(point, j, k, TINY)
        if tiny is not None and size(tiny - small) < size(small - large):
            return small
        self.steps[j] = STEP
        return large

    def _slope(self, point: Point, j: int, k: int, step: float, central: bool = False) -> Array | None:
        """Return the slope of log k's residuals by unknown j; None if the FMU fails on both sides."""
        size, x = step * self.scales[j], point.x[j]
        tables = []
        for side in (size, -size):
            if not self.low[j] <= x + side <= self.high[j]:
                continue
            moved = point.x.copy()
            moved[j] += side
            if (table := self.table(moved, k)) is not None:
                tables.append((side, table))
                if not central:
                    break
        if len(tables) == 2:
            return np.asarray((tables[0][1] - tables[1][1]) / (2.0 * size))
        return (tables[0][1] - point.tables[k]) / tables[0][0] if tables else None

    # -- the estimate -------------------------------------------------------------------------

    def equations(self, point: Point, slopes: Jacobian) -> tuple[Array, Array]:
        """Return information matrix and gradient of the cost."""
        weights = point.sigma**-2
        matrix = np.diag(self.precision)
        gradient = self.precision * (point.x - self.prior)
        for table, slope in zip(point.tables, slopes, strict=True):
            good = np.isfinite(table)
            rows, weight = slope[good], np.broadcast_to(weights, table.shape)[good]
            matrix = matrix + rows.T @ (weight[:, None] * rows)
            gradient = gradient + rows.T @ (weight * table[good])
        return matrix, gradient

    def maximize(self, start: Point, slopes: Jacobian, report: Callable[[int], None]) -> bool:
        """Move from a point to the largest likelihood, `best`; return True if it settled."""
        point, damping, fresh = start, 1e-3, True
        for iteration in range(ITERATIONS):
            report(iteration)
            if not slopes:
                slopes, fresh = self.jacobian(point), True
            step, expected = self._step(point, slopes, damping)
            if expected < SETTLED:
                if fresh:
                    return damping <= 1.0  # else only the damping makes the step small
                slopes = []
                continue
            moved = self.point(point.x + step)
            gain = -np.inf if moved is None else point.cost - moved.cost
            if moved is None or gain <= 0.0:
                if not fresh:
                    slopes = []
                elif damping > MOST_DAMPING:
                    return False
                damping *= 8.0
                continue
            faithful = FAITHFUL * expected <= gain
            damping = max(LEAST_DAMPING, damping * (0.1 if faithful else 1.0 if gain > 0.25 * expected else 4.0))
            slopes = self._follow(slopes, point, moved) if faithful else []
            point, fresh = moved, False
        return False

    def _follow(self, slopes: Jacobian, point: Point, moved: Point) -> Jacobian:
        """Return slopes that explain the last step (Broyden 1965), in units of the scales."""
        updated = []
        for k, (slope, before, after) in enumerate(zip(slopes, point.tables, moved.tables, strict=True)):
            acting = np.array([u.log in (None, k) for u in self.unknowns])
            step = np.where(acting, moved.x - point.x, 0.0)
            weighted = step / self.scales**2
            square = float(step @ weighted)
            miss = after - before - slope @ step
            updated.append(slope + miss[..., None] * (weighted / square) if square > 0.0 else slope)
        return updated

    def _step(self, point: Point, slopes: Jacobian, damping: float) -> tuple[Array, float]:
        """Return a step within the bounds, and the gain that the quadratic model expects of it."""
        matrix, gradient = self.equations(point, slopes)
        at_low, at_high = point.x <= self.low, point.x >= self.high
        step, free = np.zeros(point.x.size), ~((at_low & (gradient > 0.0)) | (at_high & (gradient < 0.0)))
        scales = np.maximum(self.scales, np.abs(point.x))
        for _ in range(point.x.size + 1):  # an unknown that reaches its bound stays there
            inner = matrix[np.ix_(free, free)]
            floor = 1e-12 * float(np.max(np.diag(matrix) * scales**2, initial=0.0)) / scales[free] ** 2
            inner = inner + np.diag(damping * np.diag(inner) + floor)
            held = gradient[free] + matrix[np.ix_(free, ~free)] @ step[~free]
            step[free] = -solution(inner, held) if free.any() else 0.0
            beyond = free & ((point.x + step < self.low) | (point.x + step > self.high))
            if not beyond.any():
                break
            step[beyond] = np.clip(point.x + step, self.low, self.high)[beyond] - point.x[beyond]
            free = free & ~beyond
        largest = float(np.max(np.abs(step) / scales, initial=0.0))
        step = step * min(1.0, LARGEST_STEP / largest) if largest > 0.0 else step
        return step, -float(gradient @ step + 0.5 * step @ matrix @ step)
