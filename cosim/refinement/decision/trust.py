"""Comparison of fits with free unknown inputs and fits with trusted equations.

A free unknown input absorbs every one-step prediction error, for example an input that was not held between two rows or
an unmodelled fast mode. The parameters then fit the next row, and slow effects, visible over the model's own horizon,
have little weight. If the best hypothesis or the base model predicts clearly better without unknown inputs, the search
is repeated without them; what only that search finds was chosen on all logs, and says nothing on the way. Its residual
is not white: the cost of every candidate is scaled by the dispersion of the likelihood. Likelihoods of the two ways
have no common scale; predictions of logs left out have, and decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.estimation.posing import coarsen, with_equations_trusted
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.bundle import held_out_errors, noise_gains, unknown_input_gain
from cosim.refinement.decision.posterior import CLEARLY
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.search.fits import Hypothesis, Progress, Search


def attribute(subject: Subject, problem: Problem, candidates: Sequence[Candidate], progress: Progress) -> Attributor:
    """Return the search with or without unknown inputs.

    Equations are trusted if open-loop predictions of logs left out become clearly better.
    """

    def error(search: Search, h: Hypothesis) -> float:
        return float(np.mean(held_out_errors(search, h, h.fit)))

    free = Attributor(subject, problem, candidates, progress).run()
    if not any(gain > unknown_input_gain(problem) for gain in noise_gains(free.problem, free.best.fit)):
        return free
    progress("predicting with the equations trusted", 0.0)
    given = {h.key: (h, error(free, h)) for h in (free.tried[frozenset()], free.best)}
    trusted = with_equations_trusted(subject, problem)
    search = Search(subject, coarsen(trusted), len(candidates), progress)
    if all(error(search, search.hypothesis(h.candidates, h.fit)) > least - CLEARLY for h, least in given.values()):
        return free
    other = Attributor(subject, trusted, candidates, progress).run()
    other.free_noise = free.best.fit.noise
    return other if error(other, other.best) < given[free.best.key][1] - CLEARLY else free
