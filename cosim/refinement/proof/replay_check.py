"""Comparison of a verdict with replays of the estimation logs, which may change the claim or its grade."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from operator import itemgetter
from types import MappingProxyType

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.fit import Fit
from cosim.estimation.noise_model import Noise
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import WIDTHS
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import Log
from cosim.refinement.decision.claims import (
    Claims,
    Doubt,
    MovedParameter,
    Nearest,
    Part,
    alike_groups,
    experiment_for,
    name_of,
)
from cosim.refinement.decision.equivalence import split_alike
from cosim.refinement.decision.evidence import sum_per_scatter
from cosim.refinement.decision.judgement import (
    BETTER,
    RIVAL,
    SIGNIFICANT,
    is_beyond_tolerance,
    is_outside_tolerance,
)
from cosim.refinement.proof.measure import (
    FLOOR_SEED,
    Floor,
    errors_by_replay,
    noise_floor,
    predicted_errors,
)
from cosim.refinement.proof.refined_models import Variant, log_noise, refined_subject, variant_of, variants_of
from cosim.refinement.search.fits import Search, SearchResult
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.study import Study
from cosim.residuals.residual_statistics import COUNTS_FROM, remaining_excess

PART = 0.1  # remaining share of the excess error from which a claim explains only a part
HALF = 0.5  # share of excess error that withdraws a claim (best channel), leaves a part (sealed), and is always judged
UNSURE = 2.0  # increase of replay errors per scatter, below which it is not significant

Channels = Mapping[str, float]  # measured output → root mean square
ErrorOf = Mapping[str, Channels]  # replays before, recalibrated and after → errors


def check_with_replays(study: Study, a: Attribution, claims: Claims, result: SearchResult, problem: Problem) -> Claims:
    """Return the claims, changed or withdrawn if replays of the logs contradict the verdict."""
    is_within, judged = not beyond_tolerance(a.base.fit), claims.name
    if judged == "no_effect":
        error, floor = _replay_errors(study, a, claims, problem, result.free_noise)
        ratios = errors_per_floor(error["before"], floor.level)
        if ratios and not (is_within and not errors_per_floor(error["recalibrated"], floor.level)):
            claims = claim_single_number(claims, a, study.subject, result, ratios)
    elif judged == "parameter_error":
        claims = _beyond_tolerance_checked(claims, a, study, result)
    if claims.claimed is None:
        return claims
    error, floor = _replay_errors(study, a, claims, problem, result.free_noise)
    if judged == "no_effect" and (doubt := _error_doubt(error, floor.level)):
        return claims.withdraw(doubt)
    alternative = _alternative(study, a, claims, claims.claimed, problem)
    claims = check_claim(
        claims,
        error,
        floor.level,
        a.support,
        largest=floor.largest,
        alternative=alternative,
        halves=a.halves_error,
    )
    if claims.claimed is None or claims.claimed.is_of_sensors or claims.further:
        return claims
    return _with_further(claims, beyond_tolerance(claims.claimed.fit), study.settings.tolerance)


def _with_further(claims: Claims, further: tuple[MovedParameter, ...], stated: Mapping[str, float]) -> Claims:
    """Return the claims with base parameters outside their tolerances, as a part if the study states one of these."""
    is_left = any(m.name in stated for m in further) and claims.grade == "claimed"
    return replace(claims, further=further, grade="part" if is_left else claims.grade)


def _beyond_tolerance_checked(claims: Claims, a: Attribution, study: Study, result: SearchResult) -> Claims:
    """Return a claim on parameters, as a single number or with all others that left their tolerance."""
    others = beyond_tolerance(claims.claimed.fit) if claims.claimed else ()
    if not others:
        return claims
    otherwise = claim_single_number(claims, a, study.subject, result, {})
    return otherwise if otherwise.claimed is not None else replace(claims, further=others)


def _alternative(study: Study, a: Attribution, claims: Claims, claimed: Hypothesis, problem: Problem) -> str:
    """Return the variant than which a claim must be nearer to the logs on some channel; "" for none.

    Sensor errors keep the equations of the given model. Effects add to the recalibrated one, if its parameters are
    within their tolerances. For an FMU, the replays without them count only if they are nearer beyond their scatter.
    """
    probed = study.subject.probed
    if claimed.is_of_sensors:
        return "before" if probed else ""
    if beyond_tolerance(a.base.fit) or "effect" not in {c.kind for c in claimed.candidates}:
        return ""
    if not probed:
        return "recalibrated"
    variants = _variants(study, a, claims)
    after, without = (errors_by_replay(variants[name], problem, study.logs) for name in ("after", "recalibrated"))
    return "recalibrated" if _is_clearly_worse(after, without) else ""


def _variants(study: Study, a: Attribution, claims: Claims) -> dict[str, Variant]:
    """Return the variants before, recalibrated and after."""
    subject, settings = study.subject, study.settings
    return variants_of(subject, settings, a, claims.claimed, refined_subject(subject, settings, claims.claimed))


def _replay_errors(
    study: Study, a: Attribution, claims: Claims, problem: Problem, free: Noise | None
) -> tuple[ErrorOf, Floor]:
    """Return replay errors and their noise floor."""
    variants = _variants(study, a, claims)
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    quiet = replace(variants["after"], noise=log_noise((claims.claimed or a.base).fit.noise, free))
    return error, noise_floor(quiet, problem, study.logs, np.random.default_rng(FLOOR_SEED))


# -- Check of a claim --------------------------------------------------------------------------


def check_claim(
    claims: Claims,
    error: ErrorOf,
    floor: Channels,
    support: Mapping[str, Support] = MappingProxyType({}),
    *,
    largest: Channels = MappingProxyType({}),
    alternative: str = "",
    halves: bool = False,
) -> Claims:
    """Return the claims, graded or withdrawn according to replays.

    A term that reduces innovations one row ahead may still be wrong; only replays show the difference.

    Args:
        largest: Channel → largest error of the model against itself, as of an unstable motion. A smaller error is not
            judged if at most HALF of the excess remains.
        alternative: Variant than which the claim must be nearer to the logs on some channel; "" for none.
        halves: True if the claim halves the error on held-out logs. It is then at least a part of the answer.
    """
    if claims.claimed is None:
        return claims
    doubt = _doubt(claims.claimed, error, floor, alternative)
    if doubt and not halves:
        return claims.withdraw(doubt)
    if claims.name == "ambiguous" or claims.grade != "claimed":
        return claims
    shares, unjudged = _judged_excess(error, floor, {} if doubt else largest)
    worst, share = max(shares.items(), key=itemgetter(1), default=("", 0.0))
    if share <= PART:
        return replace(claims, unjudged=unjudged) if unjudged else claims
    weak = () if halves else _weak_parts(claims.claimed, support)
    if weak:
        return claims.withdraw(Doubt("unsteady", names=weak))
    return replace(claims, grade="part", part=Part(worst, share))


def _judged_excess(error: ErrorOf, floor: Channels, largest: Channels) -> tuple[dict[str, float], str]:
    """Return the remaining excess error of each judged channel, and the name of another channel, or ""."""
    after, shares = error["after"], _remaining_excess(error, floor)
    unjudged = [n for n, share in shares.items() if PART < share <= HALF and after[n] <= largest.get(n, 0.0)]
    return {n: share for n, share in shares.items() if n not in unjudged}, next(iter(unjudged), "")


def check_on_sealed_logs(claims: Claims, floor: Channels) -> Claims:
    """Return the claims, as a part of the answer if most of a channel's excess error on sealed logs remains.

    Nothing is withdrawn or chosen, as the logs stay a test.

    Args:
        claims: Claims with the improvement on sealed logs.
        floor: Noise floors of the sealed logs; a channel without one is not judged.
    """
    if claims.claimed is None or claims.name == "ambiguous" or claims.grade != "claimed" or claims.improvement is None:
        return claims
    judged = {name: share for name, share in claims.improvement.remaining.items() if name in floor}
    worst, share = max(judged.items(), key=itemgetter(1), default=("", 0.0))
    if share <= HALF:
        return claims
    nearest = Nearest(claims.claimed, moved_beyond_tolerance(claims.claimed.fit))
    return replace(claims, grade="part", part=Part(worst, share, sealed=True), nearest=nearest)


def with_miss_of_rivals(
    study: Study, claims: Claims, problem: Problem, sealed: Sequence[Log], error: Channels, floor: Channels
) -> Claims:
    """Return ambiguous claims with the least miss on sealed logs, if every rival misses a channel.

    Args:
        error: Errors of the claimed hypothesis in replays of the sealed logs.
        floor: Their noise floors.
    """
    if not claims.others:
        return claims
    subject, settings = study.subject, study.settings
    variants = (variant_of(refined_subject(subject, settings, h), settings, h.fit) for h in claims.others)
    misses = []
    for errors in chain([error], (predicted_errors(v, problem, sealed) for v in variants)):
        if not (ratios := errors_per_floor(errors, floor)):
            return claims
        misses.append(max(ratios.items(), key=itemgetter(1)))
    return replace(claims, missed=dict([min(misses, key=itemgetter(1))]))


def _is_clearly_worse(after: Array, before: Array) -> bool:
    """Return True if replays with a claim are worse than without, beyond their scatter.

    Replays of small effects tell less than innovations, and a few windows dominate a mean square. So the logarithms of
    the errors of each replay are compared.

    Args:
        after, before: Errors, shape (replays, outputs).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.log(before / after)
    return sum_per_scatter(ratios[np.isfinite(ratios).all(axis=1)].mean(axis=1)) < -UNSURE


def _weak_parts(claimed: Hypothesis, support: Mapping[str, Support]) -> tuple[str, ...]:
    """Return the parts that do not clearly improve predictions of held-out logs."""
    return tuple(n for n in claimed.names if n in support and support[n].predicted < BETTER)


def _error_doubt(error: ErrorOf, floor: Channels) -> Doubt | None:
    """Return a doubt about a claim without effects if replays miss a channel by far; else None."""
    worst, times = max(errors_per_floor(error["after"], floor).items(), key=itemgetter(1), default=("", 0.0))
    return Doubt("missed", worst, times) if worst else None


def _doubt(claimed: Hypothesis, error: ErrorOf, floor: Channels, alternative: str) -> Doubt | None:
    """Return a doubt if a claim is nearer on no channel, or if most excess error remains; else None."""
    if alternative and floor and all(error["after"][n] >= error[alternative][n] for n in floor):
        return Doubt("no_nearer")
    if claimed.is_of_sensors:
        return _error_doubt(error, floor)
    least = min(_remaining_excess(error, floor).values(), default=0.0)
    return Doubt("kept", size=least) if least > HALF else None


def _remaining_excess(error: ErrorOf, floor: Channels) -> dict[str, float]:
    """Return the remaining excess error of each channel."""
    shares = {n: remaining_excess(error["before"][n], error["after"][n], f) for n, f in floor.items()}
    return {n: x for n, x in shares.items() if not math.isnan(x)}


# -- Check that nothing is missing ----------------------------------------------------------------


def claim_single_number(
    claims: Claims, a: Attribution, subject: Subject, result: SearchResult, ratios: Channels
) -> Claims:
    """Return a claim of a single parameter or input gain that explains the logs by itself.

    All other parameters must stay within their tolerances. If the logs do not separate several such claims, the best is
    claimed until an experiment separates them.

    Args:
        ratios: Channel → error of the given model as a multiple of the noise floor.
    """
    misfit, hypotheses = claims.misfit, _single_errors(result, a.base)
    if hypotheses:
        best, *others = hypotheses
        rivals, alike = split_alike(result.search, best, others)
        groups, names = alike_groups(alike), tuple(n for h in (best, *rivals) for n in h.names)
        if not rivals:
            return Claims(name_of(best.candidates, subject), best, misfit=misfit, grade="claimed", alike=groups)
        experiment = experiment_for(subject, names)
        return Claims(
            "ambiguous", best, names, experiment, misfit, claims.grade, apart=names, alike=groups, others=rivals
        )
    worst = max(ratios.items(), key=itemgetter(1), default=("", 0.0))
    return Claims("unexplained", misfit=misfit, missed_channel=worst, recalibrated=moved_beyond_tolerance(a.base.fit))


def _single_errors(result: SearchResult, base: Hypothesis) -> list[Hypothesis]:
    """Return hypotheses of a single wrong number, best first."""
    search = result.search
    single = [c for c in result.candidates if c.kind == "parameter" or c.gain]
    # Fits start from stated values: a fit from recalibrated values would have to follow a ridge of shared effects.
    stated = [search.hypothesis((c,), replace(base.fit, values=search.problem.values)) for c in single]
    earlier = [h for c in single if (h := search.tried.get((c.name,))) and h.ended]
    best = {h.names: h for h in sorted((*stated, *earlier), key=lambda h: -h.score)}
    off = sorted((h for h in best.values() if _is_only_error(search, h)), key=lambda h: h.score)
    return [h for h in off if h is off[0] or h.score - off[0].score < RIVAL]


def _moved_parameters(f: Fit, names: Sequence[str]) -> tuple[MovedParameter, ...]:
    """Return the named base parameters with their stated and their fitted values."""
    return tuple(MovedParameter(x.name, x.prior[0], f.values[x.name]) for x in f.free if x.prior and x.name in names)


def _is_only_error(search: Search, h: Hypothesis) -> bool:
    """Return True if only the hypothesis' parameter is off."""
    (c,) = h.candidates
    if beyond_tolerance(h.fit):
        return False
    if c.kind == "parameter":
        return is_outside_tolerance(search, h, c)
    return h.is_away(c, SIGNIFICANT, search.problem.values)


def moved_beyond_tolerance(f: Fit) -> tuple[MovedParameter, ...]:
    """Return the base parameters whose estimates, not necessarily their intervals, lie outside their tolerances."""
    priors = {x.name: x.prior for x in f.free if x.prior and not x.group}
    return _moved_parameters(f, [n for n, (mean, sd) in priors.items() if abs(f.values[n] - mean) > WIDTHS * sd])


def beyond_tolerance(f: Fit) -> tuple[MovedParameter, ...]:
    """Return base parameters whose intervals lie outside their tolerances."""
    names = [x.name for x in f.free if x.prior and not x.group and is_beyond_tolerance(f, x.name, x.prior)]
    return _moved_parameters(f, names)


def errors_per_floor(error: Channels, floor: Channels) -> dict[str, float]:
    """Return channel → error as a multiple of its floor."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
