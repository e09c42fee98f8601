"""A verdict held against replays of the estimation logs: they change what is claimed and its grade, never erase it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cosim.estimation.problem import Problem
from cosim.refinement.hypotheses import Attribution, Hypothesis, Support
from cosim.refinement.judgement import BETTER, RIVAL, beyond, outside
from cosim.refinement.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.search import Search
from cosim.refinement.sentences import cannot_tell, claim, experiment_for, misses, partly, unexplained
from cosim.refinement.study import Study
from cosim.refinement.variants import refined_model, variants_of
from cosim.refinement.verdict import Verdict
from cosim.residuals.statistics import COUNTS_FROM, excess_left
from cosim.text import percent, plain
from plant.model import Model

PART = 0.1  # of the excess error, from which a claim that leaves it is of a part only
HALF = 0.5  # the same, on the channel that is mended best: what leaves more is not claimed

Channels = Mapping[str, float]  # measured output → root mean square
ErrorOf = Mapping[str, Channels]  # of replays before, recalibrated and after


def held_against_replays(study: Study, a: Attribution, verdict: Verdict, search: Search, problem: Problem) -> Verdict:
    """The verdict, its claim or that nothing is missing compared with replays of the estimation logs."""
    if verdict.name == "no_effect":
        verdict = standing(verdict, a, study.loaded.model, search, *_replay_errors(study, a, verdict, problem))
    if verdict.claimed is None:
        return verdict
    return proven(verdict, *_replay_errors(study, a, verdict, problem), a.support)


def _replay_errors(study: Study, a: Attribution, verdict: Verdict, problem: Problem) -> tuple[ErrorOf, Channels]:
    """Error of replays before, recalibrated and after, and the last's floor, by the kernel: nothing is built yet."""
    nothing = Path()
    variants = variants_of(study, a, verdict.claimed, refined_model(study, verdict.claimed), (nothing, nothing))
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    return error, noise_floor(variants["after"], problem, study.logs, np.random.default_rng(FLOOR_SEED)).level


# -- a claim ----------------------------------------------------------------------------------


def proven(
    verdict: Verdict, error: ErrorOf, floor: Channels, support: Mapping[str, Support] = MappingProxyType({})
) -> Verdict:
    """The verdict, its claim one of a part where replays still miss much, and none where they are no better for it.

    What takes away innovations a row ahead need not be what acts: the replay shows it.
    """
    if verdict.claimed is None:
        return verdict
    of_sensors = verdict.claimed.of_sensors
    doubt = _sensor_doubt(error, floor) if of_sensors else _plant_doubt(verdict.claimed, error, floor)
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


def _sensor_doubt(error: ErrorOf, floor: Channels) -> str:
    """An error of a sensor alone leaves the plant as it is: replays must be down to the noise without it."""
    if not (missed := _missed(error["after"], floor)):
        return ""
    worst = max(missed, key=lambda n: missed[n])
    return f"With it, replays still miss {worst} by {plain(missed[worst], 2)} times what noise makes."


def _plant_doubt(claimed: Hypothesis, error: ErrorOf, floor: Channels) -> str:
    """An effect must bring replays nearer than recalibration does; every claim must mend some channel by half."""
    recalibrated, after = error["recalibrated"], error["after"]
    has_effect = any(c.kind == "effect" for c in claimed.candidates)
    if has_effect and floor and all(after[n] >= recalibrated[n] for n in floor):
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


def standing(
    verdict: Verdict, a: Attribution, model: Model, search: Search, error: ErrorOf, floor: Channels
) -> Verdict:
    """`no_effect`, taken back where the model explains the logs only recalibrated beyond its tolerances.

    Of these rules the first that applies decides.
    """
    missed = _missed(error["before"], floor)
    if verdict.name != "no_effect" or not missed:
        return verdict
    tried = [h for h in a.tried if len(h.candidates) == 1 and h.candidates[0].kind == "parameter"]
    off = sorted((h for h in tried if h.fit.iterations and outside(search, h, h.candidates[0])), key=lambda h: h.score)
    near = [h for h in off if h is off[0] or h.score - off[0].score < RIVAL]
    if len(near) > 1:
        return _one_of(verdict, near, model)
    if near:
        sentence = claim(near[0], near[0].candidates, model)
        return replace(verdict, name="parameter_error", claimed=near[0], sentence=sentence, grade="claimed")
    within = all(not beyond(a.base.fit, f.name, f.prior) for f in a.base.fit.free if f.prior and not f.group)
    if within and not _missed(error["recalibrated"], floor):
        return verdict
    worst = max(missed, key=lambda n: missed[n])
    return replace(verdict, name="unexplained", sentence=misses(worst, missed[worst], a.base.fit))


def _one_of(verdict: Verdict, near: Sequence[Hypothesis], model: Model) -> Verdict:
    """One of several parameters is off, and the logs do not separate them; the best is claimed."""
    names = tuple(n for h in near for n in h.names)
    experiment = experiment_for(model, names)
    sentence = cannot_tell(names, experiment, "", model)
    return replace(verdict, name="ambiguous", claimed=near[0], rivals=names, experiment=experiment, sentence=sentence)


def _missed(error: Channels, floor: Channels) -> dict[str, float]:
    """Channels on which replays miss clearly more than noise makes, and how many times that."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
