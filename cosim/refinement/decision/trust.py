"""Comparison of fits with free unknown inputs and fits with trusted equations.

A free unknown input absorbs every one-step prediction error, for example an input that was not held between two rows or
an unmodelled fast mode. The parameters then fit the next row, and slow effects, visible over the model's own horizon,
have little weight. If a fit without unknown inputs predicts clearly better in open loop, the search is repeated without
them. The residual is then not white, and the cost of every candidate is scaled by the dispersion of the likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat

from cosim.estimation.posing import coarsen, with_equations_trusted
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.scatter import log_error, noise_gains, unknown_input_gain
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.search.fits import Progress, Search, SearchResult
from cosim.refinement.search.hypotheses import Hypothesis

MOST_TERMS = 2  # candidates that free runs of an FMU may name; more imitate together what no term describes
CLEARLY = 0.05  # improvement of the log error of open-loop predictions from which one way is better


def attribute(subject: Subject, problem: Problem, candidates: Sequence[Candidate], progress: Progress) -> SearchResult:
    """Return the best hypothesis, with or without unknown inputs.

    Equations are trusted if open-loop predictions become clearly better.
    """

    def error(search: Search, h: Hypothesis) -> float:
        return log_error(search.problem, subject.horizon, repeat(h.fit))

    def score(r: SearchResult) -> float:
        noise = r.search.price * len(r.search.problem.limits.free)
        return float(r.best.fit.nll + r.search.cost(r.best.candidates) / r.search.problem.scatter + noise)

    result = Attributor(subject, problem, candidates, progress).run()
    if not any(gain > unknown_input_gain(problem) for gain in noise_gains(result.search.problem, result.best.fit)):
        return result
    progress("predicting with the equations trusted", 0.0)
    trusted = with_equations_trusted(subject, problem)
    free = error(result.search, result.best)
    # Unknown inputs in a filter over states explain slow effects, such as a drift, to a model judged by a free run.
    if math.isfinite(subject.horizon) or problem.layout.is_free_run:
        search = Search(subject, coarsen(trusted), len(candidates), progress)
        if error(search, search.hypothesis(result.best.candidates, result.best.fit)) > free - CLEARLY:
            return result
    other = Attributor(subject, trusted, candidates, progress).run()
    if error(other.search, other.best) > free - CLEARLY:
        return result
    # A fit without unknown inputs minimises the errors of free runs, so that it predicts its own logs better in any
    # case, and its candidates imitate a disturbance that unknown inputs explain: the likelihood must agree (BIC).
    if problem.layout.is_free_run and not (len(other.best.candidates) <= MOST_TERMS and score(other) < score(result)):
        return result
    return replace(other, free_noise=result.best.fit.noise)
