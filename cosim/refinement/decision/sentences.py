"""Words of a verdict: `sentence` turns claims and their proof into text.

Each sentence has at most 25 words and names at most three things; refine.json and the report list all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from cosim.core.text import MOST_NAMED, amount, append_unit, counted, finer, join_names, percent, plain, written
from cosim.estimation.subject.candidates import WIDTHS, Candidate, Free, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.claims import NO_EFFECT, Claims
from cosim.refinement.decision.posterior import LITTLE, MISFIT
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.shapes import Shape
from cosim.residuals.residual_statistics import COUNTS_FROM

MOST_WORDS = 25  # of a sentence
NOTHING = "Nothing is missing: the model, recalibrated, explains these logs down to the sensors' noise."
DISTURBED = "Nothing is missing: what the model does not explain is a disturbance that follows no signal."
OUTSIDE, NOT_TRIED = "Something outside the catalogue", "Something that was not tried"
REFUSALS = {
    "interval": "Probable but not claimed, since intervals hold the values without effect: {}.",
    "held out": "Fits to some of the logs predict the others worse with {} than without.",
}
OPENINGS = {  # kind → before up to three names, and in place of more
    "effect": ("the model lacks", "the model lacks {} effects"),
    "parameter": ("the model has a wrong", "the model has {} wrong parameters"),
    "sensor": ("the sensors have", "the sensors have {} errors"),
}


@dataclass(frozen=True)
class Proof:
    """What sealed logs and the study say beside the claims.

    Attributes:
        risen: Channel → error before and after, if it rises significantly on sealed logs.
        remaining: Channel → share of the squared error above the noise floor that remains on sealed logs.
        restricted: Whether the study limits the candidates.
        inputs: Line of a study that takes inputs between rows the other way, if that is clearly likelier.
        written: Whether files of the delivered subject are written.
    """

    risen: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    remaining: Mapping[str, float] = field(default_factory=dict)
    restricted: bool = False
    inputs: str = ""
    written: bool = True


def sentence(c: Claims, subject: Subject, proof: Proof) -> str:
    """Return the verdict in words: a rise on sealed logs, the answer, what remains, the nearest model, remarks."""
    units = {q.name: q.unit for q in subject.outputs}
    name: Literal["refined", "nearest"] = "nearest" if c.claimed is None else "refined"
    file = subject.main_file(name) if proof.written else f"the {name} object"
    texts = (
        rise_text(proof.risen, units, file),  # a reader must know it before the answer
        *_answer_texts(c, subject),
        *_remaining_texts(c, proof, file),
        *_remark_texts(c, subject, proof),
    )
    return " ".join(filter(None, texts))


def _answer_texts(c: Claims, subject: Subject) -> Iterator[str]:
    """Yield the verdict."""
    claimed = c.claimed_candidates
    if c.claimed is not None:
        yield claim_text(c.claimed, claimed, subject)
    if c.name == "ambiguous" and "nothing would show" in c.decision.reasons:
        yield little_excitation_text(len(c.hidden), c.experiment, still=c.still)
    elif c.name == "ambiguous":
        for reason, text in REFUSALS.items():
            if parts := [name for kind, _, name in (r.partition(": ") for r in c.decision.reasons) if kind == reason]:
                yield text.format(join_names(parts))
        if sum(p > 0.0 for p in c.decision.rivals.values()) > 1:
            yield rivals_text(c)
    elif c.name == "no_effect":
        yield no_effect_text(c.hidden, c.moves)
        moved = [
            f"{f.name} {plain(f.prior[0])} → {plain(c.base.fit.values[f.name])}"
            for f in c.base.fit.free
            if f.prior and abs(c.base.fit.values[f.name] - f.prior[0]) > WIDTHS * f.prior[1]
        ]
        if moved:
            yield f"That holds with base parameters beyond their tolerances: {_counted_names(moved, 'parameter')}."
    elif c.name == "unexplained":
        yield _unexplained_text(c, NOT_TRIED if subject.untried else OUTSIDE)
        yield subject.untried
    numbers = [n for n in c.decision.uncertain if n not in c.decision.claimed]
    if c.claimed is not None and c.name != "ambiguous" and numbers:
        chances = [f"{n} ({percent(c.decision.uncertain[n])})" for n in numbers[:MOST_NAMED]]
        yield f"Possible beside this, with its probability: {join_names(chances)}."


def _unexplained_text(c: Claims, something: str) -> str:
    """Return the verdict on what has no name: its equation and signals, or the reason."""
    where, best = c.residual["equation"], sorted(c.decision.nearest)
    nearest = f" Most probable, but not claimed: {join_names(best)}." if best else ""
    if c.residual["signals"]:
        acts = f"acts on {where}; it {_residual_text(c.residual)}" if where else _residual_text(c.residual)
        return f"{something} {acts}.{nearest}"
    if "unknown inputs" in c.decision.reasons:
        name = max(c.moves, key=lambda n: c.moves[n])
        text = f"{something} acts on {name}: an unknown input of {percent(c.moves[name])} of its derivative remains"
        return f"{text}, which follows no signal.{nearest}"
    over = c.decision.misfit.over_floor
    channel = max(over, key=lambda n: over[n], default="")
    if over.get(channel, 0.0) <= COUNTS_FROM:
        return f"{something} is missing: terms without a name improve the fit, but show no stable pattern.{nearest}"
    times = plain(over[channel], 2)
    return f"Replays with the most probable hypothesis miss {channel} by {times} times the noise floor.{nearest}"


def _remaining_texts(c: Claims, proof: Proof, file: str) -> Iterator[str]:
    """Yield sentences on the error that a claim or the nearest model leaves."""
    if c.decision.disputed:
        names = join_names(sorted(c.decision.disputed))
        yield f"Not claimed, since a term without a name may take its place: {names}."
    if c.claimed is not None and c.residual["signals"] and c.decision.misfit.probability < MISFIT:
        where = f" in the equation of {c.residual['equation']}" if c.residual["equation"] else ""
        yield f"Something remains{where}; it {_residual_text(c.residual)}."
    if c.grade == "part" and c.name != "ambiguous" and c.decision.misfit.remains > LITTLE:
        kept = c.decision.misfit.remaining
        channel = max(kept, key=lambda n: kept[n])
        rest = percent(kept[channel])
        yield f"This explains only a part of the error: {rest} of the excess error of {channel} remains in replays."
    if proof.remaining:
        share = sum(proof.remaining.values()) / len(proof.remaining)
        worst = max(proof.remaining, key=lambda n: proof.remaining[n])
        is_recalibrated = c.nearest is not None and not c.nearest.names
        who = f"{file}, the recalibrated model," if is_recalibrated else f"{file}, not claimed,"
        if c.claimed is not None:
            who = "The most probable of these" if c.name == "ambiguous" else "The claim"
        removes = percent(1.0 - share) if share < 1.0 else "nothing"
        yield f"{who} removes {removes} of the given model's squared error above the noise floor on sealed logs."
        if len(proof.remaining) > 1 and LITTLE < share < 1.0:
            yield f"Most of the rest is in {worst}."


def _remark_texts(c: Claims, subject: Subject, proof: Proof) -> Iterator[str]:
    """Yield sentences that follow the verdict."""
    if proof.inputs and c.name == "unexplained":
        yield f"Inputs between rows may be the reason: with {proof.inputs} these logs are likelier."
    for names in c.equivalent:
        yield f"{' or '.join(names)}: these {'two' if len(names) == 2 else len(names)} act alike for every input."
    for (rich, simple), probability in c.decision.not_excluded.items():
        yield f"These logs do not exclude {rich} in place of {simple} ({percent(probability)})."
    if c.grade != "claimed" and c.name != NO_EFFECT:
        file = subject.main_file("nearest") if proof.written else "The nearest object"
        names = c.nearest.names if c.nearest else ()
        content = f"adds {_counted_names(names, 'part')}" if names else "is the given model"
        content += ", recalibrated" if c.nearest and not names else ""
        yield f"{file}, the most probable model that predicts held-out logs no worse than the given one, {content}."
    if proof.restricted:
        yield "Only the candidates that the study names were tried."


def little_excitation_text(effects: int, experiment: str, *, still: bool) -> str:
    """Return sentences on logs that excite too little to show any of the effects, with an experiment."""
    which = "the one effect" if effects == 1 else f"none of {effects} effects"
    opening = "Nothing moves in these logs" if still else "These logs excite too little"
    would, them = ("would not", "it") if effects == 1 else ("would", "them")
    return f"{opening}: {which} {would} show in them, present or not. An experiment that shows {them}: {experiment}."


def no_effect_text(hidden: Sequence[str], moves: Mapping[str, float]) -> str:
    """Return the verdict for logs without a missing effect.

    Args:
        moves: Forced state → size of its unknown input relative to its derivative.
    """
    sizes = [f"{percent(share)} of the derivative of {name}" for name, share in moves.items()]
    text = f"{DISTURBED} Its size: {join_names(sizes)}." if sizes else NOTHING
    return f"{text} These logs would not show {_counted_names(hidden, 'effect')}." if hidden else text


def _counted_names(names: Sequence[str], noun: str) -> str:
    """Return up to three names, or more with their number."""
    return join_names(names) if len(names) <= MOST_NAMED else f"{counted(len(names), noun)}: {join_names(names)}"


def rivals_text(c: Claims) -> str:
    """Return sentences on undecided rivals and an experiment."""
    common = frozenset[str].intersection(*c.decision.rivals)
    names = []
    for parts, probability in c.decision.rivals.items():
        own = sorted(parts - common)
        name = (
            "nothing more" if not own else join_names(own) if len(own) <= MOST_NAMED else f"a set of {len(own)} parts"
        )
        names.append(f"{name} ({percent(probability)})")
    opening = "Beside this, these logs" if c.claimed is not None else "These logs"
    apart = f"cannot decide between {_counted_names(names, 'hypothesis')}"
    if len(names) == 2:
        apart = f"cannot tell {names[0]} from {names[1]}"
        if common in c.decision.rivals:
            doubtful = next(name for name in names if not name.startswith("nothing more"))
            apart = f"decide neither for nor against {doubtful}"
    text = f"{opening} {apart}. An experiment that may decide: {c.experiment}."
    return f"{text} `cosim excite` designs it, and says whether any would."


def rise_text(errors: Mapping[str, tuple[float, float]], units: Mapping[str, str], file: str) -> str:
    """Return a sentence on channels whose error rises on sealed logs; "" if no rise shows in the rounded values.

    Args:
        errors: Channel → root mean square error before and after.
        file: Name of the refined or nearest model.
    """
    changes = {}
    for name, pair in errors.items():
        unit, factor = finer(units.get(name, ""), pair[1])
        before, after = (append_unit(plain(error * factor), unit) for error in pair)
        if before != after:
            changes[name] = f"of {name} rises from {before} to {after}"
    if not changes:
        return ""
    first, *others = changes
    also = f" So does the error of {join_names(others)}." if others else ""
    return f"On the sealed logs the error {changes[first]} with {file}.{also}"


def floor_warning(part: str, channels: Mapping[str, tuple[float, float]], units: Mapping[str, str]) -> str:
    """Return a warning of a noise floor above the error.

    Args:
        channels: Channel → floor and error.
    """
    pairs = []
    for name, (floor, error) in channels.items():
        unit, factor = finer(units.get(name, ""), error)
        pairs.append(
            f"{name} {append_unit(plain(error * factor), unit)} under {append_unit(plain(floor * factor), unit)}"
        )
    logs = "sealed" if part == "validation" else "estimation"
    return (
        f"on the {logs} logs the error is below its noise floor ({', '.join(pairs)}). These logs hold less noise "
        "and disturbance than was estimated, so the floor does not apply to them"
    )


def dependence_text(signal: str, shape: Shape | None = None, like: str = "") -> str:
    """Return a phrase on the dependence of a term on its signal.

    Args:
        signal: `1` for the constant.
        like: Law that the shape resembles.
    """
    if shape is None:
        return "is constant" if signal == "1" else f"depends on {signal}"
    if like:
        return f"depends on {signal}, like {like}"
    place, width = amount(shape.place, shape.unit), amount(shape.width, shape.unit, 2)
    if shape.kind == "spline":
        return f"depends on {signal}, by no simple law"
    how = f", changing at {place}" if shape.kind == "step" else f", most near {place} (width {width})"
    by = f", times {shape.factor}" if shape.factor else ""
    return f"depends on {signal}{how}{by}"


def _residual_text(residual: Mapping[str, Any]) -> str:
    """Return a phrase on the dependence of the residual on a signal, from its first term."""
    first = residual["terms"][0] if residual["terms"] else {}
    shape = Shape.of_entry(first["equation"], first["local"]) if first.get("local") else None
    return dependence_text(residual["signals"][0], shape, first.get("like", ""))


def claim_text(best: Hypothesis, candidates: Sequence[Candidate], subject: Subject) -> str:
    """Return sentences on claimed candidates with values and intervals."""
    kinds = {c.name: kind_within(c, subject) for c in candidates}
    values = {c.name: [_estimate_text(best, f, subject) for f in c.free] for c in candidates}
    text = _kinds_text(kinds, {name: f"{name} ({', '.join(parts)})" for name, parts in values.items()})
    if len(candidates) > MOST_NAMED or len(text.split()) > MOST_WORDS:
        sentences = [
            f"{name}: {', '.join(parts[first : first + MOST_NAMED])}."
            for name, parts in values.items()
            for first in range(0, len(parts), MOST_NAMED)
        ]
        text = " ".join((_kinds_text(kinds, {name: name for name in values}), *sentences))
    moving = " The fit was still moving when it ended: these intervals are too narrow."
    return f"{text}{'' if best.fit.converged else moving}"


def _kinds_text(kinds: Mapping[str, str], texts: Mapping[str, str]) -> str:
    """Return a phrase for each kind of claimed candidate, with names or, for more than three, their number."""
    parts = []
    for kind, (opening, several) in OPENINGS.items():
        names = [text for name, text in texts.items() if kinds[name] == kind]
        if names:
            parts.append(several.format(len(names)) if len(names) > MOST_NAMED else f"{opening} {join_names(names)}")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def _estimate_text(best: Hypothesis, f: Free, subject: Subject) -> str:
    """Return a parameter with its 95 % interval, unless the interval is wider than the allowed range."""
    name, value, half = f.name.rpartition(".")[2], best.fit.values[f.name], NORMAL_95 * best.fit.sigma(f.name)
    unit = written(subject.declared[f.name].unit)
    if half > f.high - f.low:
        return f"{name} not identified by these logs"
    if f.name in best.fit.regions:
        region = best.fit.regions[f.name]
        low, high = (f"{limit:.2g} {unit}".rstrip() for limit in region)
        if region[0] <= f.low:
            return f"{name} at most {high}"
        return f"{name} at least {low}" if region[1] >= f.high else f"{name} between {low} and {high}"
    digits = max(4, min(math.floor(math.log10(abs(value) / half)) + 3, 12)) if value and half else 4
    return f"{name} = {value:.{digits}g} ± {half:.2g} {unit}".rstrip()
