"""From an attribution to a verdict: what is claimed, how much of what is missing that is, and what comes nearest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from cosim.refinement.decision.judgement import SIGNIFICANT, loss_without
from cosim.refinement.decision.sentences import (
    beside,
    cannot_tell,
    claim,
    excites_too_little,
    experiment_for,
    left_over,
    nothing,
    perhaps,
    unexplained,
    usual_experiment,
)
from cosim.refinement.search.hypotheses import TOGETHER, Attribution, Hypothesis
from cosim.refinement.search.unnamed import Leftover
from cosim.subject.base_parameters import kind_within
from cosim.subject.candidates import Candidate
from cosim.subject.interface import Subject

Name = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
Grade = Literal["claimed", "part", "nearest"]
MUCH = 0.3  # of what a claim gains, from which a term without a name beside it disputes it
MOVED = 0.5  # of its size, by which a part that stands may change beside terms without a name
LARGE = 0.02  # of what moves an equation, from which an unknown input is no small disturbance


@dataclass(frozen=True)
class Verdict:
    """The answer: its name, what is claimed, rivals, what is left, and the hypothesis that comes nearest.

    nearest: what the nearest model has; the claim where there is one
    """

    name: Name
    claimed: Hypothesis | None
    rivals: tuple[str, ...]
    experiment: str
    residual: Mapping[str, Any]
    sentence: str
    grade: Grade = "nearest"


def judge(
    a: Attribution, left: Leftover, subject: Subject, forced: Sequence[str], moves: Mapping[str, float], *, still: bool
) -> Verdict:
    """Claim what is borne out and stands beside what has no name. Of these rules the first that applies decides.

    moves: forced state → size of its unknown input over that of its derivative on the logs
    still: nothing moves in the logs
    """
    residual = _residual(a, left, forced)
    large = max((name for name in moves if moves[name] > LARGE), key=lambda name: moves[name], default=None)
    unseen = large is None and a.hidden and len(a.hidden) == a.effects
    if not a.best.candidates and (still or unseen):
        return _undecided(a, subject, residual, still=still)
    if not a.best.candidates and left.terms:
        return Verdict("unexplained", None, (), "", residual, unexplained(residual, ()))
    if not a.best.candidates and large is not None:
        residual = {**residual, "equation": large}
        return Verdict("unexplained", None, (), "", residual, unexplained(residual, ()))
    if not a.best.candidates:
        return Verdict("no_effect", None, (), "", residual, nothing(a.hidden, moves) + perhaps(_little(a)))
    gained = a.base.score - a.best.score
    hides = large is not None and gained < MUCH * a.noise_gain[list(forced).index(large)]
    if _disputed(a, left) or hides:
        return Verdict("unexplained", None, a.best.names, "", residual, unexplained(residual, a.best.names))
    if a.rivals:
        return _ambiguous(a, subject, residual)
    sentence = claim(a.best, a.best.candidates, subject) + perhaps(_little(a))
    if left.terms:
        sentence += left_over(left.terms[0], gained)
    name = name_of(a.best.candidates, subject)
    if large is not None:
        return Verdict(name, a.best, (), "", residual, beside(sentence, large, moves[large]), "part")
    return Verdict(name, a.best, (), "", residual, sentence, "claimed")


def _undecided(a: Attribution, subject: Subject, residual: Mapping[str, Any], *, still: bool) -> Verdict:
    """Nothing is claimed of logs in which nothing would show."""
    names = a.hidden
    rivals = names if len(names) > 1 else (*names, "no_effect")
    experiment = usual_experiment(subject)
    sentence = excites_too_little(len(names), experiment, still=still)
    return Verdict("ambiguous", None, rivals, experiment, residual, sentence)


def _ambiguous(a: Attribution, subject: Subject, residual: Mapping[str, Any]) -> Verdict:
    """The best is in the model until an experiment separates it from its rivals; what they share is certain."""
    every = (a.best, *a.rivals, *([a.fuller] if a.fuller and a.fuller.score < a.best.score else []))
    common = set(a.best.names).intersection(*(h.names for h in a.rivals))
    apart = [[n for n in h.names if n not in common] for h in every]
    experiment = experiment_for(subject, [n for names in apart for n in names])
    certain = [c for c in a.best.candidates if c.name in common]
    certainly = claim(a.best, certain, subject) if certain else ""
    sentence = cannot_tell([" and ".join(names) for names in apart], experiment, certainly, subject)
    rivals = tuple(TOGETHER.join(h.names) for h in every)
    return Verdict("ambiguous", a.best, rivals, experiment, residual, sentence)


def _little(a: Attribution) -> tuple[str, ...]:
    """Parts that gain, but too little to be told from chance."""
    return tuple(n for n in a.fuller.names if n not in a.best.names) if a.fuller else ()


def name_of(candidates: Sequence[Candidate], subject: Subject) -> Name:
    """The verdict that claims these candidates, by their kind."""
    kinds = {kind_within(c, subject) for c in candidates}
    return "parameter_error" if kinds == {"parameter"} else "sensor_error" if kinds == {"sensor"} else "effect_found"


def _disputed(a: Attribution, left: Leftover) -> bool:
    """What has no name gains much beside the claim, or takes a part's place: that part only stood for it."""
    if left.fit is None:
        return False
    if left.gain > MUCH * (a.base.score - a.best.score):
        return True
    beside = Hypothesis(a.best.candidates, left.fit, 0.0)
    neutral = {
        f.name: f.neutral if f.neutral is not None else a.base.fit.values.get(f.name, 0.0) for f in left.fit.free
    }
    for c in a.best.candidates:
        if loss_without(beside, c, neutral) < left.cost:
            return True
        for f in c.free:
            if f.neutral is not None:
                was, now = a.best.fit.values[f.name] - f.neutral, left.fit.values[f.name] - f.neutral
                if abs(now - was) > MOVED * abs(was) and abs(now - was) > SIGNIFICANT * a.best.fit.sigma(f.name):
                    return True
    return False


def _residual(a: Attribution, left: Leftover, forced: Sequence[str]) -> dict[str, Any]:
    """Where the misfit sits and on what it depends."""
    q0, q1 = a.base.fit.noise.density, a.best.fit.noise.density
    noise = {
        equation: {"before": float(q0[k]), "after": float(q1[k]), "inflated": a.noisy[k], "gain": a.noise_gain[k]}
        for k, equation in enumerate(forced)
    }
    terms = left.terms
    # densities of states in different units do not compare; what they are worth does
    inflated = {
        equation: gain for equation, gain in zip(forced, a.noise_gain, strict=True) if noise[equation]["inflated"]
    }
    where = terms[0].equation if terms else max(inflated, key=lambda k: inflated[k]) if inflated else None
    return {
        "equation": where,
        "signals": list(dict.fromkeys(u.signal for u in terms if u.equation == where)),
        "share": terms[0].share if terms else None,
        "process_noise": noise,
        "terms": [u.entry for u in terms],
    }
