"""Comparison of a verdict with replays of the estimation logs, which may change the claim or its grade."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from types import MappingProxyType

import numpy as np

from cosim.base.arrays import Array
from cosim.estimation.fit import Fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.claims import Claims, Doubt, Moved, Part, experiment_for, name_of
from cosim.refinement.decision.judgement import BETTER, RIVAL, SIGNIFICANT, beyond, outside
from cosim.refinement.proof.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.proof.refined_models import of_noise, refined_subject, variants_of
from cosim.refinement.search.fits import Found, Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.study import Study
from cosim.residuals.residual_statistics import COUNTS_FROM, excess_left
from cosim.subject.base_parameters import WIDTHS
from cosim.subject.interface import Subject

PART = 0.1  # remaining share of the excess error from which a claim explains only a part
HALF = 0.5  # remaining share of the excess error on the best channel from which a claim is withdrawn

Channels = Mapping[str, float]  # measured output → root mean square
ErrorOf = Mapping[str, Channels]  # replays before, recalibrated and after → errors


def held_against_replays(study: Study, a: Attribution, claims: Claims, found: Found, problem: Problem) -> Claims:
    """Compare the verdict with replays of the logs."""
    is_within, is_single = not _beyond(a.base.fit), False
    if claims.name == "no_effect":
        error, floor = _replay_errors(study, a, claims, problem, found.sensors)
        if missed := _missed(error["before"], floor):
            if not is_within or _missed(error["recalibrated"], floor):
                claims = single_number(claims, a, study.subject, found, missed)
            is_single = True
    elif claims.name == "parameter_error" and claims.claimed and (others := _beyond(claims.claimed.fit)):
        otherwise = single_number(claims, a, study.subject, found, {})
        further = _moved(claims.claimed.fit, others)
        claims = otherwise if otherwise.claimed is not None else replace(claims, further=further)
    if claims.claimed is None:
        return claims
    error, floor = _replay_errors(study, a, claims, problem, found.sensors)
    if is_single and (doubt := _still_missed(error, floor)):
        return claims.withdrawn(doubt)
    return checked_claim(claims, error, floor, a.support, recalibrated=is_within)


def _replay_errors(
    study: Study, a: Attribution, claims: Claims, problem: Problem, heard: Array | None
) -> tuple[ErrorOf, Channels]:
    """Return replay errors and their noise floor."""
    subject, settings = study.subject, study.settings
    refined = refined_subject(subject, settings, claims.claimed)
    variants = variants_of(subject, settings, a, claims.claimed, refined)
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    quiet = of_noise(variants["after"], a, claims.claimed, heard)
    return error, noise_floor(quiet, problem, study.logs, np.random.default_rng(FLOOR_SEED)).level


# -- Check of a claim --------------------------------------------------------------------------


def checked_claim(
    claims: Claims,
    error: ErrorOf,
    floor: Channels,
    support: Mapping[str, Support] = MappingProxyType({}),
    *,
    recalibrated: bool = True,
) -> Claims:
    """Grade or withdraw a claim according to replays.

    A term that reduces innovations one row ahead may still be wrong; only replays show the difference.

    Args:
        recalibrated: True if the recalibrated base model is within its tolerances and so an alternative.
    """
    if claims.claimed is None:
        return claims
    of_sensors = claims.claimed.of_sensors
    effects = recalibrated and any(c.kind == "effect" for c in claims.claimed.candidates)
    doubt = _still_missed(error, floor) if of_sensors else _plant_doubt(error, floor, effects=effects)
    if doubt:
        return claims.withdrawn(doubt)
    if claims.name == "ambiguous" or claims.grade != "claimed":
        return claims
    worst, share = max(_remaining_excess(error, floor).items(), key=itemgetter(1), default=("", 0.0))
    if share <= PART:
        return claims
    if weak := tuple(n for n in claims.claimed.names if n in support and support[n].predicted < BETTER):
        return claims.withdrawn(Doubt("unsteady", names=weak))
    return replace(claims, grade="part", part=Part(worst, share))


def _still_missed(error: ErrorOf, floor: Channels) -> Doubt | None:
    """Doubt a claim without effects if replays miss much."""
    worst, times = max(_missed(error["after"], floor).items(), key=itemgetter(1), default=("", 0.0))
    return Doubt("missed", worst, times) if worst else None


def _plant_doubt(error: ErrorOf, floor: Channels, *, effects: bool) -> Doubt | None:
    """Doubt effects without improvement in replays."""
    recalibrated, after = error["recalibrated"], error["after"]
    if effects and floor and all(after[n] >= recalibrated[n] for n in floor):
        return Doubt("no_nearer")
    least = min(_remaining_excess(error, floor).values(), default=0.0)
    return Doubt("kept", size=least) if least > HALF else None


def _remaining_excess(error: ErrorOf, floor: Channels) -> dict[str, float]:
    """Return the remaining excess error of each channel."""
    shares = {n: excess_left(error["before"][n], error["after"][n], f) for n, f in floor.items()}
    return {n: x for n, x in shares.items() if not math.isnan(x)}


# -- Check that nothing is missing ----------------------------------------------------------------


def single_number(claims: Claims, a: Attribution, subject: Subject, found: Found, missed: Channels) -> Claims:
    """Claim a single parameter or input gain.

    All other parameters must stay within their tolerances. If the logs do not separate several such claims, the best is
    claimed until an experiment separates them.

    Args:
        missed: Channel → error of the given model as a multiple of the noise floor.
    """
    misfit, near = claims.misfit, _alone_off(found, a.base)
    if len(near) > 1:
        names = tuple(n for h in near for n in h.names)
        experiment = experiment_for(subject, names)
        return Claims("ambiguous", near[0], names, experiment, misfit, claims.grade, apart=names)
    if near:
        return Claims(name_of(near[0].candidates, subject), near[0], misfit=misfit, grade="claimed")
    worst, fit = max(missed.items(), key=itemgetter(1), default=("", 0.0)), a.base.fit
    priors = {x.name: x.prior for x in fit.free if x.prior and not x.group}
    far = [n for n, (mean, sigma) in priors.items() if abs(fit.values[n] - mean) > WIDTHS * sigma]
    return Claims("unexplained", misfit=misfit, missed=worst, recalibrated=_moved(fit, far))


def _alone_off(found: Found, base: Hypothesis) -> list[Hypothesis]:
    """Return hypotheses of a single wrong parameter."""
    search = found.search
    single = [c for c in found.candidates if c.kind == "parameter" or c.gain]
    # Fits start from stated values: a fit from recalibrated values would have to follow a ridge of shared effects.
    stated = [search.hypothesis((c,), replace(base.fit, values=search.problem.values)) for c in single]
    earlier = [h for c in single if (h := search.tried.get((c.name,))) and h.ended]
    best = {h.names: h for h in sorted((*stated, *earlier), key=lambda h: -h.score)}
    off = sorted((h for h in best.values() if _is_off(search, h)), key=lambda h: h.score)
    return [h for h in off if h is off[0] or h.score - off[0].score < RIVAL]


def _moved(f: Fit, names: Sequence[str]) -> tuple[Moved, ...]:
    """Return base parameters with stated and fitted values."""
    return tuple(Moved(x.name, x.prior[0], f.values[x.name]) for x in f.free if x.prior and x.name in names)


def _is_off(search: Search, h: Hypothesis) -> bool:
    """Return True if only the hypothesis' parameter is off."""
    (c,) = h.candidates
    if _beyond(h.fit):
        return False
    return outside(search, h, c) if c.kind == "parameter" else h.is_away(c, SIGNIFICANT)


def _beyond(f: Fit) -> list[str]:
    """Return base parameters outside their tolerances."""
    return [x.name for x in f.free if x.prior and not x.group and beyond(f, x.name, x.prior)]


def _missed(error: Channels, floor: Channels) -> dict[str, float]:
    """Return channel → error as a multiple of its floor."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
