"""What a verdict says, in sentences that follow from its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cosim.base.text import amount, finer, joined, percent, plain, written
from cosim.estimation.fit import Fit
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.shapes import Shape
from cosim.refinement.search.unnamed import Unnamed
from cosim.subject.base_parameters import kind_within
from cosim.subject.candidates import Candidate, Free
from cosim.subject.interface import Subject

LITTLE = 0.05  # of what is missing, below which a term is no account of it
NOTHING = "Nothing is missing: the model, within its tolerances, explains these logs down to the sensors' noise."
DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"
MORE_ROWS = "more rows, over a wider range of every input, each with each"


def usual_experiment(subject: Subject) -> str:
    """What tells more of any model of this kind."""
    return MORE_ROWS if subject.static else DEFAULT_EXPERIMENT


def excites_too_little(effects: int, experiment: str, *, still: bool) -> str:
    """That these logs would show none of the effects, and what would show them."""
    which = "the one effect" if effects == 1 else f"none of {effects} effects"
    opening = "Nothing moves in these logs" if still else "These logs excite too little"
    would = "would not" if effects == 1 else "would"
    return (
        f"{opening}: {which} {would} show in them, present or not. "
        f"This would show {'it' if effects == 1 else 'them'}: {experiment}."
    )


def nothing(hidden: Sequence[str], moves: Mapping[str, float]) -> str:
    """That nothing is missing, how large a disturbance is left, and what would not have shown.

    moves: forced state → size of its unknown input over that of its derivative on the logs, where there is one
    """
    left = [f"{percent(share)} of what moves {name}" for name, share in moves.items()]
    text = NOTHING
    if left:
        text = f"Nothing is missing: what the model leaves is a disturbance ({', '.join(left)}) that follows no signal."
    return f"{text} ({' and '.join(hidden)} would not have shown.)" if hidden else text


def cannot_tell(names: Sequence[str], experiment: str, certain: str, subject: Subject) -> str:
    """What rivals leave open, beside what they have in common."""
    opening = f"{certain} Beside it, these logs" if certain else "These logs"
    designed = "" if subject.static else "; `cosim excite` designs it, and says whether any would"
    apart = f"{' from '.join(names)}" if len(names) < 3 else f"these apart: {', or '.join(names)}"
    return f"{opening} cannot tell {apart}. This may: {experiment}{designed}."


def unexplained(
    residual: Mapping[str, Any],
    nearest: Sequence[str],
    otherwise: str = "No hypothesis holds on logs it was not fitted on.",
) -> str:
    """Where something acts that has no name, on what it depends, and what comes nearest."""
    where = residual["equation"]
    if residual["signals"]:
        # a term may promise likelihood where noise, not its own share, fills what is missing
        share = f", and that takes away {percent(residual['share'])} of what is missing" if residual["share"] else ""
        if residual["share"] and residual["share"] < LITTLE:
            share = f", but no single term for that takes away even {percent(LITTLE)} of what is missing"
        text = f"Something outside the catalogue acts on {where}; it {_goes(residual)}{share}."
    elif where:
        text = f"A disturbance acts on {where}; it depends on none of the signals tried."
    else:
        text = otherwise
    return text + (f" Nearest, but not it: {' and '.join(nearest)}." if nearest else "")


def partly(sentence: str, residual: Mapping[str, Any], left: str) -> str:
    """A claim that is a part of what is missing: what is left, and where that acts."""
    where = f" acts on {residual['equation']}" if residual["equation"] else " has no place in the equations"
    on = f" and {_goes(residual)}" if residual["signals"] else ""
    return f"A part of what is missing: {left}, and the rest{where}{on}. {sentence}"


def beside(sentence: str, equation: str, share: float) -> str:
    """A claim that is a part of what is missing, by the unknown input that is left."""
    left = f"beside it an unknown input of {percent(share)} of what moves {equation} is left"
    return f"A part of what is missing: {left}. {sentence}"


def misses(channel: str, times: float, base: Fit) -> str:
    """By how much the model as it stands misses a channel, and how far recalibration had to go to mend that."""
    moved = ", ".join(
        f"{f.name} {plain(f.prior[0])} → {plain(base.values[f.name])}"
        for f in base.free
        if f.prior and not f.group and abs(base.values[f.name] - f.prior[0]) > 2 * f.prior[1]
    )
    further = f"; recalibrated further than a data sheet is off ({moved}) it does not" if moved else ""
    return (
        f"The model as it stands misses {channel} by {plain(times, 2)} times what noise makes{further}. "
        "No candidate accounts for that."
    )


def further(base: Fit, names: Sequence[str]) -> str:
    """That other numbers come out beyond their tolerances beside a claim."""
    moved = [
        f"{f.name} {plain(f.prior[0])} → {plain(base.values[f.name])}" for f in base.free if f.prior and f.name in names
    ]
    return (
        f" Beside it, {' and '.join(moved)} {'is' if len(moved) == 1 else 'are'} further off than stated."
        if moved
        else ""
    )


def rises(errors: Mapping[str, tuple[float, float]], units: Mapping[str, str], file: str) -> str:
    """That sealed logs are predicted worse than before, and on which channels; empty where no reader sees a rise.

    errors: channel → root mean square before and after; file: the model that is meant by after
    """
    said = []
    for name, pair in errors.items():
        unit, factor = finer(units.get(name, ""), pair[1])
        before, after = (joined(plain(error * factor), unit) for error in pair)
        if before != after:
            said.append(f"of {name} rises from {before} to {after}")
    return f"On the sealed logs the error {' and '.join(said)} with {file}." if said else ""


def calmer(part: str, found: Mapping[str, tuple[float, float]], units: Mapping[str, str]) -> str:
    """That a noise floor is above the error: channel → floor and error."""
    which = "sealed" if part == "validation" else "estimation"
    said = []
    for name, (floor, error) in found.items():
        unit, factor = finer(units.get(name, ""), error)
        said.append(f"{name} {joined(plain(error * factor), unit)} under {joined(plain(floor * factor), unit)}")
    return (
        f"on the {which} logs the error is below its noise floor ({', '.join(said)}): they hold less noise and "
        "disturbance than was estimated, so that the floor is none for them"
    )


def holds(names: Sequence[str], *, fitted: bool) -> str:
    """What nearest.yaml holds: what was added, or nothing; fitted: base parameters are recalibrated."""
    what = (
        f"has {' and '.join(names)}" if names else "is the model recalibrated" if fitted else "is the model as it was"
    )
    return f"nearest.yaml, which predicts logs left out best, {what}."


def follows(signal: str, shape: Shape | None = None) -> str:
    """How a term goes with its signal, and where; `1` is the constant."""
    if shape is None:
        return "is constant" if signal == "1" else f"depends on {signal}"
    place, width = amount(shape.place, shape.unit), amount(shape.width, shape.unit, 2)
    if shape.kind == "spline":
        return f"depends on {signal}, by no simple law"
    how = f", changing at {place}" if shape.kind == "step" else f", most near {place} (width {width})"
    by = f", times {'the ' if shape.well or shape.dry else ''}{shape.factor}" if shape.factor else ""
    return f"depends on {signal}{how}{by}"


def _goes(residual: Mapping[str, Any]) -> str:
    """How what is left goes, by the first of its terms."""
    first = residual["terms"][0] if residual["terms"] else {}
    shape = Shape.of_entry(first["equation"], first["local"]) if first.get("local") else None
    return follows(residual["signals"][0], shape)


def claim(best: Hypothesis, candidates: Sequence[Candidate], subject: Subject) -> str:
    """What these candidates of the best hypothesis are, with their values and intervals."""
    parts: dict[str, list[str]] = {"effect": [], "parameter": [], "sensor": []}
    for c in candidates:
        values = ", ".join(_estimate(best, f, written(subject.declared[f.name].unit)) for f in c.free)
        gone = all(
            abs(best.fit.values[f.name] - f.neutral) <= NORMAL_95 * best.fit.sigma(f.name)
            for f in c.free
            if f.neutral is not None
        )
        note = "; the logs show none" if kind_within(c, subject) != c.kind and gone else ""
        parts[kind_within(c, subject)].append(f"{c.name} ({values}{note})")
    openings = {"effect": "the model lacks", "parameter": "the model has a wrong", "sensor": "the sensors have"}
    text = "; ".join(f"{openings[kind]} {' and '.join(names)}" for kind, names in parts.items() if names)
    moving = (
        "" if best.fit.converged else " The fit was still moving when it was ended: these intervals are too narrow."
    )
    return f"{text[0].upper()}{text[1:]}.{moving}"


def _estimate(best: Hypothesis, f: Free, unit: str) -> str:
    """A parameter with its interval, where that is narrower than its bounds are apart."""
    name, value, half = f.name.rpartition(".")[2], best.fit.values[f.name], NORMAL_95 * best.fit.sigma(f.name)
    if half > f.high - f.low:
        return f"{name} not identified by these logs"
    return f"{name} = {value:.4g} ± {half:.2g} {unit}".rstrip()


def perhaps(names: Sequence[str]) -> str:
    """That something would gain, but too little."""
    return f" (Perhaps {' and '.join(names)}: what that gains may be chance.)" if names else ""


def left_over(term: Unnamed | None, gained: float) -> str:
    """What a claim leaves, where that is plain: how much of the log-likelihood it gained a term without a name adds."""
    if term is None:
        return ""
    more = f"a term without a name promises {percent(term.gain / gained)} of the claim's gain on top"
    return f" Something is left in {term.equation} that {follows(term.signal, term.shape)}: {more}."


def experiment_for(subject: Subject, names: Sequence[str]) -> str:
    """The input that would separate these rivals, as the model says."""
    known = [(len(row & set(names)), text) for row, text in subject.told_apart_by.items()]
    shared, text = max(known, default=(0, ""))
    return text if shared > 1 else usual_experiment(subject)
