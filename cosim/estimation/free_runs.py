"""Free runs: start states, which the first readings show in part only, and fits to more and more rows.

A free run that has left the motion of a log does not show which parameters would keep it there: large unknown inputs
explain the rest of the log, and a fit ends in a local optimum. In the first rows it has not left the motion yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit, fit, initial_fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Free

ENOUGH = 0.5  # decrease of the negative log-likelihood of a log by the last estimate


def with_likely_starts(
    problem: Problem, values: Mapping[str, float] | None = None, noise: Noise | None = None
) -> Problem:
    """Return the problem with the start states of free runs that its logs make likely; others are unchanged.

    The filter is linear in the start states; this is its Gauss-Newton iteration.

    Args:
        values: Parameter values; None for those of the problem.
        noise: Levels of noise; None for likely ones.
    """
    given = {**problem.values, **(values or {})}
    for _ in problem.layout.states if problem.layout.start_places else ():  # more often than it needs
        level = noise or initial_fit(problem).noise
        x0 = [_next(problem, given, level, k) for k in range(len(problem.logs))]
        if all(after is before for after, before in zip(x0, problem.x0, strict=True)):
            break
        problem = replace(problem, x0=x0)
    return problem


def _next(problem: Problem, values: Mapping[str, float], noise: Noise, index: int) -> Array:
    """Return a likelier start of a log, the same array without one."""
    places, x0 = problem.layout.start_places, problem.x0[index]

    def objective(x: Array) -> float:
        starts = [*problem.x0[:index], x, *problem.x0[index + 1 :]]
        e, s = replace(problem, x0=starts).innovations(values, noise, index)  # of all rows, also those not scored
        with np.errstate(over="ignore", invalid="ignore"):
            nll = 0.5 * float(np.nansum(np.log(s) + e**2 / s))
        return nll if np.isfinite(nll) else np.inf

    moved, before = x0.copy(), objective(x0)
    moved[places] = problem.run(values, noise, index).states[-1][places]
    for each in (moved, 0.5 * (x0 + moved)):
        if np.isfinite(each).all() and objective(each) < before - ENOUGH:
            return each
    return x0


def leaves_the_motion(problem: Problem, at: Fit) -> bool:
    """Return whether free runs leave the logs' motion.

    Large unknown inputs then keep them at the logs.
    """
    return problem.layout.is_free_run and bool(np.any(at.noise.power > problem.noise.plain))


def fit_growing(problem: Problem, free: Sequence[Free], start: Mapping[str, float]) -> Fit:
    """Return a fit to all rows.

    It starts from the values of fits to fewer rows, with unknown inputs at a detectable level.

    Args:
        start: Start values of the parameters.
    """
    values, rows = start, 2 * max(1, *(count_unscored(data) for data in problem.logs))
    while rows < max(len(data.u) for data in problem.logs):
        first = problem.first_rows(rows)
        values = fit(first, free, values, first.plain).values
        rows *= 2
    return fit(problem, free, values, problem.plain)
