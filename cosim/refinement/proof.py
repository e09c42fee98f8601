"""A verdict held against replays: what it claims must bring them nearer; where nothing is missing they are near."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.judgement import RIVAL, SIGNIFICANT_IN_NOISE
from cosim.refinement.sentences import cannot_tell, claim, experiment_for, unexplained
from cosim.refinement.verdict import Verdict
from cosim.residuals.statistics import COUNTS_FROM, excess_left
from cosim.text import percent, plain
from plant.model import Model

MENDS = 1 / 6  # of the excess error, which a claim leaves at most on the channel that it mends best


def proven(verdict: Verdict, error: Mapping[str, Mapping[str, float]], floor: Mapping[str, float]) -> Verdict:
    """The verdict, its claim withdrawn where replays are no better for it: `error` before, recalibrated and after.

    What takes away innovations a row ahead need not be what acts: the replay shows it. An error of a sensor alone
    leaves the replay as it is: that must be down to the noise without it.
    """
    if verdict.claimed is None:
        return verdict
    kinds = {c.kind for c in verdict.claimed.candidates}
    before, after = error["before"], error["after"]
    if verdict.claimed.of_sensors:
        if not (missed := _missed(after, floor)):
            return verdict
        worst = max(missed, key=lambda n: missed[n])
        times = plain(missed[worst], 2)
        return _withdrawn(verdict, f"With it, replays still miss {worst} by {times} times what noise makes.")
    left = [x for n, f in floor.items() if not math.isnan(x := excess_left(before[n], after[n], f))]
    if "effect" in kinds and floor and all(after[n] >= error["recalibrated"][n] for n in floor):
        told = "Replays with it are nearer on no channel than those of the model recalibrated without it."
    elif left and min(left) > MENDS:
        told = f"With it, {percent(min(left))} of the excess error stays."
    else:
        return verdict
    return _withdrawn(verdict, told)


def _withdrawn(verdict: Verdict, told: str) -> Verdict:
    """The verdict without its claim, which is nearest; and why."""
    names = verdict.claimed.names if verdict.claimed else ()
    found = unexplained(verdict.residual, names, "No hypothesis explains what the model misses.")
    return replace(verdict, name="unexplained", claimed=None, rivals=names, experiment="", sentence=f"{found} {told}")


def standing(
    verdict: Verdict, a: Attribution, model: Model, error: Mapping[str, Mapping[str, float]], floor: Mapping[str, float]
) -> Verdict:
    """`no_effect`, taken back where the model explains the logs recalibrated, but not as it stands.

    Base parameters are held near the data sheet, and one that is a few percent off gains no more than that costs.
    """
    missed = _missed(error["before"], floor)
    if verdict.name != "no_effect" or not missed:
        return verdict
    plainly = [h for h in a.tried if len(h.candidates) == 1 and _plainly_off(h, model)]
    if plainly:
        best, *others = sorted(plainly, key=lambda h: h.score)
        rivals = [h for h in others if h.score - best.score < RIVAL]
        if not rivals:
            sentence = claim(best, best.candidates, model)
            return replace(verdict, name="parameter_error", claimed=best, sentence=sentence)
        names = tuple(n for h in (best, *rivals) for n in h.names)
        experiment = experiment_for(model, names)
        sentence = cannot_tell(names, experiment, "")
        return replace(verdict, name="ambiguous", claimed=best, rivals=names, experiment=experiment, sentence=sentence)
    worst = max(missed, key=lambda n: missed[n])
    moved = ", ".join(
        f"{f.name} {plain(f.prior[0])} → {plain(a.base.fit.values[f.name])}"
        for f in a.base.fit.free
        if f.prior and abs(a.base.fit.values[f.name] - f.prior[0]) > 2 * f.prior[1]
    )
    return replace(
        verdict,
        name="unexplained",
        sentence=f"The model as it stands misses {worst} by {plain(missed[worst], 2)} times what noise makes"
        + (f"; recalibrated further than a data sheet is off ({moved}) it does not" if moved else "")
        + ". No candidate accounts for that.",
    )


def _plainly_off(h: Hypothesis, model: Model) -> bool:
    """A base parameter, fitted, far from what the model says and within its limits."""
    (candidate,) = h.candidates
    if candidate.kind != "parameter" or h.fit.iterations == 0:
        return False
    (f,) = candidate.free
    value, sigma = h.fit.values[f.name], h.fit.sigma(f.name)
    return value not in (f.low, f.high) and abs(value - float(getattr(model, f.name))) > SIGNIFICANT_IN_NOISE * sigma


def _missed(error: Mapping[str, float], floor: Mapping[str, float]) -> dict[str, float]:
    """Channels on which replays miss clearly more than noise makes, and how many times that."""
    return {n: error[n] / f for n, f in floor.items() if f > 0.0 and error.get(n, 0.0) > COUNTS_FROM * f}
