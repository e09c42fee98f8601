"""Comparison of fits with free unknown inputs and fits with trusted equations.

A free unknown input absorbs every one-step prediction error, for example an input that was not held between two rows or
an unmodelled fast mode. The parameters then fit the next row, and slow effects, visible over the model's own horizon,
have little weight. If a fit without unknown inputs predicts clearly better in open loop, the search is repeated without
them. The residual is then not white, and the cost of every candidate is scaled by the ratio of the estimates' scatter
over blocks of time to the scatter for a white residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from cosim.estimation.fit import Fit
from cosim.estimation.posing import coarsened, with_equations_trusted
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import mean_log_error, open_loop
from cosim.refinement.decision.judgement import noise_gain
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.search.fits import Found, Progress, Search
from cosim.refinement.search.hypotheses import NOISE
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

CLEARLY = 0.05  # improvement of the log error of open-loop predictions from which one way is better


def attributed(subject: Subject, problem: Problem, candidates: Sequence[Candidate], progress: Progress) -> Found:
    """Return the best hypothesis, with or without unknown inputs.

    Equations are trusted if open-loop predictions become clearly better.
    """
    found = Attributor(subject, problem, candidates, progress).run()
    if not any(gain > NOISE for gain in noise_gain(found.search.problem, found.best.fit)):
        return found
    progress("predicting with the equations trusted", 0.0)
    trusted = with_equations_trusted(subject, problem)
    free = missed(found.search.problem, subject, found.best.fit)
    if math.isfinite(subject.horizon):  # A model judged by a free run skips this shortcut.
        search = Search(subject, coarsened(trusted), len(candidates), progress)
        likewise = search.hypothesis(found.best.candidates, found.best.fit)
        if missed(search.problem, subject, likewise.fit) > free - CLEARLY:
            return found
    other = Attributor(subject, trusted, candidates, progress).run()
    if missed(other.search.problem, subject, other.best.fit) > free - CLEARLY:
        return found
    return replace(other, heard=found.best.fit.noise.sensors)


def missed(problem: Problem, subject: Subject, f: Fit) -> float:
    """Return the mean log error of open-loop predictions."""
    return mean_log_error([open_loop(problem, subject.horizon, f.values, f, k) for k in range(len(problem.logs))])
