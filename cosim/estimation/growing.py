"""Fits of free runs to the first rows of all logs, then to more and more of them.

A free run that has left the motion of a log does not show which parameters would keep it there: large unknown inputs
explain the rest of the log, and a fit ends in a local optimum. In the first rows it has not left the motion yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.estimation.data import count_unscored
from cosim.estimation.fit import Fit, fit
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Free

FIRST, GROWTH = 2.0, 1.5  # rows of the first fit, in multiples of those that are not scored; their growth


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
    values, rows = start, FIRST * max(1, *(count_unscored(data) for data in problem.logs))
    while rows < max(len(data.u) for data in problem.logs):
        first = problem.first_rows(round(rows))
        values = fit(first, free, values, first.plain).values
        rows *= GROWTH
    return fit(problem, free, values, problem.plain)
