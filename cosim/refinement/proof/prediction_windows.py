"""Overlapping predictions of the logs over the model's own horizon, and fits of a model to them.

All parameters and the power of the unknown inputs are fitted together; the power decides how far the filter's start of
a prediction depends on the equations. Some predictions cross an event that no model explains. Cauchy's loss
c²·ln(1 + z²/c²) of the size z of a prediction's error limits their weight. Each part of the logs can be left out: the
fit without the part is one Gauss–Newton step from the fit to all parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.linear_algebra import least_squares
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import DIFFERENCE, NOISE_DIFFERENCE, Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import Replays, rows_of_replay
from cosim.refinement.decision.prediction_fit import EVALUATIONS
from cosim.refinement.proof.nearest import SIMPLER
from cosim.subject.candidates import Candidate

OVERLAP = 2  # predictions that cover each row
PARTS = 6  # least number of parts of the logs, each left out once
CAUCHY = 2.385  # constant of Cauchy's loss, in units of the median error
DIVERGED = 1e6  # error, in units of the median error, of a prediction that diverges
AIC = 2.0  # least decrease of −2·ln L per parameter of an added candidate
TOLERANCE = 1e-3  # relative change of a fit's objective or step at which the fit ends


@dataclass(frozen=True, eq=False)
class Windows:
    """Overlapping predictions of the logs, none of which extends over two parts.

    Attributes:
        rows: For each log, the first row of each prediction.
        parts: Part of each prediction.
        groups: Log of each part; of a single log, its half.
    """

    problem: Problem
    horizon: float
    rows: tuple[tuple[int, ...], ...]
    parts: Rows
    groups: Rows

    @classmethod
    def of(cls, problem: Problem, horizon: float) -> Windows:
        """Return the predictions of all logs."""
        count = len(problem.logs)
        rows: list[tuple[int, ...]] = []
        parts: list[int] = []
        groups: list[int] = []
        for index, log in enumerate(problem.logs):
            first, end, length = count_unscored(log), len(log.u) - 1, rows_of_replay(problem, horizon, index)
            number = max(1, min(-(-PARTS // count), (end - first) // (2 * length)))
            edges = np.linspace(first, end, number + 1).astype(int).tolist()
            starts = [range(a, b - length + 1, max(1, length // OVERLAP)) for a, b in pairwise(edges)]
            rows.append(tuple(row for part in starts for row in part))
            for k, part in enumerate(starts):
                parts += [len(groups)] * len(part)
                groups.append(index if count > 1 else 2 * k // number)
        return cls(problem, horizon, tuple(rows), np.array(parts, np.intp), np.array(groups, np.intp))

    def errors(self, f: Fit) -> Array:
        """Return measurement − prediction, infinite if the model diverges, shape (predictions, rows, outputs)."""
        replays = [Replays(self.problem, self.horizon, f, k, rows) for k, rows in enumerate(self.rows)]
        longest = max(r.length for r in replays)
        parts = []
        for r in replays:
            e = r.residuals(f.values)
            measured = np.stack([np.isfinite(r.data.y[row + 1 : row + 1 + r.length]) for row in r.rows])
            e = np.where(measured & ~np.isfinite(e), np.inf, e)
            parts.append(np.pad(e, ((0, 0), (0, longest - r.length), (0, 0)), constant_values=np.nan))
        return np.concatenate(parts)

    def log_errors(self, errors: Array, part: int) -> float:
        """Return the logarithm of the root mean square error of a part, mean over the outputs."""
        e = errors[self.parts == part].reshape(-1, errors.shape[-1])
        squares, counts = np.nansum(e**2, axis=0), (~np.isnan(e)).sum(axis=0)
        seen = (counts > 0) & (squares > 0.0)
        return float(np.mean(0.5 * np.log(squares[seen] / counts[seen]))) if seen.any() else np.inf

    def by_log(self, errors: Sequence[float]) -> Array:
        """Return the mean over the parts of each log."""
        return np.array([np.mean(np.array(errors)[self.groups == k]) for k in np.unique(self.groups)])


def median_errors(errors: Array) -> Array:
    """Return the median root mean square error of a prediction for each output, 1 if it is unknown."""
    counts = (~np.isnan(errors)).sum(axis=1)
    sizes = np.sqrt(np.nansum(errors**2, axis=1) / np.maximum(1, counts))
    medians = [float(np.median(column[n > 0])) if n.any() else 0.0 for column, n in zip(sizes.T, counts.T, strict=True)]
    return np.array([size if 0.0 < size < math.inf else 1.0 for size in medians])


def limited(errors: Array, scale: Array) -> Array:
    """Return errors in units of `scale`, scaled down so that a prediction's sum of squares is Cauchy's loss."""
    z = np.clip(np.nan_to_num(errors / scale, nan=0.0, posinf=DIVERGED, neginf=-DIVERGED), -DIVERGED, DIVERGED)
    counts = np.maximum(1, (~np.isnan(errors)).sum(axis=(1, 2)))
    size = np.maximum(np.sum(z**2, axis=(1, 2)) / counts, 1e-12)
    loss = CAUCHY**2 * np.log1p(size / CAUCHY**2)
    return np.asarray(z * np.sqrt(loss / size / counts / OVERLAP)[:, None, None])


@dataclass(frozen=True, eq=False)
class Prediction:
    """A set of candidates with parameters that predict best.

    Attributes:
        fit: Values and noise; `free` are the free parameters.
        places: Indices of the free values in the noise vector.
        scale: Unit of each output's error.
    """

    windows: Windows
    candidates: tuple[Candidate, ...]
    fit: Fit
    places: Rows
    scale: Array

    @property
    def priors(self) -> list[tuple[int, float, float]]:
        """Return place, mean and standard deviation of each prior."""
        return [(k, *x.prior) for k, x in enumerate(self.fit.free) if x.prior]

    @property
    def theta(self) -> Array:
        """Return the free values."""
        return np.array([*(self.fit.values[x.name] for x in self.fit.free), *self.fit.noise.vector[self.places]])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Return the limits of the free values."""
        limits, free = self.windows.problem.limits, self.fit.free
        low = np.array([*(x.low for x in free), *limits.low[self.places]])
        return low, np.array([*(x.high for x in free), *limits.high[self.places]])

    @property
    def sizes(self) -> Array:
        """Return the usual change of each free value."""
        return np.array([*(x.size for x in self.fit.free), *np.ones(len(self.places))])

    def at(self, theta: Array) -> Fit:
        """Return the fit with other free values."""
        vector, count = self.fit.noise.vector, len(self.fit.free)
        vector[self.places] = theta[count:]
        values = {**self.fit.values, **{x.name: float(v) for x, v in zip(self.fit.free, theta[:count], strict=True)}}
        values |= {x.name: max(values[x.name], values[x.above]) for x in self.fit.free if x.above}
        return replace(self.fit, values=values, noise=self.fit.noise.like(vector))

    def weigh(self, errors: Array, theta: Array) -> Array:
        """Return weighted errors and priors in one vector."""
        priors = [(theta[k] - mean) / sigma for k, mean, sigma in self.priors]
        return np.concatenate([limited(errors, self.scale).ravel(), priors])

    def evaluate(self, theta: Array) -> Array:
        """Return weighted errors and priors at other free values."""
        return self.weigh(self.windows.errors(self.at(theta)), theta)

    @cached_property
    def residuals(self) -> Array:
        """Return weighted errors of predictions, followed by the priors."""
        return self.evaluate(self.theta)

    @cached_property
    def jacobian(self) -> Array:
        """Return the derivatives of `residuals` by free parameters and noise."""
        return self.derivatives(self.theta)

    @property
    def objective(self) -> float:
        """Return the minimised sum."""
        return float(self.residuals @ self.residuals)

    def required(self, count: int) -> float:
        """Return the objective below which so many further parameters are worth their cost.

        For n independent errors of estimated size, −2·ln L is n·ln(objective). Errors within a prediction depend on
        each other, so that n is the number of consecutive predictions and outputs.
        """
        number = len(self.windows.parts) / OVERLAP * len(self.scale)
        return self.objective * math.exp(-max(AIC * count / number, 2.0 * SIMPLER))

    def derivatives(self, theta: Array) -> Array:
        """Return derivatives of the weighted errors by differences, inwards at an upper limit."""
        around, high = self.evaluate(theta), self.bounds[1]
        shares = [DIFFERENCE] * len(self.fit.free) + [NOISE_DIFFERENCE] * len(self.places)

        def column(k: int) -> Array:
            h = shares[k] * self.sizes[k]
            h = h if theta[k] + h <= high[k] else -h
            moved = theta.copy()
            moved[k] += h
            return np.asarray((self.evaluate(moved) - around) / h)

        return np.array(in_parallel(column, range(len(theta)))).reshape(len(theta), len(around)).T

    def fitted(self, evaluations: int = EVALUATIONS) -> Prediction:
        """Return the prediction with free values that minimise the objective, at least as good as these."""
        from scipy.optimize import least_squares as minimise

        if not self.theta.size:
            return self
        low, high = self.bounds
        margin = np.where(np.isfinite(high - low), 1e-9 * (high - low), 0.0)
        start = np.clip(self.theta, low + margin, high - margin)
        done = minimise(
            self.evaluate,
            start,
            jac=self.derivatives,
            bounds=(low, high),
            x_scale=self.sizes,
            max_nfev=evaluations,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
        )
        other = replace(self, fit=self.at(done.x))
        other.__dict__.update(residuals=done.fun, jacobian=done.jac)
        return other

    def rescaled(self) -> Prediction:
        """Return the prediction with its own median errors as units."""
        return replace(self, scale=median_errors(self.windows.errors(self.fit)))

    def held_out_errors(self) -> Array:
        """Return the log error of each log, in predictions of parts that are left out of the fit."""
        windows, low_high = self.windows, self.bounds
        count = (len(self.residuals) - len(self.priors)) // len(windows.parts)
        parts = np.concatenate([np.repeat(windows.parts, count), np.full(len(self.priors), -1)])

        def error(part: int) -> float:
            rest = parts != part
            matrix = self.jacobian[rest] * self.sizes
            step = self.sizes * (least_squares(matrix, -self.residuals[rest], rcond=1e-8) if matrix.size else 0.0)
            return windows.log_errors(windows.errors(self.at(np.clip(self.theta + step, *low_high))), part)

        return windows.by_log(in_parallel(error, range(len(windows.groups))))
