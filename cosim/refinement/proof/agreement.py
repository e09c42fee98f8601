"""Agreement of a claim with a fit of its parameters to predictions over the model's own horizon.

A filter corrects its state at every row, so that its fit weighs the prediction of the next row most. With incomplete
equations, other parameters are best for predictions. The fit to predictions replaces the filter's if it predicts
held-out logs clearly better. Intervals then include the values of both. A part on which both fits disagree, or that one
of them puts within chance of no effect, is not claimed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cosim.estimation.fit import Fit
from cosim.estimation.parallel import in_parallel
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.claims import Claims, Doubt, fit_of_rest, is_moved, name_of
from cosim.refinement.decision.evidence import fit_without, log_error, with_intervals
from cosim.refinement.decision.judgement import may_be_chance
from cosim.refinement.decision.prediction_fit import (
    fit_to_others,
    fit_to_predictions,
    has_predictions,
    logs_to_leave_out,
)
from cosim.refinement.decision.trust import CLEARLY
from cosim.refinement.search.fits import Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis


def compare_with_predictions(search: Search, a: Attribution, claims: Claims) -> Claims:
    """Return the claims with the parameters that predict best, without parts on which filter and predictions disagree.

    The intervals of a partial claim include both values in any case: with incomplete equations, the difference between
    both fits is a measure of the bias. A claim that halves the held-out error keeps parts on which both fits disagree,
    unless the fit to predictions puts them, but not all parts, within chance of no effect.
    """
    problem, horizon, h = search.problem, search.subject.horizon, claims.claimed
    if h is None or h.is_of_sensors or not has_predictions(search):
        return claims
    is_better = _predicts_better(search, h)
    if not is_better and claims.grade == "claimed":
        return claims
    refit = fit_to_predictions(problem, h.fit, horizon, range(len(problem.logs)))
    both = _with_both(h, refit, refit.values if is_better else h.fit.values)
    if claims.name == "ambiguous":
        return replace(claims, claimed=both)
    moved = _moved_parts(claims, h.fit, refit) if is_better and not a.halves_error else set()
    predicted = replace(h, fit=replace(h.fit, values=refit.values))
    small = {c.name for c in h.candidates if may_be_chance(search, predicted, c)} - moved
    claims = replace(claims, claimed=both)
    return _without(search, a, claims, moved, small) if moved | small else claims


def _moved_parts(claims: Claims, before: Fit, after: Fit) -> set[str]:
    """Return the claimed candidates with a parameter that differs between both fits."""
    return {c.name for c in claims.claimed_candidates if any(is_moved(f, before, after) for f in c.free)}


def _without(search: Search, a: Attribution, claims: Claims, moved: set[str], small: set[str]) -> Claims:
    """Return the claims without parts on which both fits disagree, and without those that may be chance.

    If nothing is left, a claim that halves the held-out error is a part of the answer; another one is withdrawn.
    """
    rest, names = fit_of_rest(a, moved | small), tuple(sorted(moved))
    if rest is None and a.halves_error:
        return replace(claims, grade="part")
    if rest is None:
        return claims.withdraw(Doubt("disagreeing", names=names or tuple(sorted(small))))
    name, perhaps = name_of(rest.candidates, search.subject), (*claims.small, *sorted(small))
    rest = with_intervals(search, rest)
    return replace(claims, name=name, claimed=rest, grade="part", disagreeing=names, small=perhaps)


def _predicts_better(search: Search, h: Hypothesis) -> bool:
    """Return True if a fit to predictions clearly improves predictions of each held-out log, or half of a log."""
    problem, horizon = logs_to_leave_out(search.problem), search.subject.horizon
    logs = range(len(problem.logs))

    def gain(log: int) -> float:
        """Return the decrease of the log error on a held-out log."""
        before, after = fit_without(search, problem, h, log), fit_to_others(search, h, log)
        return log_error(problem, horizon, [before], [log]) - log_error(problem, horizon, [after], [log])

    gains = in_parallel(gain, list(logs))
    return bool(np.mean(gains) > CLEARLY and min(gains) > 0.0)


def _with_both(h: Hypothesis, refit: Fit, values: Mapping[str, float]) -> Hypothesis:
    """Return the hypothesis with these values, and intervals that include those of both fits."""
    sigmas = np.array([h.fit.sigma(f.name) for f in h.fit.free])
    moved = np.array([abs(refit.values[f.name] - h.fit.values[f.name]) for f in h.fit.free])
    wider = 1.0 + np.divide(moved / NORMAL_95, sigmas, out=np.zeros_like(sigmas), where=sigmas > 0.0)
    covariance = np.diag(sigmas**2) if h.fit.scattered is None else h.fit.scattered
    ends = {n: (*h.fit.regions[n], refit.values[n]) for n in h.fit.regions}
    regions = {n: (min(limits), max(limits)) for n, limits in ends.items()}
    return replace(h, fit=replace(h.fit, values=values, scattered=covariance * np.outer(wider, wider), regions=regions))
