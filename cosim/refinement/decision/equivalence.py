"""Hypotheses that act alike for every input, so that no experiment can separate them.

A settable damping of an FMU and the viscous term of the catalogue at the same velocity are one thing with two names.
Both are simulated along random inputs, at the estimated size and enlarged. The parameters of one hypothesis, and the
base parameters within their tolerances, adapt to the predictions of the other. They act alike if nothing is left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import FmuError, SimulationError
from cosim.estimation.kernel.kernel import Data
from cosim.estimation.past_readings import lagged_table
from cosim.estimation.problem import Problem
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Hypothesis

EQUIVALENT = 1e-3  # share of an effect's response below which a difference is that of rounding and integration
PULL = 0.1  # share of EQUIVALENT that one standard deviation of a prior weighs
WITHIN = 2.0  # standard deviations, one tolerance, by which base parameters may go further to adapt
ENLARGED = 3.0  # factor on the ranges of inputs, and least factor on the sizes of effects, beyond those of the logs
MOST_ROWS = 2000
LONGEST_HOLD = 0.1  # share of the rows for which a level of an input is held at most
EVALUATIONS = 30
SEED = 26  # fixed for reproducible results


def act_alike(search: Search, one: Hypothesis, other: Hypothesis) -> bool:
    """Return True if two hypotheses predict the same for inputs and sizes beyond those of the logs.

    The hypothesis with fewer parameters adapts, because one with more could imitate the other.
    """
    problem = search.problem
    if not problem.late.keys().isdisjoint(_own(one) + _own(other)):
        return False
    truth, adapted = sorted((one, other), key=lambda h: -len(_own(h)))
    free = [f for c in truth.candidates if c.kind != "parameter" for f in c.free if f.neutral is not None]
    distances = ((f, abs(truth.fit.values[f.name] - problem.values[f.name])) for f in free)
    usual = min((f.size / distance for f, distance in distances if distance), default=ENLARGED)
    return all(_is_imitated(search, truth, adapted, times) for times in (1.0, max(ENLARGED, usual)))


def _own(h: Hypothesis) -> tuple[str, ...]:
    """Return the parameters of a hypothesis' candidates."""
    return tuple(n for c in h.candidates for n in c.parameters)


def _is_imitated(search: Search, truth: Hypothesis, adapted: Hypothesis, times: float) -> bool:
    """Return True if a hypothesis can adapt to the predictions of another one, both with enlarged effects."""
    given = {**truth.fit.values, **{n: search.problem.values[n] for n in _own(truth)}}
    for both_signs in (True, False):  # an FMU may fail with inputs of a sign that it never gets
        course = _Course.exciting(search.problem, min(times, ENLARGED), both_signs=both_signs)
        wanted, without = course.outputs(given | _enlarged(truth, search.problem, times)), course.outputs(given)
        if np.isfinite(wanted).all() and np.isfinite(without).all():
            break
    effect = float(np.linalg.norm((wanted - without) / course.sigma))
    if not 0.0 < effect < np.inf:
        return False
    free = search.free(adapted.candidates)
    scale = course.sigma * effect * EQUIVALENT
    priors = [(k, *f.prior) for k, f in enumerate(free) if f.prior]
    start = given | _enlarged(adapted, search.problem, times)

    def residuals(theta: Array) -> Array:
        """Return differences of predictions, and pulls of tolerances."""
        values = start | {f.name: float(v) for f, v in zip(free, theta, strict=True)}
        errors = np.nan_to_num((course.outputs(values) - wanted) / scale, nan=1e9, posinf=1e9, neginf=-1e9)
        return np.concatenate([errors.ravel(), [PULL * (theta[k] - mean) / sigma for k, mean, sigma in priors]])

    from scipy.optimize import least_squares

    low, high = np.array([f.low for f in free]), np.array([f.high for f in free])
    margin = np.where(np.isfinite(high - low), 1e-9 * (high - low), 0.0)
    begin = np.clip([start[f.name] for f in free], low + margin, high - margin)
    sizes = np.array([f.size for f in free])
    done = least_squares(residuals, begin, bounds=(low, high), x_scale=sizes, max_nfev=EVALUATIONS)
    errors, pulls = np.split(done.fun, [wanted.size])
    before = sum((given[free[k].name] - mean) ** 2 / sigma**2 for k, mean, sigma in priors)
    return bool(np.linalg.norm(errors) < 1.0 and pulls @ pulls < PULL**2 * (before + WITHIN**2))


def _enlarged(h: Hypothesis, problem: Problem, times: float) -> dict[str, float]:
    """Return the parameters of the candidates with enlarged effects, within their limits; shapes stay."""
    values = {}
    for c in h.candidates:
        for f in c.free:
            value, given = h.fit.values[f.name], problem.values[f.name]
            if c.kind == "parameter" or f.neutral is not None:
                further = given + times * (value - given)
                keeps_sign = value * given <= 0.0 or further * given > 0.0
                value = further if keeps_sign else given * (value / given) ** times
            values[f.name] = min(max(value, f.low), f.high)
    return values


@dataclass(frozen=True)
class _Course:
    """Simulations from the start of the first log along inputs.

    Attributes:
        sigma: Standard deviation of the noise of each output.
    """

    problem: Problem
    data: Data
    sigma: Array

    @classmethod
    def exciting(cls, problem: Problem, times: float, *, both_signs: bool) -> _Course:
        """Return simulations along levels of random duration over the ranges of the inputs in the logs.

        Args:
            times: Factor on the ranges.
            both_signs: Let inputs with one sign have the other one, too, since a threshold at zero shows there only.
        """
        first = problem.logs[0].rows(0, MOST_ROWS)
        rng, rows = np.random.default_rng(SEED), len(first.u)
        u = np.empty_like(first.u)
        for k in range(u.shape[1]):
            columns = [d.u[:, k] for d in problem.logs]
            low, high = min(c.min() for c in columns), max(c.max() for c in columns)
            middle, half = 0.5 * (low + high), 0.5 * times * (high - low) or 0.1 * abs(high) or 1.0
            holds = np.exp(rng.uniform(0.0, np.log(max(2.0, LONGEST_HOLD * rows)), rows)).astype(int)
            if both_signs and abs(middle) > half:
                middle, half = 0.0, abs(middle) + half
            u[:, k] = np.repeat(middle + half * rng.uniform(-1.0, 1.0, rows), holds)[:rows]
        return cls(problem, replace(first, u=u, late=None), np.exp(0.5 * problem.plain.sensors))

    def outputs(self, values: Mapping[str, float]) -> Array:
        """Return the noise-free readings, shape (rows, outputs); NaN if the FMU fails."""
        problem = self.problem
        p, state = problem.numbers(problem.of_log(values, 0)), problem.start(values, 0)[0]
        lags = problem.in_rows(problem.lagging, values, 0)
        columns = range(self.data.y.shape[1])
        try:
            run = problem.kernel.simulate(self.data, p, state, np.zeros(problem.layout.memory))
        except (FmuError, SimulationError):
            return np.full(self.data.y.shape, np.nan)
        return lagged_table(run.outputs, np.array([lags.get(k, 0.0) for k in columns]))
