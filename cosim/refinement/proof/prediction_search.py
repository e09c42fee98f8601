"""Search for the model that predicts best over the horizon, if the fits of the filter support no claim.

The filter corrects its state at every row, and an estimated unknown input imitates slow effects. Several small effects
then gain less than they cost, although predictions over the model's own horizon need them. This search adds candidates
one by one (forward stepwise), fits all parameters to predictions, and drops candidates that do not help on every log.
Sealed logs are not used, and the search changes no claim.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import least_squares, orthonormal
from cosim.estimation.fit import Fit
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Problem
from cosim.estimation.screen import SHARE
from cosim.refinement.decision.claims import Claims, Nearest, Rung
from cosim.refinement.decision.trust import CLEARLY
from cosim.refinement.proof.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.proof.nearest import is_as_good, nearest
from cosim.refinement.proof.prediction_windows import Prediction, Windows, median_errors
from cosim.refinement.proof.refined_models import refined_subject, variant_of
from cosim.refinement.proof.replay_check import errors_per_floor, moved_beyond_tolerance
from cosim.refinement.search.attribution import HOPE
from cosim.refinement.search.fits import Search, key_of
from cosim.refinement.search.hypotheses import Attribution, Hypothesis
from cosim.refinement.study import Study
from cosim.subject.candidates import Candidate, Free

LEAST_PARTS = 3  # number of parts of the logs below which there is no standard error
TRIED = 3  # most promising candidates fitted in each round
QUICK = 3  # largest number of Jacobians of a fit that only ranks
ROUNDS = 6  # largest number of added candidates
ONLY_PREDICTIONS = "only fits to predictions support it"
IDLE = 2  # candidates added without a better prediction of left-out parts, after which the search ends


def search_nearest(
    study: Study, claims: Claims, a: Attribution, problem: Problem, search: Search, candidates: Sequence[Candidate]
) -> Claims:
    """Return the claims with the nearest model of this search, if nothing is claimed and it predicts clearly better.

    The model must predict held-out parts of each log better than the nearest model so far predicts the logs that its
    fit includes.

    Args:
        problem: Problem for replays of the logs.
        search: Search of the filter, with its problem.
    """
    if not _is_applicable(study, claims, search.problem):
        return claims
    windows = Windows.of(search.problem, study.subject.horizon)
    if len(windows.groups) < LEAST_PARTS or not _is_far_from_noise(study, claims, a, problem):
        return claims
    rungs = ladder_by_predictions(search, windows, a, candidates)
    h = nearest(rungs) if rungs else None
    if h is None or not set(h.names) - set(claims.nearest.names if claims.nearest else ()):
        return claims
    before = windows.errors(_nearest_fit(claims, a))
    gains = windows.by_log([windows.log_errors(before, k) for k in range(len(windows.groups))])
    gains -= next(rung.errors for rung in rungs if rung.hypothesis is h)
    if not (np.mean(gains) > CLEARLY and np.min(gains) > 0.0):
        return claims
    return replace(claims, ladder=tuple(rungs), nearest=Nearest(h, moved_beyond_tolerance(h.fit), ONLY_PREDICTIONS))


def _is_applicable(study: Study, claims: Claims, problem: Problem) -> bool:
    """Return True for `unexplained` without a claim, if all logs have a horizon and one set of values."""
    has_predictions = math.isfinite(study.subject.horizon) and not (problem.table or problem.own)
    return has_predictions and claims.name == "unexplained" and claims.claimed is None


def _nearest_fit(claims: Claims, a: Attribution) -> Fit:
    """Return the fit of the nearest model so far."""
    return claims.nearest_hypothesis.fit if claims.nearest_hypothesis else a.unfitted


def _is_far_from_noise(study: Study, claims: Claims, a: Attribution, problem: Problem) -> bool:
    """Return True if replays of the nearest model miss an output by far more than sensor noise explains.

    The floor contains no unknown input, because that may be the missing effect.
    """
    subject = refined_subject(study.subject, study.settings, claims.nearest_hypothesis)
    variant = variant_of(subject, study.settings, _nearest_fit(claims, a))
    noise = replace(variant.noise, power=problem.noise.smallest)
    random = np.random.default_rng(FLOOR_SEED)
    floor = noise_floor(replace(variant, noise=noise), problem, study.logs, random).level
    return bool(errors_per_floor(predicted_errors(variant, problem, study.logs), floor))


def ladder_by_predictions(
    search: Search, windows: Windows, a: Attribution, candidates: Sequence[Candidate]
) -> list[Rung]:
    """Return the errors of predictions of held-out parts, from the given model to more and more candidates.

    Without a candidate that decreases the objective, there is no ladder.
    """
    effects = [c for c in candidates if c.kind != "parameter"]  # base parameters are free in every fit
    scale = median_errors(windows.errors(a.base.fit))
    path = [_prediction(search, windows, a.base.fit, (), scale).fitted()]
    errors = [path[0].held_out_errors()]
    while len(path) <= ROUNDS and len(path) - 1 - int(np.argmin([np.mean(e) for e in errors])) < IDLE:
        larger = _extended(search, path[-1], effects)
        if larger is None:
            break
        path.append(larger)
        errors.append(larger.held_out_errors())
    if len(path) == 1:
        return []
    given = _prediction(search, windows, a.unfitted, (), scale, fixed=True).fitted()
    rungs = [Rung(None, given.held_out_errors())]
    rungs += [Rung(_hypothesis(search, p), e) for p, e in zip(path, errors, strict=True)]
    return _without_idle_parts(search, path, rungs)


def _prediction(
    search: Search, windows: Windows, at: Fit, parts: Sequence[Candidate], scale: Array, *, fixed: bool = False
) -> Prediction:
    """Return the candidates with start values of their fit.

    Args:
        fixed: Fit the unknown inputs alone.
    """
    problem, free = search.problem, () if fixed else tuple(search.free(tuple(parts)))
    kept = {x.name: at.values[x.name] for x in free if x.name in at.values}
    places = problem.limits.free[problem.limits.free < len(at.noise.power)]
    return Prediction(windows, tuple(parts), replace(at, free=free, values={**problem.values, **kept}), places, scale)


def _hypothesis(search: Search, p: Prediction) -> Hypothesis:
    """Return a prediction as a hypothesis, with the likelihood and the information of its fit."""
    information = p.jacobian.T @ p.jacobian
    by_log = search.problem.score(p.fit.values, p.fit.noise).by_log
    fit = replace(p.fit, information=information, nll_by_log=by_log, penalty=0.0, scattered=None)
    return Hypothesis(p.candidates, fit, fit.objective + search.cost(p.candidates))


def _extended(search: Search, p: Prediction, candidates: Sequence[Candidate]) -> Prediction | None:
    """Return the prediction with the candidate that decreases the objective most; None if the decrease is too small."""
    tried = []
    for c, values in _promises(p, [c for c in candidates if c not in p.candidates])[:TRIED]:
        start = replace(p.fit, values={**p.fit.values, **values})
        larger = _prediction(search, p.windows, start, (*p.candidates, c), p.scale).fitted(QUICK)
        if larger.objective < p.required(len(c.free)):
            tried.append(larger)
    return min(tried, key=lambda larger: larger.objective).rescaled().fitted() if tried else None


def _promises(p: Prediction, candidates: Sequence[Candidate]) -> list[tuple[Candidate, Mapping[str, float]]]:
    """Return candidates with linear estimates of their parameters, most promising first.

    Candidates that promise too little, or whose estimates exceed their limits, are omitted.
    """
    values, theta, basis = p.fit.values, p.theta, orthonormal(p.jacobian * p.sizes)
    trials = [(c, move) for c in candidates for move in _moves(c, values)]

    def effect(trial: tuple[Candidate, Mapping[str, float]]) -> Array:
        moved = replace(p.fit, values={**values, **{n: values[n] + step for n, step in trial[1].items()}})
        row = p.weigh(p.windows.errors(moved), theta) - p.residuals
        return row - basis @ (basis.T @ row)

    rows = in_parallel(effect, trials)
    promises = []
    for c in candidates:
        own = [(move, row) for (other, move), row in zip(trials, rows, strict=True) if other is c]
        matrix = np.stack([row for _, row in own], axis=1)
        multiples = least_squares(matrix, -p.residuals, rcond=1e-6)
        gain = 2.0 * float(-p.residuals @ matrix @ multiples) - float(np.sum((matrix @ multiples) ** 2))
        estimates = {n: values[n] for n in c.parameters}
        for times, (move, _) in zip(multiples.tolist(), own, strict=True):
            estimates |= {n: estimates[n] + times * step for n, step in move.items()}
        if p.objective - HOPE * gain < p.required(len(c.free)) and all(_is_within(f, estimates) for f in c.free):
            promises.append((gain, c, estimates))
    return [(c, estimates) for _, c, estimates in sorted(promises, key=lambda entry: -entry[0])]


def _is_within(f: Free, estimates: Mapping[str, float]) -> bool:
    """Return True if an estimate respects its limits."""
    return max(f.low, estimates.get(f.above, f.low)) <= estimates[f.name] <= f.high


def _moves(c: Candidate, values: Mapping[str, float]) -> list[dict[str, float]]:
    """Return steps of a candidate's parameters towards its starts, jointly and one by one, or of their usual size."""
    moves = []
    for start in c.starts:
        steps = {n: SHARE * (v - values[n]) for n, v in start.items() if v != values[n]}
        moves += [steps] if steps else []
        moves += [{n: step} for n, step in steps.items()] if len(steps) > 1 else []
    moved = {n for move in moves for n in move}
    for f in c.free:
        if f.name not in moved:
            step = SHARE * f.size
            moves.append({f.name: step if values[f.name] + step <= f.high else -step})
    return moves


def _without_idle_parts(search: Search, path: Sequence[Prediction], rungs: list[Rung]) -> list[Rung]:
    """Return the rungs with smaller sets: the nearest model without candidates that do not help on every log."""
    fitted = {key_of(p.candidates): p for p in path}
    h = nearest(rungs)
    while h is not None and len(h.names) > 1:
        own = next(rung.errors for rung in rungs if rung.hypothesis is h)
        smaller = list(_smaller(search, fitted[h.names], set(fitted)))
        errors = {key_of(p.candidates): p.held_out_errors() for p in smaller}
        as_good = [p for p in smaller if is_as_good(errors[key_of(p.candidates)] - own)]
        if not as_good:
            break
        p = min(as_good, key=lambda p: float(np.mean(errors[key_of(p.candidates)])))
        h = _hypothesis(search, p)
        fitted[h.names] = p
        rungs.append(Rung(h, errors[h.names]))
    return sorted(rungs, key=lambda rung: len(rung.hypothesis.names) if rung.hypothesis else -1)


def _smaller(search: Search, p: Prediction, known: Collection[tuple[str, ...]]) -> Iterator[Prediction]:
    """Yield the prediction without each of its candidates, fitted, except for known sets."""
    for rest in combinations(p.candidates, len(p.candidates) - 1):
        if key_of(rest) not in known:
            yield _prediction(search, p.windows, p.fit, rest, p.scale).fitted().rescaled().fitted()
