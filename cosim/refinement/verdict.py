"""From an attribution to a verdict: claim, or say why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cosim.refinement.candidates import Candidate, kind_within
from cosim.refinement.hypotheses import Attribution, Hypothesis
from cosim.refinement.sentences import (
    DEFAULT_EXPERIMENT,
    cannot_tell,
    claim,
    excites_too_little,
    experiment_for,
    left_over,
    nothing,
    unexplained,
)
from cosim.refinement.unnamed import NOTICED, Unnamed
from plant.model import Model

Name = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
REMAINS = 0.02  # of what a claim gains, from which such a term disputes it where the claim is half a cure
DISPUTES, DISPUTED = 20.0, 0.3  # the same where it is a whole one: what little is left is said, not disputed
LEFT, MENDED, GROWN = 0.3, 0.9, 10.0  # process noise after over before: half mended between the first two, made worse
BLIND = 1 / 3  # of the effects that could not show, from which the logs say too little


@dataclass(frozen=True)
class Verdict:
    """The answer: its name, what is claimed, rivals, and what is left."""

    name: Name
    claimed: Hypothesis | None
    rivals: tuple[str, ...]
    experiment: str
    residual: Mapping[str, Any]
    sentence: str


def judge(a: Attribution, unnamed: Sequence[Unnamed], model: Model, forced: Sequence[str]) -> Verdict:
    """Claim only where score, significance and held-out likelihood agree and nothing nameless is left.

    Of these rules the first that applies decides.
    """
    residual = _residual(a, unnamed, forced)
    nameless = unnamed[0].most if unnamed else 0.0
    nothing_gains = not a.best.candidates
    if _excites_too_little(a):
        return _undecided(a, residual)
    if nothing_gains and (not a.quiet or nameless > NOTICED):
        return Verdict("unexplained", None, (), "", residual, unexplained(residual, ()))
    if nothing_gains:
        return Verdict("no_effect", None, (), "", residual, nothing(a.hidden))
    if a.held_out <= 0 or _disputed(a, nameless):
        return Verdict("unexplained", None, a.best.names, "", residual, unexplained(residual, a.best.names))
    if len(_rivalling(a)) > 1:
        return _ambiguous(a, model, residual)
    left = unnamed[0] if nameless > DISPUTES else None
    sentence = claim(a.best, a.best.candidates, model) + left_over(left, a.base.score - a.best.score)
    return Verdict(_name_of(a.best.candidates, model), a.best, (), "", residual, sentence)


def _excites_too_little(a: Attribution) -> bool:
    """Too many effects would not show in these logs, present or not; a sensor's error may show even at rest."""
    effects, kinds = _effects_tried(a), {c.kind for c in a.best.candidates}
    only_one = len(a.hidden) == effects == 1 and not kinds
    return (len(a.hidden) > max(1.0, BLIND * effects) or only_one) and kinds != {"sensor"}


def _effects_tried(a: Attribution) -> int:
    return sum(h.candidates[0].kind == "effect" for h in a.tried if len(h.candidates) == 1)


def _undecided(a: Attribution, residual: Mapping[str, Any]) -> Verdict:
    """Nothing is claimed of logs that excite too little."""
    rivals = a.hidden if len(a.hidden) > 1 else (*a.hidden, "no_effect")
    sentence = excites_too_little(len(a.hidden), _effects_tried(a))
    return Verdict("ambiguous", None, rivals, DEFAULT_EXPERIMENT, residual, sentence)


def _rivalling(a: Attribution) -> tuple[str, ...]:
    """What the best and its rivals do not have in common."""
    return tuple(dict.fromkeys(n for h in (a.best, *a.rivals) for n in h.names if n not in _common(a)))


def _common(a: Attribution) -> set[str]:
    """What every rival has too."""
    return set(a.best.names).intersection(*(h.names for h in a.rivals))


def _ambiguous(a: Attribution, model: Model, residual: Mapping[str, Any]) -> Verdict:
    """The best is claimed until an experiment separates it from its rivals; what they share is certain."""
    names, common = _rivalling(a), _common(a)
    experiment = experiment_for(model, names)
    certain = [c for c in a.best.candidates if c.name in common]
    sentence = cannot_tell(names, experiment, claim(a.best, certain, model) if certain else "")
    return Verdict("ambiguous", a.best, names, experiment, residual, sentence)


def _name_of(candidates: Sequence[Candidate], model: Model) -> Name:
    """The verdict that claims these candidates, by their kind."""
    kinds = {kind_within(c, model) for c in candidates}
    return "parameter_error" if kinds == {"parameter"} else "sensor_error" if kinds == {"sensor"} else "effect_found"


def _disputed(a: Attribution, nameless: float) -> bool:
    """The claim does not settle the matter: a term without a name promises much beside it, or process noise says so.

    A true claim takes the process noise out of the equations it mends, and puts none into others.
    """
    left = [np.exp(q1 - q0) for q0, q1, noisy in zip(a.base.fit.log_q, a.best.fit.log_q, a.noisy, strict=True) if noisy]
    if any(share > GROWN for share in left):
        return True
    half_mended = any(LEFT < share < MENDED for share in left)
    noticed, remains = (NOTICED, REMAINS) if half_mended else (DISPUTES, DISPUTED)
    return nameless > noticed and nameless > remains * (a.base.score - a.best.score)


def _residual(a: Attribution, unnamed: Sequence[Unnamed], forced: Sequence[str]) -> dict[str, Any]:
    """Where the misfit sits and on what it depends."""
    q0, q1 = np.exp(a.base.fit.log_q), np.exp(a.best.fit.log_q)
    noise = {
        equation: {"before": float(q0[k]), "after": float(q1[k]), "inflated": a.noisy[k], "gain": a.noise_gain[k]}
        for k, equation in enumerate(forced)
    }
    terms = [u for u in unnamed if u.most > NOTICED][:5]
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
        "terms": [
            {"equation": u.equation, "signal": u.signal, "gain": u.gain, "coefficient": u.coefficient} for u in terms
        ],
    }
