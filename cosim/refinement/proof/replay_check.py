"""A verdict held against replays of the estimation logs: they change what is claimed and its grade, never erase it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import percent, plain
from cosim.estimation.fit import Fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.judgement import BETTER, RIVAL, SIGNIFICANT, beyond, outside
from cosim.refinement.decision.sentences import cannot_tell, claim, experiment_for, further, misses, partly, unexplained
from cosim.refinement.decision.verdict import Verdict, name_of
from cosim.refinement.proof.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.proof.refined_models import of_noise, refined_subject, variants_of
from cosim.refinement.search.fits import Found, Search
from cosim.refinement.search.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.study import Study
from cosim.residuals.residual_statistics import COUNTS_FROM, excess_left
from cosim.subject.interface import Subject

PART = 0.1  # of the excess error, from which a claim that leaves it is of a part only
HALF = 0.5  # the same, on the channel that is mended best: what leaves more is not claimed

Channels = Mapping[str, float]  # measured output → root mean square
ErrorOf = Mapping[str, Channels]  # of replays before, recalibrated and after


def held_against_replays(study: Study, a: Attribution, verdict: Verdict, found: Found, problem: Problem) -> Verdict:
    """The verdict, its claim or that nothing is missing compared with replays of the estimation logs."""
    within, single = _within_tolerances(a.base.fit), False
    if verdict.name == "no_effect":
        error, floor = _replay_errors(study, a, verdict, problem, found.heard)
        if missed := _missed(error["before"], floor):
            explained = within and not _missed(error["recalibrated"], floor)
            verdict = verdict if explained else standing(verdict, a, study.subject, found, missed)
            single = True
    elif verdict.name == "parameter_error" and verdict.claimed and (others := _beyond(verdict.claimed.fit)):
        said = verdict.sentence + further(verdict.claimed.fit, others)
        otherwise = standing(verdict, a, study.subject, found, {})
        verdict = otherwise if otherwise.claimed is not None else replace(verdict, sentence=said)
    if verdict.claimed is None:
        return verdict
    error, floor = _replay_errors(study, a, verdict, problem, found.heard)
    if single and (doubt := _still_missed(error, floor)):
        return _withdrawn(verdict, doubt)
    return proven(verdict, error, floor, a.support, recalibrated=within)


def _replay_errors(
    study: Study, a: Attribution, verdict: Verdict, problem: Problem, heard: Array | None
) -> tuple[ErrorOf, Channels]:
    """Error of replays before, recalibrated and after, and the last's floor, by the kernel: nothing is built yet."""
    subject, settings = study.subject, study.settings
    refined = refined_subject(subject, settings, verdict.claimed)
    variants = variants_of(subject, settings, a, verdict.claimed, refined)
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    quiet = of_noise(variants["after"], a, verdict.claimed, heard)
    return error, noise_floor(quiet, problem, study.logs, np.random.default_rng(FLOOR_SEED)).level


# -- a claim ----------------------------------------------------------------------------------


def proven(
    verdict: Verdict,
    error: ErrorOf,
    floor: Channels,
    support: Mapping[str, Support] = MappingProxyType({}),
    *,
    recalibrated: bool = True,
) -> Verdict:
    """The verdict, its claim one of a part where replays still miss much, and none where they are no better for it.

    What takes away innovations a row ahead need not be what acts: the replay shows it.
    recalibrated: the base model is, within its tolerances; else it is no alternative
    """
    if verdict.claimed is None:
        return verdict
    of_sensors = verdict.claimed.of_sensors
    effects = recalibrated and any(c.kind == "effect" for c in verdict.claimed.candidates)
    doubt = _still_missed(error, floor) if of_sensors else _plant_doubt(error, floor, effects=effects)
    if doubt:
        return _withdrawn(verdict, doubt)
    left = _left(error, floor)
    whole = verdict.name != "ambiguous" and verdict.grade == "claimed"
    if whole and left and (worst := max(left, key=lambda n: left[n])) and left[worst] > PART:
        if weak := [n for n in verdict.claimed.names if n in support and support[n].predicted < BETTER]:
            text = f"Much is left, and predictions of logs left out are not plainly better for {' and '.join(weak)}."
            return _withdrawn(verdict, text)
        kept = f"replays keep {percent(left[worst])} of the excess error of {worst}"
        sentence = partly(verdict.sentence, verdict.residual, kept)
        return replace(verdict, grade="part", sentence=sentence)
    return verdict


def _still_missed(error: ErrorOf, floor: Channels) -> str:
    """Replays must be down to the noise with what leaves the equations as they are: a sensor's error, a number."""
    if not (missed := _missed(error["after"], floor)):
        return ""
    worst = max(missed, key=lambda n: missed[n])
    return f"With it, replays still miss {worst} by {plain(missed[worst], 2)} times what noise makes."


def _plant_doubt(error: ErrorOf, floor: Channels, *, effects: bool) -> str:
    """Effects must bring replays nearer than recalibration does; every claim must mend some channel by half."""
    recalibrated, after = error["recalibrated"], error["after"]
    if effects and floor and all(after[n] >= recalibrated[n] for n in floor):
        return "Replays with it are nearer on no channel than those of the model recalibrated without it."
    left = _left(error, floor)
    if left and min(left.values()) > HALF:
        return f"With it, replays keep {plain(100 * min(left.values()), 2)}\u00a0% of the excess error."
    return ""


def _left(error: ErrorOf, floor: Channels) -> dict[str, float]:
    """Channel → share of the excess error that a claim leaves, where there was an excess."""
    shares = {n: excess_left(error["before"][n], error["after"][n], f) for n, f in floor.items()}
    return {n: x for n, x in shares.items() if not math.isnan(x)}


def _withdrawn(verdict: Verdict, doubt: str) -> Verdict:
    """The verdict without its claim, which is nearest; and why."""
    names = verdict.claimed.names if verdict.claimed else ()
    opening = unexplained(verdict.residual, names, "No hypothesis explains what the model misses.")
    sentence = f"{opening} {doubt}"
    return replace(
        verdict, name="unexplained", claimed=None, rivals=names, experiment="", sentence=sentence, grade="nearest"
    )


# -- that nothing is missing ------------------------------------------------------------------


def standing(verdict: Verdict, a: Attribution, subject: Subject, found: Found, missed: Channels) -> Verdict:
    """`no_effect`, taken back where the model explains the logs only recalibrated beyond its tolerances.

    Then the one number that is off is claimed, or the gain of an input: what leaves all others within theirs.
    missed: channel → how many times what noise makes the model as it stands misses it
    """
    search = found.search
    single = [c for c in found.candidates if c.kind == "parameter" or c.gain]
    # from numbers as stated: from where they are recalibrated a fit would have to follow what they share
    stated = [search.hypothesis((c,), replace(a.base.fit, values=search.problem.values)) for c in single]
    known = [h for c in single if (h := search.tried.get((c.name,))) and h.ended]
    best = {h.names: h for h in sorted((*stated, *known), key=lambda h: -h.score)}
    off = sorted((h for h in best.values() if _alone_off(search, h)), key=lambda h: h.score)
    near = [h for h in off if h is off[0] or h.score - off[0].score < RIVAL]
    if len(near) > 1:
        return _one_of(verdict, near, subject)
    if near:
        sentence, name = claim(near[0], near[0].candidates, subject), name_of(near[0].candidates, subject)
        return replace(verdict, name=name, claimed=near[0], sentence=sentence, grade="claimed")
    worst = max(missed, key=lambda n: missed[n], default="")
    return replace(
        verdict, name="unexplained", claimed=None, sentence=misses(worst, missed.get(worst, 0.0), a.base.fit)
    )


def _alone_off(search: Search, h: Hypothesis) -> bool:
    """The one number of a hypothesis is off, or its gain is none of 1, and no other number is."""
    (c,) = h.candidates
    if c.kind == "parameter":
        return outside(search, h, c) and _within_tolerances(h.fit)
    moved = any(
        f.neutral is not None and abs(h.fit.values[f.name] - f.neutral) > SIGNIFICANT * h.fit.sigma(f.name)
        for f in c.free
    )
    return moved and _within_tolerances(h.fit)


def _within_tolerances(f: Fit) -> bool:
    """No base parameter is plainly further from its stated value than its tolerance."""
    return not _beyond(f)


def _beyond(f: Fit) -> list[str]:
    """Base parameters that are plainly further from their stated values than their tolerances."""
    return [x.name for x in f.free if x.prior and not x.group and beyond(f, x.name, x.prior)]


def _one_of(verdict: Verdict, near: Sequence[Hypothesis], subject: Subject) -> Verdict:
    """One of several parameters is off, and the logs do not separate them; the best is claimed."""
    names = tuple(n for h in near for n in h.names)
    experiment = experiment_for(subject, names)
    sentence = cannot_tell(names, experiment, "", subject)
    return replace(verdict, name="ambiguous", claimed=near[0], rivals=names, experiment=experiment, sentence=sentence)


def _missed(error: Channels, floor: Channels) -> dict[str, float]:
    """Channels on which replays miss clearly more than noise makes, and how many times that."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
