"""The words of a verdict, from its facts alone: `sentence` is called once, when all facts are known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cosim.base.text import amount, finer, joined, percent, plain, size, written
from cosim.loading.refined import NEAREST, REFINED
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.claims import Claims, Doubt, Moved
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.shapes import Shape
from cosim.refinement.search.unnamed import Unnamed
from cosim.subject.base_parameters import kind_within
from cosim.subject.candidates import Candidate, Free
from cosim.subject.interface import Subject

LITTLE = 0.05  # of what is missing, below which a term is no account of it
NOTHING = "Nothing is missing: the model, within its tolerances, explains these logs down to the sensors' noise."
NO_HYPOTHESIS = "No hypothesis holds on logs it was not fitted on."
NOT_AFTER_REPLAYS = "No hypothesis explains what the model misses."


def sentence(c: Claims, subject: Subject) -> str:
    """Return the verdict in words: what rises on sealed logs, what is claimed of how much, what comes nearest."""
    return " ".join((*_prefaces(c, subject), _answer(c, subject), *_remarks(c, subject)))


def _prefaces(c: Claims, subject: Subject) -> Iterator[str]:
    """Sentences before the answer: a rise on sealed logs, and that a claim is of a part only."""
    units = {q.name: q.unit for q in subject.outputs}
    files = (REFINED[0], NEAREST[0]) if c.written else ("the refined object", "the nearest object")
    if rise := rises(c.risen, units, files[c.claimed is None]):
        yield rise
    if c.left_share is not None and c.left_of is not None:
        of = f"the mean square error of {c.left_of[0]}, as the model recalibrated has it, is left"
        yield part(c.residual, f"{percent(c.left_share)} of {of}")
    if c.part is not None:
        yield part(c.misfit, f"replays keep {percent(c.part.share)} of the excess error of {c.part.channel}")
    if c.disturbed:
        moved = f"an unknown input of {percent(c.moves[c.disturbed])} of what moves {c.disturbed}"
        yield f"A part of what is missing: beside it {moved} is left."


def _answer(c: Claims, subject: Subject) -> str:
    """The answer itself."""
    if c.name == "ambiguous" and c.claimed is None:
        return excites_too_little(len(c.unshown), c.experiment, still=c.still)
    if c.name == "ambiguous" and c.claimed is not None:
        certain = claim(c.claimed, c.certain, subject) if c.certain else ""
        return cannot_tell(c.apart, c.experiment, certain, subject)
    if c.name == "no_effect":
        return nothing(c.unshown, c.moves) + perhaps(c.small)
    if c.claimed is not None:
        left = left_over(c.beside, c.gained) + further(c.further)
        return claim(c.claimed, c.claimed.candidates, subject) + perhaps(c.small) + left
    if c.missed is not None:
        return misses(*c.missed, c.recalibrated)
    if c.doubt is not None:
        return f"{unexplained(c.misfit, c.rivals, NOT_AFTER_REPLAYS)} {doubted(c.doubt)}"
    return unexplained(c.residual, c.rivals)


def _remarks(c: Claims, subject: Subject) -> Iterator[str]:
    """Sentences after the answer: what is left of a table, the nearest model, what was tried, rows left out."""
    if c.left_of is not None and c.claimed is not None and c.left_share is None:
        output, signal = c.left_of
        yield f"Something is left of {output} that {follows(signal)}."
    if c.nearest is not None:
        file = NEAREST[0] if c.written else "The nearest object"
        yield holds(c.nearest.names, fitted=c.nearest.hypothesis is not None, file=file)
    if c.restricted:
        yield "(Tried: only what the study names as candidates.)"
    if c.left_out:
        yield on_rows_left_out(c, subject)


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


def unexplained(residual: Mapping[str, Any], nearest: Sequence[str], otherwise: str = NO_HYPOTHESIS) -> str:
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


def doubted(doubt: Doubt) -> str:
    """Why a claim was withdrawn after replays."""
    if doubt.kind == "missed":
        return f"With it, replays still miss {doubt.channel} by {plain(doubt.size, 2)} times what noise makes."
    if doubt.kind == "no_nearer":
        return "Replays with it are nearer on no channel than those of the model recalibrated without it."
    if doubt.kind == "kept":
        return f"With it, replays keep {plain(100 * doubt.size, 2)}\u00a0% of the excess error."
    return f"Much is left, and predictions of logs left out are not plainly better for {' and '.join(doubt.names)}."


def part(residual: Mapping[str, Any], left: str) -> str:
    """That a claim is a part of what is missing: what is left, and where that acts."""
    where = f" acts on {residual['equation']}" if residual["equation"] else " has no place in the equations"
    on = f" and {_goes(residual)}" if residual["signals"] else ""
    return f"A part of what is missing: {left}, and the rest{where}{on}."


def misses(channel: str, times: float, recalibrated: Sequence[Moved]) -> str:
    """By how much the model as it stands misses a channel, and how far recalibration had to go to mend that."""
    moved = ", ".join(map(_moved, recalibrated))
    further = f"; recalibrated further than a data sheet is off ({moved}) it does not" if moved else ""
    return (
        f"The model as it stands misses {channel} by {plain(times, 2)} times what noise makes{further}. "
        "No candidate accounts for that."
    )


def further(moved: Sequence[Moved]) -> str:
    """That other numbers come out beyond their tolerances beside a claim."""
    verb = "is" if len(moved) == 1 else "are"
    return f" Beside it, {' and '.join(map(_moved, moved))} {verb} further off than stated." if moved else ""


def _moved(m: Moved) -> str:
    return f"{m.name} {plain(m.stated)} → {plain(m.fitted)}"


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


def holds(names: Sequence[str], *, fitted: bool, file: str = NEAREST[0]) -> str:
    """What the nearest model holds: what was added, or nothing; fitted: base parameters are recalibrated."""
    what = f"has {' and '.join(names)}" if names else f"is the model {'recalibrated' if fitted else 'as it was'}"
    return f"{file}, which predicts logs left out best, {what}."


def on_rows_left_out(c: Claims, subject: Subject) -> str:
    """The errors on rows left out, in words: of what is claimed, or of the model recalibrated, and without it."""
    units, errors = {q.name: q.unit for q in subject.outputs}, c.left_out or {}
    effect = c.claimed is not None and any(part.kind != "parameter" for part in c.claimed.candidates)
    best, other = ("after", "recalibrated") if effect else ("recalibrated", "before")
    who, without = ("the model", "without it") if effect else ("the model recalibrated", "as it is")
    missed = " and ".join(f"{size(v, units[n])} in {n}" for n, v in errors[best].items())
    before = " and ".join(size(v, units[n]) for n, v in errors[other].items())
    return f"On rows left out, fitted to the others, {who} is off by {missed}; {without}, by {before}."


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
        kind = kind_within(c, subject)
        note = "; the logs show none" if kind != c.kind and not best.is_away(c, NORMAL_95) else ""
        parts[kind].append(f"{c.name} ({values}{note})")
    openings = {"effect": "the model lacks", "parameter": "the model has a wrong", "sensor": "the sensors have"}
    text = "; ".join(f"{openings[kind]} {' and '.join(names)}" for kind, names in parts.items() if names)
    moving = " The fit was still moving when it was ended: these intervals are too narrow."
    return f"{text[0].upper()}{text[1:]}.{'' if best.fit.converged else moving}"


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
