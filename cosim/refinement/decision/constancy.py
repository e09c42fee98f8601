"""Constancy of claimed parameters: their estimates from rows in which they act weakly, and strongly.

A term of the right shape has the same coefficient in all rows. In the place of another one, for example a stiffness in
that of a play, its coefficient depends on how much the term acts. The rows are ordered by the sensitivity of their
predictions to the parameter. If the claim is right, the scores of the parameter, without what the other free numbers
explain, have no trend along this order (Andrews 1993, Econometrica 61:821; Zeileis and Hornik 2007, Statistica
Neerlandica 61:488).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.estimation.fit import Fit, Slopes, inverse, slopes
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Candidate, Free
from cosim.refinement.decision.claims import Claims, Doubt, fit_of_rest, name_of
from cosim.refinement.decision.evidence import BY_CHANCE, blocks_of, sum_by_block, with_intervals
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution

SHARES = 3  # groups of rows with equal information, of which the first and the last are compared
VARIES = 0.1  # difference of both estimates, relative to the change from the model's value, from which it counts


@dataclass(frozen=True)
class Constancy:
    """Estimates of a parameter from the rows in which it acts least and most, a third of the information each.

    Attributes:
        chance: Probability of as large a trend over the rows by chance.
    """

    name: str
    weak: float
    strong: float
    chance: float


def check_constancy(search: Search, a: Attribution, claims: Claims) -> Claims:
    """Return the claims without base parameters that vary with their own effect; other varying parts are incomplete.

    Beside a missing term, a base parameter of the same equation often takes a part of its place. An effect or a sensor
    error that varies is at least the most similar one of the catalogue.
    """
    problem, h, parts = search.problem, claims.claimed, claims.claimed_candidates
    if h is None:
        return claims
    varying = varying_parameters(problem, h.fit, parts)
    if not varying:
        return claims
    first = min(varying.values(), key=lambda c: c.chance)
    doubt = Doubt("varying", names=(first.name,), estimates=(first.weak, first.strong))
    wrong = {c.name for c in parts if c.kind == "parameter" and c.name in varying}
    if claims.name == "ambiguous":
        certain = tuple(c for c in parts if c.name not in wrong)
        return replace(claims, certain=certain, grade="part" if certain else "nearest", varying=doubt)
    if not wrong:
        return replace(claims, grade="part", varying=doubt)
    rest = fit_of_rest(a, wrong)
    if rest is None:
        return claims.withdraw(doubt)
    name, rest = name_of(rest.candidates, search.subject), with_intervals(search, rest)
    return replace(claims, name=name, claimed=rest, grade="part", varying=doubt)


def varying_parameters(problem: Problem, f: Fit, parts: Sequence[Candidate]) -> dict[str, Constancy]:
    """Return candidate → its parameter with the least probable trend, for significant trends above VARIES.

    Only parameters with a value without effect, or of the model, are judged; the shape of a term is not.
    """
    judged = [(c, x) for c in parts for x in c.free if _is_judged(c, x) and not f.is_flat(x.name)]
    if not judged:
        return {}
    at_fit = slopes(problem, f)
    block = blocks_of(problem, at_fit.scored, math.exp(f.noise.memory))
    places = {x.name: k for k, x in enumerate(f.free)}
    found: list[tuple[str, Constancy]] = []
    for c, x in judged:
        tested = constancy(x.name, at_fit, block, places[x.name], f.values[x.name])
        change = f.values[x.name] - (problem.values[x.name] if x.neutral is None else x.neutral)
        if tested.chance < BY_CHANCE / len(judged) and abs(tested.strong - tested.weak) > VARIES * abs(change):
            found.append((c.name, tested))
    return dict(sorted(found, key=lambda entry: -entry[1].chance))  # the least probable of a candidate is the last


def _is_judged(c: Candidate, x: Free) -> bool:
    """Return True for a size or a base parameter that all logs share, not for the shape of a term."""
    return not x.group and (x.neutral is not None or c.kind == "parameter")


def constancy(name: str, at_fit: Slopes, block: Rows, k: int, value: float) -> Constancy:
    """Return the test of one parameter, of index `k`, with an estimate."""
    from scipy.special import stdtr

    weights = inverse(at_fit.information)[k]
    weights = weights / weights[k]  # of the score without what the other free numbers explain
    gradient, error, log_variance = (weights @ by for by in (at_fit.gradients, at_fit.errors, at_fit.log_variances))
    variances = at_fit.scored.variances
    information = error**2 / variances + 0.5 * log_variance**2
    order = _order(at_fit, k, information)
    by_block = sum_by_block(block, gradient * (order - 0.5))
    scatter = float(np.std(by_block, ddof=1)) * math.sqrt(by_block.size)
    deviations = abs(float(by_block.sum())) / scatter if scatter > 0.0 else 0.0
    group = np.minimum((order * SHARES).astype(int), SHARES - 1)
    moved = np.bincount(group, gradient, SHARES) / np.maximum(np.bincount(group, information, SHARES), 1e-300)
    chance = 2.0 * float(stdtr(max(1, by_block.size - 1), -deviations))
    return Constancy(name, value - float(moved[0]), value - float(moved[-1]), chance)


def _order(at_fit: Slopes, k: int, information: Array) -> Array:
    """Return the place of each measurement between the weakest (0) and the strongest (1) action of a parameter.

    All measurements of a row have one place; places are shares of the information.
    """
    scored = at_fit.scored
    logs = np.repeat(np.arange(len(scored.counts)), scored.counts)
    _, row = np.unique(np.stack([logs, scored.rows]), axis=1, return_inverse=True)
    row = row.ravel()
    order = np.argsort(np.bincount(row, at_fit.errors[k] ** 2 / scored.variances), kind="stable")
    of_row = np.bincount(row, information)[order]
    place = np.empty(of_row.size)
    place[order] = (np.cumsum(of_row) - 0.5 * of_row) / (of_row.sum() or 1.0)
    return place[row]
