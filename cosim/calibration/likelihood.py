"""Output-error maximum likelihood by Levenberg and Marquardt's method, for expensive and rough simulations.

The noise level of each output is concentrated out: −ln L = Σ_c n_c·ln σ_c + ½ Σ ((p − p₀)/σ_p)², σ_c² = Σ e_c²/n_c.
Its gradient is that of least squares with the weights 1/σ_c². The slopes are differences; between two sets of
differences Broyden's update follows the steps. A failure of the FMU costs one trial.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.calibration.vary import Parameter
from cosim.core.arrays import Array, Flags
from cosim.core.errors import SimulationError
from cosim.core.linear_algebra import solution
from cosim.residuals.drive import Drive
from cosim.residuals.starts import first_start, sigma_of, start_parameters
from cosim.residuals.windows import free_run, self_started

SMALLEST = 1e-8  # least standard deviation of a residual, relative to the spread of its channel
STEP, SMALL, TINY = 1e-2, 1e-3, 1e-4  # steps of differences, relative to the scale of an unknown
ALIKE = 0.02  # relative difference of two slopes up to which the smaller step is trusted
ITERATIONS = 40
SETTLED = 1e-3  # expected gain in log-likelihood below which the estimate has settled, 0.04 standard errors
FAITHFUL = 0.7  # actual over expected gain from which slopes are updated and not measured again
LARGEST_STEP = 0.7  # of an unknown, relative to its scale
MOST_DAMPING, LEAST_DAMPING = 1e8, 1e-9
Jacobian = list[Array]  # for each log (rows, channels, unknowns); NaN where the residual is


class OutOfTime(Exception):
    """The time budget of a fit is spent."""


@dataclass(frozen=True)
class Unknown:
    """One number to estimate: a parameter of all logs, or a start value of one log.

    Attributes:
        first: First value of the estimate.
        log: Index of the log of a start value; None for a parameter.
        is_shown: True for a start value that an output shows; others were named.
        scale: Typical size.
    """

    parameter: Parameter
    first: float
    scale: float
    log: int | None = None
    is_shown: bool = False

    @property
    def name(self) -> str:
        """Return the name of the variable."""
        return self.parameter.name


class Logs:
    """Logs with their drives, and everything that their simulations have in common.

    Attributes:
        deadline: Clock time at which the budget is spent.
        all_starts: For each log, start parameters by output; `starts` has those of measured outputs.
        channels: Measured outputs of any log.
        spread: Channel → standard deviation of its measurements over all logs.
        noise: Channel → noise level of its sensor, the median over the logs.
        horizon: Length of windows [s]; None for free runs.
        count: Number of simulations of a whole log so far.
        failed: Number of rejected simulations, with values and reason of the first.
    """

    def __init__(self, drives: Sequence[Drive], deadline: float = math.inf) -> None:
        self.drives, self.deadline = drives, deadline
        self.horizon: float | None = None
        self.count = self.failed = 0
        self.first_failure: tuple[dict[str, float], SimulationError] | None = None
        self.channels = tuple(dict.fromkeys(name for d in drives for name in d.log.outputs))
        self.spread, self.noise = dict[str, float](), dict[str, float]()
        for name in self.channels:
            parts = [d.log.outputs[name] for d in drives if name in d.log.outputs]
            values = np.concatenate(parts)
            self.spread[name] = float(np.nanstd(values)) or float(np.nanmax(np.abs(values))) or 1.0
            self.noise[name] = float(np.median([sigma_of(part) for part in parts]))
        self.all_starts = [start_parameters(drive) for drive in drives]
        self.starts = [
            {n: p for n, p in every.items() if n in drive.log.outputs and p.name not in drive.given}
            for drive, every in zip(drives, self.all_starts, strict=True)
        ]

    def start_unknowns(self, values: Mapping[str, float]) -> list[Unknown]:
        """Return the start values that outputs show, with a first estimate for each log, unless `values` has them."""
        unknowns = []
        for k, (drive, starts) in enumerate(zip(self.drives, self.starts, strict=True)):
            shown = {p.name: (output, p) for output, p in starts.items() if p.name not in values}
            first = first_start(drive.with_values(values), dict(shown.values())) if shown else {}
            for name, (output, p) in shown.items():
                start, unit = first.get(name, p.tried[0]), drive.units.get(output, "")
                parameter = Parameter(name, unit, start, p.low, p.high, None, per_log=True)
                # the start value has the spread of its output
                unknowns.append(Unknown(parameter, start, 0.1 * self.spread[output] / abs(p.gain), k, True))
        return unknowns

    def errors(self, k: int, values: Mapping[str, float]) -> Array | None:
        """Return measured − model of a log, shape (rows, channels), NaN without both; None if the FMU fails."""
        log = self.drives[k].log
        if time.monotonic() > self.deadline:
            raise OutOfTime
        try:
            outputs = self.outputs(k, values, self.horizon)
        except SimulationError as error:
            self.failed += 1
            self.first_failure = self.first_failure or (dict(values), error)
            return None
        nothing = np.full(log.rows, np.nan)
        return np.column_stack([log.outputs[n] - outputs[n] if n in log.outputs else nothing for n in self.channels])

    def outputs(self, k: int, values: Mapping[str, float], horizon: float | None) -> Mapping[str, Array]:
        """Return the outputs of a free run of a log, or of its windows; nothing where it has no windows."""
        self.count += 1
        drive = self.drives[k].with_values(values)
        if horizon is None:
            return dict(zip(drive.outputs, drive.run(0, drive.log.rows - 1, {}).T, strict=True))
        replay = self_started(drive, self.all_starts[k], free_run(drive), horizon)
        return {} if replay is None else replay.outputs


@dataclass(frozen=True, eq=False)
class Point:
    """Values of the unknowns with the residuals of all logs.

    Attributes:
        tables: For each log (rows, channels), NaN without a value.
        counts, sigma: Number of values and standard deviation of each channel.
        cost: −log-likelihood with the noise levels concentrated out, up to a constant: Σ n·ln σ and the priors.
    """

    x: Array
    tables: Sequence[Array]
    counts: Array
    sigma: Array
    cost: float


class Likelihood:
    """The likelihood of the logs as a function of the unknowns.

    Attributes:
        given: Values of further parameters, set in every simulation.
        steps: Relative step of the differences of each unknown, chosen at the first slopes.
        best: Point with the largest likelihood so far.
        slopes: Derivatives of the residuals by the unknowns, for intervals and identifiability.
    """

    best: Point
    slopes: Jacobian

    def __init__(self, logs: Logs, unknowns: Sequence[Unknown], given: Mapping[str, float]) -> None:
        self.logs, self.unknowns, self.given = logs, unknowns, given
        parameters = [u.parameter for u in unknowns]
        self.low, self.high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
        self.prior = np.array([p.start for p in parameters])
        self.precision = np.array([p.sigma**-2 for p in parameters])
        self.scales = np.array([u.scale for u in unknowns])
        self.steps = np.zeros(len(unknowns))

    # -- residuals ----------------------------------------------------------------------------

    def values(self, x: Array, k: int) -> dict[str, float]:
        """Return the values to set in log k."""
        chosen = {u.name: float(v) for u, v in zip(self.unknowns, x, strict=True) if u.log in (None, k)}
        return {**self.given, **chosen}

    def tables(self, x: Array, near: Point | None = None) -> list[Array] | None:
        """Return the residuals of all logs, None if a simulation fails; logs without a change keep those of `near`."""
        tables = []
        for k in range(len(self.logs.drives)):
            values = self.values(x, k)
            same = near is not None and values == self.values(near.x, k)
            table = near.tables[k] if near is not None and same else self.logs.errors(k, values)
            if table is None:
                return None
            tables.append(table)
        return tables

    def point(self, x: Array) -> Point | None:
        """Return residuals and cost, None if a simulation fails."""
        tables = self.tables(x)
        if tables is None:
            return None
        counts = np.asarray(sum(np.isfinite(t).sum(axis=0) for t in tables), float)
        squares = sum(np.nansum(t * t, axis=0) for t in tables)
        least = SMALLEST * np.array([self.logs.spread[n] for n in self.logs.channels])
        sigma = np.maximum(np.sqrt(squares / np.maximum(counts, 1)), least)
        cost = float(counts @ np.log(sigma)) + 0.5 * float(self.precision @ (x - self.prior) ** 2)
        point = Point(x, tables, counts, sigma, cost)
        if not np.isfinite(point.cost):
            return None
        if not hasattr(self, "best") or point.cost < self.best.cost:
            self.best = point
        return point

    def restricted(self, kept: Flags) -> Likelihood:
        """Return the likelihood of some of the unknowns, the others held at the best point."""
        best, pairs = self.best, [*zip(self.unknowns, self.best.x, kept, strict=True)]
        held = {u.name: float(v) for u, v, k in pairs if not k and u.log is None}
        inner = Likelihood(self.logs, [u for u, _, k in pairs if k], {**self.given, **held})
        inner.steps, x = self.steps[kept], best.x[kept]
        cost = float(best.counts @ np.log(best.sigma)) + 0.5 * float(inner.precision @ (x - inner.prior) ** 2)
        inner.best = replace(best, x=x, cost=cost)
        if hasattr(self, "slopes"):
            inner.slopes = [s[..., kept] for s in self.slopes]
        return inner

    # -- slopes -------------------------------------------------------------------------------

    def measure_slopes(self, central: bool = False) -> Jacobian:
        """Return the slopes of the residuals at the best point by differences."""
        point, nothing = self.best, np.full(len(self.unknowns), np.nan)
        slopes = [np.where(np.isfinite(t)[..., None], 0.0, nothing) for t in point.tables]
        for j, unknown in enumerate(self.unknowns):
            columns: dict[int, Array | None] = {}
            logs = range(len(slopes)) if unknown.log is None else (unknown.log,)
            if not self.steps[j] and unknown.is_shown:
                self.steps[j] = STEP  # the effect of a start value is nearly linear
            elif not self.steps[j]:
                columns[logs[0]] = self._choose_step(point, j, logs[0])
            for k in logs:
                if k not in columns:
                    columns[k] = self._slope(point, j, k, self.steps[j], central and not unknown.is_shown)
                if (column := columns[k]) is not None:
                    slopes[k][..., j] = column
        return slopes

    def _choose_step(self, point: Point, j: int, k: int) -> Array | None:
        """Choose the step of an unknown in log k, small unless the rounding of the solver shows; return its slope."""

        def size(slope: Array) -> float:
            return float(np.sqrt(np.nansum(slope * slope)))

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
        size, sides = step * self.scales[j], []
        for side in (size, -size):
            moved = point.x.copy()
            moved[j] += side
            if not self.low[j] <= moved[j] <= self.high[j]:
                continue
            if (table := self.logs.errors(k, self.values(moved, k))) is not None:
                sides.append((side, table))
                if not central:
                    break
        if len(sides) == 2:
            return np.asarray((sides[0][1] - sides[1][1]) / (2.0 * size))
        return (sides[0][1] - point.tables[k]) / sides[0][0] if sides else None

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

    def maximize(self, report: Callable[[int], None]) -> bool:
        """Move from the best point to the largest likelihood; return True if it settled."""
        point, slopes, damping, fresh = self.best, self.slopes, 1e-3, True
        for iteration in range(ITERATIONS):
            report(iteration)
            if not slopes:
                slopes, fresh = self.measure_slopes(), True
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
            following = []  # slopes that explain this step (Broyden 1965), in units of the scales
            sides = zip(slopes, point.tables, moved.tables, strict=True)
            for k, (slope, before, after) in enumerate(sides if faithful else ()):
                acting = np.array([u.log in (None, k) for u in self.unknowns])
                made = np.where(acting, moved.x - point.x, 0.0)
                weighted = made / self.scales**2
                square = float(made @ weighted)
                miss = after - before - slope @ made
                following.append(slope + miss[..., None] * (weighted / square) if square > 0.0 else slope)
            point, slopes, fresh = moved, following, False
        return False

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
