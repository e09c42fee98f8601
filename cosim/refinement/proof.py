"""A verdict held against replays: what it claims must bring them nearer; where nothing is missing they are near."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.judgement import RIVAL, SIGNIFICANT_IN_NOISE
from cosim.refinement.measure import FLOOR_SEED, noise_floor, predicted_errors
from cosim.refinement.problem import Problem
from cosim.refinement.sentences import cannot_tell, claim, experiment_for, misses, unexplained
from cosim.refinement.study import Study
from cosim.refinement.variants import refined_model, variants_of
from cosim.refinement.verdict import Verdict
from cosim.residuals.statistics import COUNTS_FROM, excess_left
from cosim.text import percent, plain
from plant.model import Model

MENDS = 1 / 6  # of the excess error, which a claim leaves at most on the channel that it mends best

Channels = Mapping[str, float]  # measured output → root mean square
ErrorOf = Mapping[str, Channels]  # of replays before, recalibrated and after


def held_against_replays(study: Study, a: Attribution, verdict: Verdict, problem: Problem) -> Verdict:
    """The verdict, its claim or that nothing is missing compared with replays of the estimation logs."""
    if verdict.name == "no_effect":
        verdict = standing(verdict, a, study.loaded.model, *_replay_errors(study, a, verdict, problem))
    if verdict.claimed is None:
        return verdict
    return proven(verdict, *_replay_errors(study, a, verdict, problem))


def _replay_errors(
    study: Study, a: Attribution, verdict: Verdict, problem: Problem
) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Error of replays before, recalibrated and after, and the last's floor, by the kernel: nothing is built yet."""
    no_fmu = Path()
    variants = variants_of(study, a, verdict, refined_model(study.loaded, verdict.claimed), no_fmu, no_fmu)
    error = {name: predicted_errors(variant, problem, study.logs) for name, variant in variants.items()}
    return error, noise_floor(variants["after"], problem, study.logs, np.random.default_rng(FLOOR_SEED))


# -- a claim ----------------------------------------------------------------------------------


def proven(verdict: Verdict, error: ErrorOf, floor: Channels) -> Verdict:
    """The verdict, its claim withdrawn where replays are no better for it.

    What takes away innovations a row ahead need not be what acts: the replay shows it.
    """
    if verdict.claimed is None:
        return verdict
    of_sensors = verdict.claimed.of_sensors
    doubt = _sensor_doubt(error, floor) if of_sensors else _plant_doubt(verdict.claimed, error, floor)
    return _withdrawn(verdict, doubt) if doubt else verdict


def _sensor_doubt(error: ErrorOf, floor: Channels) -> str:
    """An error of a sensor alone leaves the replay as it is: that must be down to the noise without it."""
    if not (missed := _missed(error["after"], floor)):
        return ""
    worst = max(missed, key=lambda n: missed[n])
    return f"With it, replays still miss {worst} by {plain(missed[worst], 2)} times what noise makes."


def _plant_doubt(claimed: Hypothesis, error: ErrorOf, floor: Channels) -> str:
    """An effect must bring replays nearer than recalibration does; every claim must mend some channel."""
    before, recalibrated, after = error["before"], error["recalibrated"], error["after"]
    has_effect = any(c.kind == "effect" for c in claimed.candidates)
    if has_effect and floor and all(after[n] >= recalibrated[n] for n in floor):
        return "Replays with it are nearer on no channel than those of the model recalibrated without it."
    left = [x for n, f in floor.items() if not math.isnan(x := excess_left(before[n], after[n], f))]
    if left and min(left) > MENDS:
        return f"With it, {percent(min(left))} of the excess error stays."
    return ""


def _withdrawn(verdict: Verdict, doubt: str) -> Verdict:
    """The verdict without its claim, which is nearest; and why."""
    names = verdict.claimed.names if verdict.claimed else ()
    opening = unexplained(verdict.residual, names, "No hypothesis explains what the model misses.")
    sentence = f"{opening} {doubt}"
    return replace(verdict, name="unexplained", claimed=None, rivals=names, experiment="", sentence=sentence)


# -- that nothing is missing ------------------------------------------------------------------


def standing(verdict: Verdict, a: Attribution, model: Model, error: ErrorOf, floor: Channels) -> Verdict:
    """`no_effect`, taken back where the model explains the logs recalibrated, but not as it stands.

    Base parameters are held near the data sheet, and one that is a few percent off gains no more than that costs.
    Of these rules the first that applies decides.
    """
    missed = _missed(error["before"], floor)
    if verdict.name != "no_effect" or not missed:
        return verdict
    off = sorted((h for h in a.tried if len(h.candidates) == 1 and _plainly_off(h, model)), key=lambda h: h.score)
    if not off:
        worst = max(missed, key=lambda n: missed[n])
        return replace(verdict, name="unexplained", sentence=misses(worst, missed[worst], a.base.fit))
    near = [h for h in off if h is off[0] or h.score - off[0].score < RIVAL]
    if len(near) == 1:
        sentence = claim(near[0], near[0].candidates, model)
        return replace(verdict, name="parameter_error", claimed=near[0], sentence=sentence)
    return _one_of(verdict, near, model)


def _one_of(verdict: Verdict, near: Sequence[Hypothesis], model: Model) -> Verdict:
    """One of several parameters is off, and the logs do not separate them; the best is claimed."""
    names = tuple(n for h in near for n in h.names)
    experiment = experiment_for(model, names)
    sentence = cannot_tell(names, experiment, "")
    return replace(verdict, name="ambiguous", claimed=near[0], rivals=names, experiment=experiment, sentence=sentence)


def _plainly_off(h: Hypothesis, model: Model) -> bool:
    """A base parameter, fitted, far from what the model says and within its limits."""
    (candidate,) = h.candidates
    if candidate.kind != "parameter" or h.fit.iterations == 0:
        return False
    (f,) = candidate.free
    value, sigma = h.fit.values[f.name], h.fit.sigma(f.name)
    return value not in (f.low, f.high) and abs(value - float(getattr(model, f.name))) > SIGNIFICANT_IN_NOISE * sigma


def _missed(error: Channels, floor: Channels) -> dict[str, float]:
    """Channels on which replays miss clearly more than noise makes, and how many times that."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
