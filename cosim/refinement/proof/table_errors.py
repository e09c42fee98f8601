"""Errors of tables on held-out rows, and dependence of table residuals on an input.

A table has no state equation and no unknown input. The residual of an output is noise if neighbours along each input
are no more alike than other rows. Otherwise the residual depends on an input in a way that no hypothesis explains.
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

FEWEST = 8  # rows below which neighbours are not informative
PLAIN = 3.0  # standard deviations of the neighbour correlation from which rows are alike
Channels = dict[str, float]


def errors_left_out(search: Search, a: Attribution, claims: Claims) -> dict[str, Channels]:
    """Return the RMSE on held-out rows."""
    given = _missed(search, None)
    found = {"before": given, "recalibrated": _missed(search, a.base)}
    found["after"] = _missed(search, claims.claimed) if claims.claimed else given
    return found if claims.nearest is None else {**found, "nearest": _missed(search, claims.near)}


def _missed(search: Search, h: Hypothesis | None) -> Channels:
    """Return a hypothesis' errors on held-out rows."""
    problem, rows = search.problem, []
    for k in range(len(problem.logs)):
        fit = search.tried[()].fit if h is None else learnt_without(search, problem, h, k)
        values = problem.values if h is None else fit.values
        rows.append(open_loop(problem, search.subject.horizon, values, fit, k)[:, 0])
    left = np.vstack(rows)
    sizes = np.sqrt(np.nanmean(left**2, axis=0)).tolist()
    return dict(zip(problem.layout.outputs, sizes, strict=True))


def with_leftover(claims: Claims, a: Attribution, problem: Problem, subject: Subject) -> Claims:
    """Return the claims with the remaining input dependence."""
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
    """Return the output and input of the strongest dependence.

    Statistic: Σ r_k·r_k+1 / Σ r² of the centred residual ranks in the order of the input; for noise 0 ± 1/√n, also for
    noise of varying level (Bartels 1982).
    """
    u, left = np.vstack([log.u for log in problem.logs]), _compute_residuals(problem, h)
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


def _compute_residuals(problem: Problem, h: Hypothesis) -> Array:
    """Return measured − model of every row, shape (rows, outputs)."""
    return np.vstack([open_loop(problem, 0.0, h.fit.values, h.fit, k)[:, 0] for k in range(len(problem.logs))])


def _sizes(problem: Problem, h: Hypothesis) -> Array:
    """Return the root mean square residual of each output."""
    return np.asarray(np.sqrt(np.nanmean(_compute_residuals(problem, h) ** 2, axis=0)))
