"""Start states of free runs, which the first readings show in part only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.fit import initial_fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Problem

ROUNDS = 6  # estimates, each from slopes at the one before
SHARES = (1.0, 0.3, 0.1)  # of a step that makes the readings less likely
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
    if not problem.layout.start_places:
        return problem
    given = {**problem.values, **(values or {})}
    for _ in range(ROUNDS):
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

    estimated = problem.run(values, noise, index, states=True).states[-1][places]
    if not np.isfinite(estimated).all():
        return x0
    before = objective(x0)
    for share in SHARES:
        moved = x0.copy()
        moved[places] += share * (estimated - x0[places])
        if objective(moved) < before - ENOUGH:
            return moved
    return x0
