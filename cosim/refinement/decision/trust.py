"""Whether a model predicts better with its equations trusted than with unknown inputs free to explain what it misses.

An unknown input that is free follows whatever a row ahead can show: an input that was not quite held between two rows,
a fast mode that the model lacks. Then parameters are those that suit the next row, and slow effects, which show over
the model's own horizon, weigh little. Where a fit without unknown inputs predicts clearly better in open loop, the
search is made again without them. What is left is then far from white, and every candidate costs as many times more as
estimates scatter more from block to block of time than a white residual would let them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.fit import Fit
from cosim.estimation.posing import coarsened, with_equations_trusted
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import open_loop
from cosim.refinement.decision.judgement import noise_gain
from cosim.refinement.search.attribution import Attributor
from cosim.refinement.search.fits import Found, Progress, Search
from cosim.refinement.search.hypotheses import NOISE
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

CLEARLY = 0.05  # of the error of open-loop predictions, by which one way must be better


def attributed(subject: Subject, problem: Problem, candidates: Sequence[Candidate], progress: Progress) -> Found:
    """Return the best hypothesis with unknown inputs free, or with the equations trusted where that predicts better."""
    found = Attributor(subject, problem, candidates, progress).run()
    if not any(gain > NOISE for gain in noise_gain(found.search.problem, found.best.fit)):
        return found
    progress("predicting with the equations trusted", 0.0)
    trusted = with_equations_trusted(subject, problem)
    free = missed(found.search.problem, subject, found.best.fit)
    if math.isfinite(subject.horizon):  # a model that is judged by a free run is tried so in any case
        search = Search(subject, coarsened(trusted), len(candidates), progress)
        likewise = search.hypothesis(found.best.candidates, found.best.fit)
        if missed(search.problem, subject, likewise.fit) > free - CLEARLY:
            return found
    other = Attributor(subject, trusted, candidates, progress).run()
    if missed(other.search.problem, subject, other.best.fit) > free - CLEARLY:
        return found
    return replace(other, heard=found.best.fit.noise.sensors)


def missed(problem: Problem, subject: Subject, f: Fit) -> float:
    """Return logarithm of the error of open-loop predictions over the model's horizon, a mean over the outputs."""
    return size([open_loop(problem, subject.horizon, f.values, f, k) for k in range(len(problem.logs))])


def size(errors: Sequence[Array]) -> float:
    """Return mean over the outputs of the logarithm of the root mean square."""
    rows = np.concatenate([e.reshape(-1, e.shape[-1]) for e in errors])
    with np.errstate(invalid="ignore", divide="ignore"):
        sizes = 0.5 * np.log(np.nanmean(rows**2, axis=0))
    sizes = sizes[np.isfinite(sizes)]
    return float(np.mean(sizes)) if sizes.size else math.inf
