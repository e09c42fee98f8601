"""What a table says beside a verdict: errors on rows left out, and whether what is left goes with an input.

A table has no equation of a state in which something could act. What is left of an output is noise where neighbours
over an input are no more alike than others; else something goes with that input that no hypothesis says.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.problem import Problem
from cosim.refinement.decision.claims import Claims
from cosim.refinement.decision.evidence import learnt_without, open_loop
from cosim.refinement.proof.replay_check import PART
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.subject.interface import Subject

FEWEST = 8  # rows, below which neighbours tell nothing
PLAIN = 3.0  # standard deviations of their correlation, from which they are alike
Channels = dict[str, float]


def errors_left_out(search: Search, a: Attribution, claims: Claims) -> dict[str, Channels]:
    """Return the root mean square of each model and output on rows left out, fitted to the others."""
    given = _missed(search, None)
    found = {"before": given, "recalibrated": _missed(search, a.base)}
    found["after"] = _missed(search, claims.claimed) if claims.claimed else given
    return found if claims.nearest is None else {**found, "nearest": _missed(search, claims.near)}


def _missed(search: Search, h: Hypothesis | None) -> Channels:
    """Return the errors of one hypothesis; None: the model as it was given, of which nothing is fitted."""
    problem, rows = search.problem, []
    for k in range(len(problem.logs)):
        fit = search.tried[()].fit if h is None else learnt_without(search, problem, h, k)
        values = problem.values if h is None else fit.values
        rows.append(open_loop(problem, search.subject.horizon, values, fit, k)[:, 0])
    left = np.vstack(rows)
    sizes = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return dict(zip(problem.layout.outputs, sizes, strict=True))


def with_leftover(claims: Claims, a: Attribution, problem: Problem, subject: Subject) -> Claims:
    """Return the answer, and what of an output goes with an input beside the best hypothesis, where something does."""
    left = _leftover(problem, a.best, subject)
    if left is None:
        return claims
    if claims.claimed is None:
        if claims.name == "unexplained":
            return replace(claims, left_of=left)
        return Claims("unexplained", misfit=claims.misfit, left_of=left)
    column = problem.layout.outputs.index(left[0])
    kept = _sizes(problem, claims.claimed)[column] ** 2 / _sizes(problem, a.base)[column] ** 2
    if claims.name != "ambiguous" and kept > PART:
        return replace(claims, grade="part", left_of=left, left_share=float(kept))
    return replace(claims, left_of=left)


def _leftover(problem: Problem, h: Hypothesis, subject: Subject) -> tuple[str, str] | None:
    """Return output and input over which what is left goes most, where neighbours are plainly alike.

    By Σ r_k·r_k+1 / Σ r² of the ranks r of what is left, about their mean, in the order of the input: of noise it is
    0 ± 1/√n, be it larger here than there (Bartels 1982). A dozen rows are too few to tell.
    """
    u, left = np.vstack([log.u for log in problem.logs]), _left(problem, h)
    most: float = PLAIN
    found: tuple[str, str] | None = None
    for j, output in enumerate(problem.layout.outputs):
        seen = np.isfinite(left[:, j])
        for i, q in enumerate(subject.inputs):
            if seen.sum() < FEWEST or not np.ptp(u[seen, i]):
                continue
            e = left[seen, j][np.argsort(u[seen, i], kind="stable")]
            ranks = np.argsort(np.argsort(e, kind="stable"), kind="stable") - 0.5 * (e.size - 1)
            if (alike := float(ranks[1:] @ ranks[:-1] / (ranks @ ranks)) * math.sqrt(e.size)) > most:
                most, found = alike, (output, q.name)
    return found


def _left(problem: Problem, h: Hypothesis) -> Array:
    """Return measured − model of every row: rows, outputs."""
    return np.vstack([open_loop(problem, 0.0, h.fit.values, h.fit, k)[:, 0] for k in range(len(problem.logs))])


def _sizes(problem: Problem, h: Hypothesis) -> Array:
    """Return root mean square of what is left of each output."""
    return np.asarray(np.sqrt(np.nanmean(_left(problem, h) ** 2, axis=0)))
