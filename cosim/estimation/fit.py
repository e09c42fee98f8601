"""Maximum likelihood on the innovations by Fisher scoring, with free process and sensor noise.

Noise and parameters are estimated together (Kristensen, Madsen and Jørgensen 2004). A large unknown input indicates a
deficient equation; it decreases when the correct term is added.

    NLL = ½ Σ ln 2πs + e²/s    gradient Σ ∂e·e/s + ½ ∂ln s·(1 − e²/s)    information Σ ∂e·∂e'/s + ½ ∂ln s·∂ln s'
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import brentq

from cosim.core.arrays import Array, NamedValues
from cosim.core.linear_algebra import least_squares, pseudo_inverse
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Noise, Problem, Scored
from cosim.estimation.subject.candidates import Free, own, spread
from cosim.logs.log import NORMAL_95

MAX_ITERATIONS = 30
CONVERGED_GAIN = 0.1  # NLL improvement of the last iteration; an evidence needs no exact optimum
DIFFERENCE = 0.01  # share of a parameter's size for differences; noise levels, in logarithms, need more
NOISE_DIFFERENCE = 5.0 * DIFFERENCE
LEVELS = 9  # of the unknown inputs, compared before a fit
DAMPING = 1e-3  # of the first step; it is multiplied and divided by
DAMPING_FACTOR = 10.0
MAX_PLATEAU_DISTANCE = 1e4  # distance in sizes from which a plateau has no end
PROMISE = 3.0  # factor on the improvement of the quadratic model before a fit is abandoned


@dataclass(frozen=True)
class Fit:
    """Result of a fit: parameter values, noise, NLL of the logs, and information matrix of parameters and noise.

    Attributes:
        scattered: Covariance of the free parameters from the scatter of scores over blocks of time.
        regions: Limits of the 95 % region of each parameter whose likelihood is flat near the estimate.
    """

    values: NamedValues
    noise: Noise
    free: tuple[Free, ...]
    nll: float
    penalty: float
    information: Array
    iterations: int
    converged: bool
    scattered: Array | None = None
    regions: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def objective(self) -> float:
        """Return the minimised objective: NLL plus the penalty of the priors."""
        return self.nll + self.penalty

    def marginal(self, names: Sequence[str]) -> Array:
        """Return the information matrix of some parameters, with all others estimated (Schur complement)."""
        F = self.information
        own = np.isin([f.name for f in self.free] + [""] * (len(F) - len(self.free)), names)
        shared = F[np.ix_(own, ~own)] @ inverse(F[np.ix_(~own, ~own)]) @ F[np.ix_(~own, own)]
        return F[np.ix_(own, own)] - shared

    def interval(self, name: str) -> tuple[float, float]:
        """Return the limits of the 95 % interval of an estimate."""
        value, half = float(self.values[name]), NORMAL_95 * self.sigma(name)
        return self.regions.get(name, (value - half, value + half))

    def sigma(self, name: str, less: str = "") -> float:
        """Return the standard deviation of an estimate: the larger one from information matrix and from scatter.

        Args:
            less: Parameter whose value is subtracted from the estimate; "" for none.
        """
        names = [f.name for f in self.free]
        places, signs = [names.index(n) for n in (name, less) if n], np.array([1.0, -1.0])[: 2 if less else 1]
        both = [inverse(self.information), *([] if self.scattered is None else [self.scattered])]
        return float(np.sqrt(max(0.0, *(signs @ c[np.ix_(places, places)] @ signs for c in both))))


def initial_fit(problem: Problem) -> Fit:
    """Return a `Fit` for the given model, without fitted parameters.

    The unknown inputs have the most likely of some levels. From too low a level, a fit would change parameters instead
    of the noise.
    """
    noise = problem.plain
    if not problem.trusted:
        span = problem.noise.largest - noise.power
        levels = [replace(noise, power=noise.power + share * span) for share in np.linspace(0.0, 1.0, LEVELS)]
        noise = min(levels, key=lambda level: problem.score(problem.values, level).nll)
    return Fit(problem.values, noise, (), 0.0, 0.0, np.zeros((0, 0)), 0, False)


def inverse(information: Array) -> Array:
    """Return the pseudo-inverse of an information matrix, computed in scaled parameters.

    Without scaling, the least identifiable parameter would be treated as singular.
    """
    scale = np.sqrt(np.diag(information).clip(min=0.0))
    scale[scale == 0.0] = 1.0
    return pseudo_inverse(information / np.outer(scale, scale)) / np.outer(scale, scale)


def fit(
    problem: Problem,
    free: Sequence[Free],
    start: NamedValues,
    noise: Noise,
    only: Sequence[int] | None = None,
    iterations: int = MAX_ITERATIONS,
    *,
    goal: float = np.inf,
    sensing: bool = True,
) -> Fit:
    """Fit free parameters and noise to the posterior maximum.

    Args:
        start, noise: Start values of parameters and noise.
        only: Indices of the logs to fit; None for all.
        iterations: Largest number of iterations.
        goal: Objective that the quadratic model must predict after the first iteration; otherwise the fit ends.
        sensing: Also fit sensor noise and the correlation time of unknown inputs; otherwise only their power.
    """
    return _Scoring(problem, tuple(free), start, noise, only, sensing=sensing).run(iterations, goal)


@dataclass(frozen=True, eq=False)
class Slopes:
    """Errors and variances at a fit, with their derivatives by the free parameters and the free noise.

    Attributes:
        errors: ∂e/∂θ of each measurement, shape (parameters, measurements).
        log_variances: ∂ln s/∂θ, shape (parameters, measurements).
        information: Information matrix of parameters and noise, with the priors.
    """

    scored: Scored
    errors: Array
    log_variances: Array
    information: Array

    @property
    def gradients(self) -> Array:
        """Return the gradient of each measurement's NLL by the parameters, shape (parameters, measurements)."""
        e, s = self.scored.errors, self.scored.variances
        return self.errors * (e / s) + 0.5 * self.log_variances * (1.0 - e * e / s)


def slopes(problem: Problem, f: Fit) -> Slopes:
    """Return errors, variances and their derivatives at a fit, by central differences within the limits."""
    scoring = _Scoring(problem, f.free, f.values, f.noise, None, sensing=True)
    scoring.scored = scoring._evaluate(scoring.theta)
    de, dls = scoring.sensitivities(both=True)  # on a ridge, one-sided differences overestimate the sensitivity
    _, information = scoring.derivatives(de, dls)
    size = scoring.size
    return Slopes(scoring.scored, de / size[:, None], dls / size[:, None], information / np.outer(size, size))


class _Scoring:
    """Fisher scoring with Levenberg damping; the vector θ contains the free parameters, then the free noise."""

    def __init__(
        self,
        problem: Problem,
        free: tuple[Free, ...],
        start: NamedValues,
        noise: Noise,
        only: Sequence[int] | None,
        *,
        sensing: bool,
    ) -> None:
        self.problem, self.free, self.only = problem, free, only
        self.start = {**problem.values, **start}
        self.noise, limits = noise, problem.limits
        self.free_noise = limits.free if sensing else limits.free[limits.free < len(noise.power)]
        priors = [f.prior or (0.0, np.inf) for f in free]  # mean and standard deviation of each parameter
        priors += zip(limits.mean[self.free_noise], limits.sigma[self.free_noise], strict=True)
        self.mean, self.sigma = np.array(priors).reshape(-1, 2).T
        self.low = np.array([f.low for f in free] + [*limits.low[self.free_noise]])
        self.high = np.array([f.high for f in free] + [*limits.high[self.free_noise]])
        self.size = np.array([f.size for f in free] + [1.0] * len(self.free_noise))
        self.difference = self.size * np.array([DIFFERENCE] * len(free) + [NOISE_DIFFERENCE] * len(self.free_noise))
        places = {f.name: k for k, f in enumerate(free)}
        self.order = [(k, places[f.above]) for k, f in enumerate(free) if f.above in places]
        self.theta = self._within(np.array([*(self.start[f.name] for f in free), *noise.vector[self.free_noise]]))
        self.damping = DAMPING

    def run(self, iterations: int, goal: float) -> Fit:
        """Iterate until the objective converges."""
        self.scored = self._evaluate(self.theta)
        done, converged, is_kept = 0, False, False
        information = np.zeros((len(self.theta),) * 2)
        limit = iterations * int(np.isfinite(self.scored.nll))  # zero if the filter diverges at the start values
        while done < limit and not converged:
            if not is_kept:
                slopes = self.sensitivities()
            gradient, curvature = self.derivatives(*slopes)
            if not np.isfinite([*gradient, *curvature.flat]).all():
                break  # The filter diverges near this point, so there is no search direction.
            information = curvature
            before = self.scored.nll + self._penalty(self.theta)
            expected = 0.5 * float(gradient @ least_squares(information, gradient))
            if done and before - PROMISE * expected > goal:
                break
            damping = self.damping
            pace = self._move(gradient, information)
            if is_kept and not pace:
                self.damping = damping  # the slopes are to blame
            enough = CONVERGED_GAIN * self.problem.scatter
            converged = pace < enough and not is_kept
            is_kept = not is_kept and pace > max(enough, 0.5 * expected)  # if as predicted
            done += 1
        unscaled, penalty = information / np.outer(self.size, self.size), self._penalty(self.theta)
        return Fit(*self._unpack(self.theta), self.free, self.scored.nll, penalty, unscaled, done, converged)

    def _unpack(self, theta: Array) -> tuple[dict[str, float], Noise]:
        values = {f.name: float(v) for f, v in zip(self.free, theta[: len(self.free)], strict=True)}
        vector = self.noise.vector
        vector[self.free_noise] = theta[len(self.free) :]
        return {**self.start, **values}, self.noise.like(vector)

    def _within(self, theta: Array) -> Array:
        """Return θ clipped to limits, with parameters above their lower-bound parameters."""
        clipped: Array = np.clip(theta, self.low, self.high)
        for upper, lower in self.order:
            clipped[upper] = max(clipped[upper], clipped[lower])
        return clipped

    def _evaluate(self, theta: Array) -> Scored:
        return self.problem.score(*self._unpack(theta), self.only)

    def _penalty(self, theta: Array) -> float:
        values, noise = self._unpack(theta)
        of_values = sum(0.5 * ((values[f.name] - f.prior[0]) / f.prior[1]) ** 2 for f in self.free if f.prior)
        return float(self.problem.scatter * (self.problem.limits.penalty(noise.vector) + of_values))

    def sensitivities(self, *, both: bool = False) -> tuple[Array, Array]:
        """Return ∂e and ∂ln s by θ in units of the parameters' sizes.

        Differences are one-sided, downwards at an upper limit.

        Args:
            both: Use central differences within the limits.
        """
        shape = (len(self.theta), len(self.scored.errors))
        de, dls = np.empty(shape), np.empty(shape)

        def row(i: int) -> None:
            h, unit = self.difference[i], np.eye(len(self.theta))[i]
            h = h if self.theta[i] + h <= self.high[i] else -h
            back = h if both and self.low[i] <= self.theta[i] - h <= self.high[i] else 0.0
            ahead = self._evaluate(self.theta + h * unit)
            behind = self._evaluate(self.theta - back * unit) if back else self.scored
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # a diverged filter gives NaN
                de[i] = (ahead.errors - behind.errors) / (h + back) * self.size[i]
                dls[i] = np.log(ahead.variances / behind.variances) / (h + back) * self.size[i]

        in_parallel(row, range(len(self.theta)))
        return np.nan_to_num(de, posinf=0.0, neginf=0.0), np.nan_to_num(dls, posinf=0.0, neginf=0.0)

    def derivatives(self, de: Array, dls: Array) -> tuple[Array, Array]:
        """Return the gradient ∂NLL/∂θ and the information matrix for scaled θ; both include the priors."""
        e, s = self.scored.errors, self.scored.variances
        with np.errstate(over="ignore", invalid="ignore"):  # the filter may diverge near this point
            gradient = de @ (e / s) + 0.5 * dls @ (1.0 - e * e / s)
            information = (de / s) @ de.T + 0.5 * dls @ dls.T
        weight = self.problem.scatter
        gradient += weight * self.size * (self.theta - self.mean) / self.sigma**2
        precision = (self.size / self.sigma) ** 2
        precision[len(self.free) :] = self.sigma[len(self.free) :] ** -2
        return gradient, information + np.diag(weight * precision)

    def _move(self, gradient: Array, information: Array) -> float:
        """Take a damped Newton step within the limits; return the improvement of the objective, or 0 without one."""
        before = self.scored.nll + self._penalty(self.theta)
        while self.damping < 1.0 / DAMPING:
            # A parameter pushed beyond its limit stays fixed.
            pinned = ((self.theta <= self.low) & (gradient > 0)) | ((self.theta >= self.high) & (gradient < 0))
            rest = np.flatnonzero(~pinned)
            F = information[np.ix_(rest, rest)]
            step = np.zeros_like(self.theta)
            step[rest] = -least_squares(F + self.damping * np.diag(np.diag(F)), gradient[rest])
            theta = self._within(self.theta + step * self.size)
            scored = self._evaluate(theta)
            after = scored.nll + self._penalty(theta)
            if after < before:
                self.theta, self.scored, self.damping = theta, scored, max(self.damping / DAMPING_FACTOR, DAMPING**2)
                return before - after
            self.damping *= DAMPING_FACTOR
        return 0.0


# Parameters with a flat likelihood near their estimates, such as a lag shorter than a row. A fit may end where the
# likelihood has no slope by the parameter. The estimate then has no information, and would have an interval of width 0.
# The interval is therefore the region in which the likelihood is within its 95 % limit (Venzon and Moolgavkar 1988,
# Appl. Stat. 37:87), with the other parameters fixed.


def with_flat_directions(problem: Problem, f: Fit, scattered: Array) -> Fit:
    """Return the fit with a region for each parameter with a flat likelihood, and a variance that covers it.

    The region need not be symmetric about the estimate: a lag shorter than a row has only an upper limit.

    Args:
        scattered: Covariance of the free parameters from the scatter of scores over blocks of time.
    """
    scattered, regions = scattered.copy(), dict(f.regions)
    for k in [k for k, x in enumerate(f.free) if not f.information[k, k] > 0.0 and x.low < x.high]:
        x = f.free[k]
        low, high = regions[x.name] = _end_of_plateau(problem, f, x, x.low), _end_of_plateau(problem, f, x, x.high)
        scattered[k, k] = (max(f.values[x.name] - low, high - f.values[x.name]) / NORMAL_95) ** 2
    return replace(f, scattered=scattered, regions=regions)


def _end_of_plateau(problem: Problem, f: Fit, x: Free, limit: float) -> float:
    """Return the value towards a limit at which the NLL has risen by ½·1.96², or the limit if there is none."""
    start = f.values[x.name]
    furthest = float(np.clip(limit, start - MAX_PLATEAU_DISTANCE * x.size, start + MAX_PLATEAU_DISTANCE * x.size))

    def rise(value: float) -> float:
        nll = problem.score({**f.values, x.name: value}, f.noise).nll
        return float(np.nan_to_num(nll - f.nll)) - 0.5 * NORMAL_95**2

    if furthest == start or rise(furthest) <= 0.0:
        return limit
    return float(brentq(rise, start, furthest, rtol=DIFFERENCE))


# Expected parameter values of groups of logs without an estimate, such as groups of held-out and sealed logs


def expected_values(f: Fit, besides: str = "") -> dict[str, tuple[float, float]]:
    """Return (mean over groups, spread for a new group) of each parameter with a value per group of logs.

    For estimates θ̂ of n groups with standard deviation s, the spread is t·s·√(1 + 1/n); t scales the normal
    distribution so that its 95 % interval is that of Student's t with n − 1 degrees of freedom. s is at least the
    uncertainty of the estimates. A single group has the spread of the prior.

    Args:
        besides: Group of logs to ignore.
    """
    from scipy.special import ndtr, stdtrit

    found = {}
    for name in dict.fromkeys(x.parameter for x in f.free if x.group):
        every = [x for x in f.free if x.parameter == name]
        others = [x for x in every if x.group != besides]
        mean, width = every[0].prior or (f.values[name], every[0].size)
        values = [f.values[x.name] for x in others]
        n = len(values)
        if n > 1:
            s = max(float(np.std(values, ddof=1)), float(np.sqrt(np.mean([f.sigma(x.name) ** 2 for x in others]))))
            width = float(stdtrit(n - 1, ndtr(NORMAL_95))) / NORMAL_95 * s * math.sqrt(1.0 + 1.0 / n)
        found[name] = float(np.mean(values)) if values else mean, width
    return found


def _start_values(f: Fit, group: str) -> dict[str, float]:
    """Return the parameters of a group of logs, and their spreads, predicted from the other groups."""
    values = expected_values(f, group)
    return {key(n, group): v for n, pair in values.items() for key, v in zip((own, spread), pair, strict=True)}


def fit_for_held_out(problem: Problem, f: Fit, index: int) -> Fit:
    """Return a fit, with expected parameters for a held-out log if the fit has none for the log's group."""
    if not problem.own:
        return f
    groups = [origin.group for origin in problem.origins]
    if groups.count(groups[index]) > 1:
        return f
    return replace(f, values={**f.values, **_start_values(f, groups[index])})


def group_values(f: Fit, groups: Iterable[str]) -> dict[str, float]:
    """Return the fitted or, without an estimate, the expected parameters of each group of logs."""
    values: dict[str, float] = {}
    for group in dict.fromkeys(groups):
        if all(x.group != group for x in f.free):
            values |= _start_values(f, group)
    return values | {x.name: f.values[x.name] for x in f.free if x.group}
