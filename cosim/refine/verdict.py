"""From an attribution to a verdict: claim, or say why not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from cosim.refine.attribution import RIVAL, SIGNIFICANT_IN_NOISE
from cosim.refine.candidates import Candidate, Kind
from cosim.refine.fit import Free
from cosim.refine.hypotheses import Attribution, Hypothesis
from cosim.refine.residual import COUNTS_FROM, excess_left
from cosim.refine.unnamed import NOTICED, Unnamed
from cosim.report.text import percent, plain
from plant.model import Model
from plant.quantities import parameters_of

Name = Literal["effect_found", "parameter_error", "sensor_error", "no_effect", "ambiguous", "unexplained"]
REMAINS = 0.02  # of what a claim gains, from which such a term disputes it where the claim is half a cure
DISPUTES, DISPUTED = 20.0, 0.3  # the same where it is a whole one: what little is left is said, not disputed
LEFT, MENDED, GROWN = 0.3, 0.9, 10.0  # process noise after over before: half mended between the first two, made worse
MENDS = 1 / 6  # of the excess error, which a claim leaves at most on the channel that it mends best
LITTLE = 0.05  # of what is missing, below which a term is no account of it
BLIND = 1 / 3  # of the effects that could not show, from which the logs say too little
CI95 = 1.96
NOTHING = "Nothing is missing: the model explains these logs down to the sensors' noise."
DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"


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
    """Claim only where score, significance and held-out likelihood agree and nothing nameless is left."""
    residual = _residual(a, unnamed, forced)
    kinds = {c.kind for c in a.best.candidates}
    effects = sum(h.candidates[0].kind == "effect" for h in a.tried if len(h.candidates) == 1)
    # a log at rest may show a biased sensor; of forces it says nothing
    too_little = len(a.hidden) > max(1.0, BLIND * effects) or (len(a.hidden) == effects == 1 and not kinds)
    if too_little and kinds != {"sensor"}:
        rivals = a.hidden if len(a.hidden) > 1 else (*a.hidden, "no_effect")
        sentence = _too_little(len(a.hidden), effects)
        return Verdict("ambiguous", None, rivals, DEFAULT_EXPERIMENT, residual, sentence)
    if not kinds:
        if not a.quiet or (unnamed and unnamed[0].most > NOTICED):
            return Verdict("unexplained", None, (), "", residual, _unexplained(residual, ()))
        return Verdict("no_effect", None, (), "", residual, _nothing(a.hidden))
    if a.held_out <= 0 or _disputed(a, unnamed[0].most if unnamed else 0.0):
        return Verdict("unexplained", None, a.best.names, "", residual, _unexplained(residual, a.best.names))
    if a.rivals:
        common = _common(a)
        names = tuple(dict.fromkeys(n for h in (a.best, *a.rivals) for n in h.names if n not in common))
        if len(names) > 1:
            experiment = _experiment(model, names)
            certain = [c for c in a.best.candidates if c.name in common]
            sentence = _cannot_tell(names, experiment, _claim(a.best, certain, model) if certain else "")
            return Verdict("ambiguous", a.best, names, experiment, residual, sentence)
    left = unnamed[0] if unnamed and unnamed[0].most > DISPUTES else None
    sentence = _claim(a.best, a.best.candidates, model) + _left(left, a.base.score - a.best.score)
    return Verdict(_found(a.best.candidates, model), a.best, (), "", residual, sentence)


def proven(verdict: Verdict, error: Mapping[str, Mapping[str, float]], floor: Mapping[str, float]) -> Verdict:
    """The verdict, its claim withdrawn where replays are no better for it: `error` before, recalibrated and after.

    What takes away innovations a row ahead need not be what acts: the replay shows it. An error of a sensor alone
    leaves the replay as it is: that must be down to the noise without it.
    """
    if verdict.claimed is None:
        return verdict
    kinds = {c.kind for c in verdict.claimed.candidates}
    before, after = error["before"], error["after"]
    missed = _missed(after, floor)
    if verdict.claimed.of_sensors:
        if not missed:
            return verdict
        worst = max(missed, key=lambda n: missed[n])
        told = f"With it, replays still miss {worst} by {plain(missed[worst], 2)} times what noise makes."
        found = _unexplained(verdict.residual, verdict.claimed.names, "No hypothesis explains what the model misses.")
        names = verdict.claimed.names
        return replace(
            verdict, name="unexplained", claimed=None, rivals=names, experiment="", sentence=f"{found} {told}"
        )
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
    found = _unexplained(verdict.residual, names, "No hypothesis explains what the model misses.")
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
            sentence = _claim(best, best.candidates, model)
            return replace(verdict, name="parameter_error", claimed=best, sentence=sentence)
        names = tuple(n for h in (best, *rivals) for n in h.names)
        experiment = _experiment(model, names)
        sentence = _cannot_tell(names, experiment, "")
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


def _kind(c: Candidate, model: Model) -> Kind:
    """The kind of a candidate; an effect that the model has already is one more parameter of it."""
    return "parameter" if c.name in {e.name for e in model.awake} else c.kind


def _found(candidates: Sequence[Candidate], model: Model) -> Name:
    """What one says was found, by its kind."""
    kinds = {_kind(c, model) for c in candidates}
    return "parameter_error" if kinds == {"parameter"} else "sensor_error" if kinds == {"sensor"} else "effect_found"


def _too_little(hidden: int, effects: int) -> str:
    which = "the one effect" if effects == 1 else f"{hidden} of {effects} effects"
    return (
        f"These logs excite too little: {which} would not show in them, present or not. "
        f"This would show {'it' if effects == 1 else 'them'}: {DEFAULT_EXPERIMENT}."
    )


def _nothing(hidden: Sequence[str]) -> str:
    return f"{NOTHING} ({' and '.join(hidden)} would not have shown.)" if hidden else NOTHING


def _cannot_tell(names: Sequence[str], experiment: str, certain: str) -> str:
    """What rivals leave open, beside what they have in common."""
    opening = f"{certain} Beside it, these logs" if certain else "These logs"
    return f"{opening} cannot tell {' from '.join(names)}; this would, and `cosim excite` designs it: {experiment}."


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


def _common(a: Attribution) -> set[str]:
    """What every rival has too."""
    return set(a.best.names).intersection(*(h.names for h in a.rivals))


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


def _unexplained(
    residual: Mapping[str, Any],
    nearest: Sequence[str],
    otherwise: str = "No hypothesis holds on logs it was not fitted on.",
) -> str:
    where = residual["equation"]
    if residual["signals"]:
        # a term may promise likelihood where noise, not its own share, fills what is missing
        share = f", and that takes away {percent(residual['share'])} of what is missing" if residual["share"] else ""
        if residual["share"] and residual["share"] < LITTLE:
            share = f", but no single term for that takes away even {percent(LITTLE)} of what is missing"
        text = f"Something outside the catalogue acts on {where}; it {_follows(residual['signals'][0])}{share}."
    elif where:
        text = f"A disturbance acts on {where}; it depends on none of the signals tried."
    else:
        text = otherwise
    return text + (f" Nearest, but not it: {' and '.join(nearest)}." if nearest else "")


def _follows(signal: str) -> str:
    return "is constant" if signal == "1" else f"depends on {signal}"


def _claim(best: Hypothesis, candidates: Sequence[Candidate], model: Model) -> str:
    """What these candidates of the best hypothesis are, with their values and intervals."""
    units = {f"{k.name}.{p.name}": p.unit for k in (*model.catalogue, *model.sensors) for p in parameters_of(k)}
    units |= {p.name: p.unit for p in model.parameters}
    said: dict[str, list[str]] = {"effect": [], "parameter": [], "sensor": []}
    for c in candidates:
        values = ", ".join(_told(best, f, shown(units[f.name])) for f in c.free)
        gone = all(
            abs(best.fit.values[f.name] - f.neutral) <= CI95 * best.fit.sigma(f.name)
            for f in c.free
            if f.neutral is not None
        )
        note = "; the logs show none" if _kind(c, model) != c.kind and gone else ""
        said[_kind(c, model)].append(f"{c.name} ({values}{note})")
    openings = {"effect": "the model lacks", "parameter": "the model has a wrong", "sensor": "the sensors have"}
    text = "; ".join(f"{openings[kind]} {' and '.join(names)}" for kind, names in said.items() if names)
    moving = (
        "" if best.fit.converged else " The fit was still moving when it was ended: these intervals are too narrow."
    )
    return f"{text[0].upper()}{text[1:]}.{moving}"


def _told(best: Hypothesis, f: Free, unit: str) -> str:
    """A parameter with its interval, where that is narrower than its bounds are apart."""
    name, value, half = f.name.rpartition(".")[2], best.fit.values[f.name], CI95 * best.fit.sigma(f.name)
    if half > f.high - f.low:
        return f"{name} not told by these logs"
    return f"{name} = {value:.4g} ± {half:.2g} {unit}".rstrip()


def shown(unit: str) -> str:
    """A unit as it is read: `N·s²/m²`, nothing for a pure number."""
    return "" if unit == "1" else unit.replace(".", "·").replace("2", "²").replace("4", "⁴")


def _left(term: Unnamed | None, gained: float) -> str:
    """What a claim leaves, where that is plain: how much of the log-likelihood it gained a term without a name adds."""
    if term is None:
        return ""
    more = f"a term without a name promises {percent(term.gain / gained)} of the claim's gain on top"
    return f" Something is left in {term.equation} that {_follows(term.signal)}: {more}."


def _experiment(model: Model, names: Sequence[str]) -> str:
    known = [(len(row & set(names)), text) for row, text in model.told_apart_by.items()]
    shared, text = max(known, default=(0, DEFAULT_EXPERIMENT))
    return text if shared > 1 else DEFAULT_EXPERIMENT
