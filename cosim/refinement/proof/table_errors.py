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
from cosim.refinement.decision.evidence import fit_without, open_loop
from cosim.refinement.proof.replay_check import PART
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.subject.interface import Subject

FEWEST = 8  # rows below which neighbours are not informative
PLAIN = 3.0  # standard deviations of the neighbour correlation from which rows are alike
Channels = dict[str, float]


def errors_on_held_out_rows(search: Search, a: Attribution, claims: Claims) -> dict[str, Channels]:
    """Return model → output → RMSE on held-out rows."""
    models = {"before": None, "recalibrated": a.base, "after": claims.claimed}
    if claims.nearest is not None:
        models["nearest"] = claims.nearest_hypothesis
    return {name: _rmse(search, h) for name, h in models.items()}


def _rmse(search: Search, h: Hypothesis | None) -> Channels:
    """Return the RMSE of a hypothesis, None for the given model, on held-out rows."""
    problem, rows = search.problem, []
    for k in range(len(problem.logs)):
        given = replace(search.tried[()].fit, values=problem.values)
        fit = given if h is None else fit_without(search, problem, h, k)
        rows.append(open_loop(problem, search.subject.horizon, fit, k)[:, 0])
    return dict(zip(problem.layout.outputs, _root_mean_squares(np.vstack(rows)).tolist(), strict=True))


def add_dependence(claims: Claims, a: Attribution, problem: Problem, subject: Subject) -> Claims:
    """Return the claims with the output and input of a dependent table residual, if any."""
    dependence = _strongest_dependence(problem, a.best, subject)
    if dependence is None:
        return claims
    if claims.claimed is None:
        if claims.name == "unexplained":
            return replace(claims, left_of=dependence)
        return Claims("unexplained", misfit=claims.misfit, left_of=dependence)
    column = problem.layout.outputs.index(dependence[0])
    before, after = (_root_mean_squares(_residuals(problem, h))[column] for h in (a.base, claims.claimed))
    share = float(after**2 / before**2)
    if claims.name != "ambiguous" and share > PART:
        return replace(claims, grade="part", left_of=dependence, left_share=share)
    return replace(claims, left_of=dependence)


def _strongest_dependence(problem: Problem, h: Hypothesis, subject: Subject) -> tuple[str, str] | None:
    """Return the output and input of the strongest dependence of a residual, None without dependence.

    The statistic is Σ r_k·r_k+1 / Σ r² of the centred residual ranks in the order of the input. For noise, also of
    varying level, it is 0 ± 1/√n (Bartels 1982).
    """
    u, residuals = np.vstack([log.u for log in problem.logs]), _residuals(problem, h)
    largest: float = PLAIN
    strongest: tuple[str, str] | None = None
    for j, output in enumerate(problem.layout.outputs):
        rows = np.isfinite(residuals[:, j])
        for i, q in enumerate(subject.inputs):
            if rows.sum() < FEWEST or not np.ptp(u[rows, i]):
                continue
            e = residuals[rows, j][np.argsort(u[rows, i], kind="stable")]
            ranks = np.argsort(np.argsort(e, kind="stable"), kind="stable") - 0.5 * (e.size - 1)
            if (correlation := float(ranks[1:] @ ranks[:-1] / (ranks @ ranks)) * math.sqrt(e.size)) > largest:
                largest, strongest = correlation, (output, q.name)
    return strongest


def _residuals(problem: Problem, h: Hypothesis) -> Array:
    """Return the residual (measured − model) of every row of a table, shape (rows, outputs)."""
    return np.vstack([open_loop(problem, 0.0, h.fit, k)[:, 0] for k in range(len(problem.logs))])


def _root_mean_squares(residuals: Array) -> Array:
    """Return the root mean square of each column."""
    return np.asarray(np.sqrt(np.nanmean(residuals**2, axis=0)))
