"""Words of a verdict: `sentence` turns the complete facts into text.

Each sentence has at most 25 words and names at most three things; refine.json and the report list all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Literal

from cosim.core.text import MOST_NAMED, amount, append_unit, counted, finer, join_names, percent, plain, written
from cosim.estimation.subject.candidates import Candidate, Free, kind_within
from cosim.estimation.subject.interface import Subject
from cosim.fmi.building.refined import NEAREST
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.claims import Claims, Doubt, Improvement, MovedParameter, Nearest, NotExcluded
from cosim.refinement.search.hypotheses import Hypothesis
from cosim.refinement.search.shapes import Shape
from cosim.refinement.search.unnamed import UnnamedTerm

LITTLE = 0.05  # of what is missing, below which a term is no account of it
MOST_WORDS = 25  # of a sentence
NEARLY_ALL = 0.95  # share from which the exact number says nothing more, as it may exceed 1
NOTHING = "Nothing is missing: the model, within its tolerances, explains these logs down to the sensors' noise."
DISTURBED = "Nothing is missing: what the model does not explain is a disturbance that follows no signal."
NO_HYPOTHESIS = "No hypothesis holds on logs it was not fitted on."
NOT_AFTER_REPLAYS = "No hypothesis explains what the model misses."
UNJUDGED = "Replays do not test {}: two runs of the refined model with noise may differ as much there."
DIVIDED = "Sealed logs do not test {}: noise and estimates within their intervals may make as much error there."
IN_PART = "This explains only a part of the error"
OUTSIDE, NOT_TRIED = "Something outside the catalogue", "Something that was not tried"
NO_TERM = "no term in a state, an input or time explains even"


def sentence(c: Claims, subject: Subject) -> str:
    """Return the verdict in words: improvement or rise on sealed logs, claim, dispute, remainder, nearest model."""
    units = {q.name: q.unit for q in subject.outputs}
    name: Literal["refined", "nearest"] = "nearest" if c.claimed is None else "refined"
    rise = rise_text(
        c.risen, units, subject.main_file(name) if c.written else f"the {name} object"
    )  # a reader must know it before the answer
    opening = rise or _improvement_text(c)
    untried = subject.untried if c.claimed is not None or c.name == "unexplained" else ""
    missed = (missed_by_all_text(*miss) for miss in c.missed.items())
    shares = *_share_texts(c, _units(subject)), *missed
    texts = (opening, _answer_text(c, subject), *shares, _inputs_text(c), untried, *_remark_texts(c, subject))
    return " ".join(filter(None, texts))


REFERENCES = {"before": "unchanged", "recalibrated": "recalibrated"}  # model for comparison → its name in a sentence


def _improvement_text(c: Claims) -> str:
    """Return sentences on the improvement by a claim, or without one, by the nearest model."""
    if c.improvement is None:
        return ""
    if c.claimed_candidates:
        disputed = c.name == "ambiguous"
        names = c.claimed.names if c.claimed is not None and not disputed else ()
        return improvement_text(c.improvement, names, "The first hypothesis" if disputed else "The claim")
    if c.nearest is None or (c.name == "ambiguous" and not c.improvement.is_clear):
        return ""
    text = nearest_improvement_text(c.improvement, c.nearest)
    is_refused = c.name == "unexplained" and c.nearest.names
    return f"{text} It is not claimed{f' ({c.nearest.why})' if c.nearest.why else ''}." if is_refused else text


def nearest_improvement_text(i: Improvement, nearest: Nearest) -> str:
    """Return sentences on the share of squared error that the nearest model removes, or that remains.

    Args:
        i: Improvement by the nearest model; by the best other one if the given model is the nearest.
    """
    error = f"the {REFERENCES[i.baseline]} model's squared error{' above the noise floor' if i.is_excess else ''}"
    if nearest.hypothesis is None:
        better = f"No model that was tried predicts {i.logs} logs clearly better than the unchanged one"
        return f"{better}; the best leaves {percent(i.share)} of its squared error."
    names = nearest.names
    who = "The nearest model" if names else "The recalibrated model"
    if names:
        who += f", with {len(names)} candidates," if len(names) > MOST_NAMED else f" ({join_names(names)})"
    if not i.share < 1.0:
        return f"{who} improves nothing on {i.logs} logs: {percent(i.share)} of {error} remain."
    if i.share == 0.0:
        return f"{who} removes {error} on {i.logs} logs."
    chance = "" if i.is_clear else ", perhaps by chance"
    rest = f" It leaves {percent(i.share)}, mostly in {i.worst}." if i.worst else ""
    return f"{who} removes {percent(1.0 - i.share)} of {error} on {i.logs} logs{chance}.{rest}"


def improvement_text(i: Improvement, names: Sequence[str] = (), whole: str = "The claim") -> str:
    """Return a sentence on the share of squared error on sealed logs that a claim explains.

    Args:
        names: Claimed candidates, at most three of which are named.
        whole: Subject of the sentence without names.
    """
    share = i.share
    if not share < 1.0:
        return ""
    worst = f", mostly in {i.worst}" if i.worst else ""
    above = " above the noise floor" if i.is_excess else ""
    error = f"the squared error{above} that the {REFERENCES[i.baseline]} model has"
    is_named = 0 < len(names) <= MOST_NAMED
    verb = "explain" if is_named and len(names) > 1 else "explains"
    who = join_names(names) if is_named else whole
    if share == 0.0:
        return f"{who} {verb} {error} on sealed logs."
    return f"{who} {verb} {percent(1.0 - share)} of {error} on sealed logs; {percent(share)} remain{worst}."


def _answer_text(c: Claims, subject: Subject) -> str:
    """Return the text of the verdict without remarks."""
    something = NOT_TRIED if subject.untried else OUTSIDE
    if c.name == "ambiguous" and c.claimed is None:
        return little_excitation_text(len(c.unshown), c.experiment, still=c.still)
    if c.name == "ambiguous" and c.claimed is not None:
        certain = claim_text(c.claimed, c.certain, subject, is_doubtful=c.is_doubtful) if c.certain else ""
        return rivals_text(c.apart, c.experiment, certain)
    if c.name == "no_effect":
        return no_effect_text(c.unshown, c.moves) + small_gains_text(c.small)
    if c.claimed is not None:
        text = claim_text(c.claimed, c.claimed.candidates, subject, is_doubtful=c.is_doubtful)
        return text + small_gains_text(c.small)
    if c.missed_channel is not None:
        return missed_channel_text(*c.missed_channel, c.recalibrated, _units(subject))
    if c.doubt is not None and c.doubt.kind in ("varying", "refused"):
        return f"{doubt_text(c.doubt, _units(subject))} Best candidates, not confirmed: {join_names(c.rivals)}."
    if c.doubt is not None:
        doubt = doubt_text(c.doubt, _units(subject))
        return f"{unexplained_text(c.misfit, c.rivals, NOT_AFTER_REPLAYS, something)} {doubt}"
    return unexplained_text(c.misfit, c.rivals, something=something)


def _share_texts(c: Claims, units: Mapping[str, str]) -> Iterator[str]:
    """Yield sentences on the unexplained share of the error."""
    if c.part is not None and c.part.sealed:
        kept = "nearly all" if c.part.share >= NEARLY_ALL else percent(c.part.share)
        yield f"{IN_PART}: on sealed logs replays keep {kept} of the excess error of {c.part.channel}."
    elif c.divided:
        yield DIVIDED.format(c.divided)
    elif c.unjudged:
        yield UNJUDGED.format(c.unjudged)
    elif c.part is not None:
        yield part_text(c.misfit, f"replays keep {percent(c.part.share)} of the excess error of {c.part.channel}")
    if incomplete := [*_incomplete_texts(c, units)]:
        yield f"{IN_PART}: {'; '.join(incomplete)}."
    if c.varying is not None and not c.claimed_candidates:
        yield doubt_text(c.varying, units)


def _inputs_text(c: Claims) -> str:
    """Return a sentence on inputs between rows, or ""."""
    is_reason = c.inputs and (c.name == "unexplained" or c.is_doubtful)
    return (
        f"Inputs between rows may be the reason of what remains: with {c.inputs} these logs are likelier."
        if is_reason
        else ""
    )


def _incomplete_texts(c: Claims, units: Mapping[str, str]) -> Iterator[str]:
    """Yield phrases on the signs of an incomplete claim."""
    if c.disturbed:
        yield f"an unknown input of {percent(c.moves[c.disturbed])} of the derivative of {c.disturbed} remains"
    elif c.replaced and c.claimed is not None:
        yield f"a term without a name may take the place of {join_names(c.replaced)}"
    if c.disagreeing and c.claimed is not None:
        yield _other_values_text(c.disagreeing)
    if c.beside and c.claimed is not None:
        yield f"beside it, {_counted_names(c.beside, 'candidate')} could not be confirmed"
    if c.varying is not None and c.claimed_candidates:
        yield _varying_text(c.varying, units)


def _remark_texts(c: Claims, subject: Subject) -> Iterator[str]:
    """Yield sentences to follow the verdict."""
    yield from map(alike_text, c.namesakes)
    yield from map(not_excluded_text, c.not_excluded)
    if c.claimed is not None and c.term is not None:
        yield remainder_text(c.term, c.gained)
    if c.claimed is not None and c.further:
        yield further_text(c.further, _units(subject), is_doubtful=c.is_doubtful)
    if c.nearest is not None:
        file = subject.main_file("nearest") if c.written else "The nearest object"
        same = c.claimed is None and c.nearest.names == c.rivals and c.name == "unexplained"
        moved = _moved_text(c.nearest.moved, _units(subject))
        yield nearest_text(c.nearest.names, fitted=c.nearest.hypothesis is not None, file=file, same=same, moved=moved)
    if c.restricted:
        yield "Only the candidates that the study names were tried."


def alike_text(names: Sequence[str]) -> str:
    """Return a sentence on names that act alike for every input."""
    return f"{' or '.join(names)}: these {'two' if len(names) == 2 else len(names)} act alike for every input."


def not_excluded_text(other: NotExcluded) -> str:
    """Return a sentence on a richer effect."""
    value = append_unit(f"{other.parameter} up to {plain(other.up_to, 2)}", written(other.unit))
    return f"These logs do not exclude {other.name} in place of {other.in_place_of}, with {value}."


def _units(subject: Subject) -> Mapping[str, str]:
    """Return the unit of each parameter."""
    return {name: p.unit for name, p in subject.declared.items()}


def little_excitation_text(effects: int, experiment: str, *, still: bool) -> str:
    """Return a sentence on logs that excite too little to show any of the effects, with an experiment."""
    which = "the one effect" if effects == 1 else f"none of {effects} effects"
    opening = "Nothing moves in these logs" if still else "These logs excite too little"
    would = "would not" if effects == 1 else "would"
    return (
        f"{opening}: {which} {would} show in them, present or not. "
        f"An experiment that shows {'it' if effects == 1 else 'them'}: {experiment}."
    )


def no_effect_text(hidden: Sequence[str], moves: Mapping[str, float]) -> str:
    """Return the verdict for logs without a missing effect.

    It states the size of an unknown input, and the number of effects that these logs would not show.

    Args:
        moves: Forced state → RMS of its unknown input relative to the RMS of its derivative, where available.
    """
    sizes = [f"{percent(share)} of the derivative of {name}" for name, share in moves.items()]
    text = f"{DISTURBED} Its size: {join_names(sizes)}." if sizes else NOTHING
    return f"{text} These logs would not show {_counted_names(hidden, 'effect')}." if hidden else text


def _counted_names(names: Sequence[str], noun: str) -> str:
    """Return up to three names, or more with their number."""
    return join_names(names) if len(names) <= MOST_NAMED else f"{counted(len(names), noun)}: {join_names(names)}"


def rivals_text(names: Sequence[str], experiment: str, certain: str) -> str:
    """Return a sentence on undecided rivals and an experiment.

    Args:
        names: Rival hypotheses.
        certain: Sentence on the candidates common to all rivals, or "".
    """
    opening = f"{certain} Beside this, these logs" if certain else "These logs"
    many = f"decide between {_counted_names(names, 'hypothesis')}"
    apart = f"tell {names[0]} from {names[1]}" if len(names) == 2 else many
    text = f"{opening} cannot {apart}. An experiment that may decide: {experiment}."
    return f"{text} `cosim excite` designs it, and says whether any would."


def unexplained_text(
    residual: Mapping[str, Any], nearest: Sequence[str], otherwise: str = NO_HYPOTHESIS, something: str = OUTSIDE
) -> str:
    """Return the verdict on an unnamed effect: its equation, its signals and the nearest hypotheses."""
    where = residual["equation"]
    if residual["signals"]:
        acts = f"acts on {where}; it {_residual_text(residual)}"
        unplaced = f"{_residual_text(residual)}; on what it acts, the logs do not agree"
        text = f"{something} {acts if where else unplaced}."
        # a term may promise likelihood where noise, not its own share, fills what is missing
        if share := residual["share"]:
            who = NO_TERM.capitalize() if share < LITTLE else "This dependence explains"
            text += f" {who} {percent(max(share, LITTLE))} of what is missing."
    elif where:
        text = "The remaining error shows no stable pattern."
    else:
        text = otherwise
    return text + (f" Best candidates, not confirmed: {join_names(nearest)}." if nearest else "")


def doubt_text(doubt: Doubt, units: Mapping[str, str]) -> str:
    """Return a sentence on why a claim was withdrawn."""
    if doubt.kind == "missed":
        return f"With it, replays still miss {doubt.channel} by {plain(doubt.size, 2)} times the noise floor."
    if doubt.kind == "no_nearer":
        return "Replays with it are nearer on no channel than those of the model without it."
    if doubt.kind == "kept":
        return f"With it, replays keep {plain(100 * doubt.size, 2)}\u00a0% of the excess error."
    if doubt.kind == "disturbed":
        remains = f"Beside this remains an unknown input of {percent(doubt.size)} of the derivative of {doubt.channel}"
        return f"{remains}; no effect in it halves the held-out error."
    if doubt.kind == "replaced":
        return "Terms without a name may take its place."
    if doubt.kind == "varying":
        return f"Something is missing beside {doubt.names[0]}: {_varying_text(doubt, units)}."
    if doubt.kind == "refused":
        return f"{doubt.names[0]} explains far more than chance would, but {doubt.reason}."
    if doubt.kind == "disagreeing":
        return f"A filter and predictions disagree: {_other_values_text(doubt.names)}."
    return f"Much remains, and predictions of held-out logs are not plainly better for {join_names(doubt.names)}."


def _varying_text(doubt: Doubt, units: Mapping[str, str]) -> str:
    (name,), (weak, strong) = doubt.names, doubt.estimates
    lower, upper = (append_unit(f"{value:.3g}", written(units.get(name, ""))) for value in (weak, strong))
    return f"{name} is {lower} from rows in which it acts little, and {upper} from those in which it acts much"


def _other_values_text(names: Sequence[str]) -> str:
    return f"predictions of held-out logs are clearly better with other values of {join_names(names)}"


def part_text(residual: Mapping[str, Any], rest: str) -> str:
    """Return sentences on a claim that explains only part of the error: the remaining share and its place.

    Args:
        rest: Phrase on the remaining share.
    """
    where = f"acts on {residual['equation']}" if residual["equation"] else "has no place in the equations"
    on = f" and {_residual_text(residual)}" if residual["signals"] else ""
    return f"{IN_PART}: {rest}. The rest {where}{on}."


def missed_channel_text(
    channel: str, times: float, recalibrated: Sequence[MovedParameter], units: Mapping[str, str]
) -> str:
    """Return sentences on a channel missed by the unchanged model.

    Args:
        times: Error as a multiple of the noise floor.
        recalibrated: Base parameters that had to leave their tolerances to reduce this error.
    """
    text = f"The model as it stands misses {channel} by {plain(times, 2)} times the noise floor."
    if recalibrated:
        text += f" Recalibrated beyond its tolerances it does not: {_moved_text(recalibrated, units)}."
    return f"{text} No candidate accounts for that."


def missed_by_all_text(channel: str, times: float) -> str:
    """Return a sentence on sealed logs that every rival misses: channel and multiple of the noise floor of the best."""
    return f"Every rival misses the sealed logs: the best misses {channel} by {plain(times, 2)} times the noise floor."


def further_text(parameters: Sequence[MovedParameter], units: Mapping[str, str], *, is_doubtful: bool = False) -> str:
    """Return a sentence on further parameters outside their tolerances."""
    doubt = "; something else is missing, or a tolerance is too small" if is_doubtful else ""
    return f"Beside this, recalibrated beyond tolerance: {_moved_text(parameters, units)}{doubt}."


def _moved_text(parameters: Sequence[MovedParameter], units: Mapping[str, str]) -> str:
    texts = [
        f"{m.name} {plain(m.stated)} → {plain(m.fitted)} {written(units.get(m.name, ''))}".rstrip()
        for m in parameters[:MOST_NAMED]
    ]
    more = len(parameters) - len(texts)
    return join_names([*texts, *([f"{more} more"] if more else [])])


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


def nearest_text(
    names: Sequence[str], *, fitted: bool, file: str = NEAREST[0], same: bool = False, moved: str = ""
) -> str:
    """Return a sentence on the nearest model's content.

    Args:
        moved: Base parameters that were recalibrated beyond their tolerances, in words.
        fitted: Whether base parameters are recalibrated.
        same: Whether the candidates are those of the previous sentence.
    """
    content = f"contains {'them' if same else _counted_names(names, 'candidate')}"
    if not names:
        content = f"is the model {'recalibrated' if fitted else 'as it was'}"
        content += f", beyond tolerance: {moved}" if moved else ""
    return f"{file} predicts held-out logs best; it {content}."


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
    by = f", times {'the ' if shape.well or shape.dry else ''}{shape.factor}" if shape.factor else ""
    return f"depends on {signal}{how}{by}"


def _residual_text(residual: Mapping[str, Any]) -> str:
    """Return a phrase on the dependence of the residual on a signal, from its first term."""
    first = residual["terms"][0] if residual["terms"] else {}
    shape = Shape.of_entry(first["equation"], first["local"]) if first.get("local") else None
    return dependence_text(residual["signals"][0], shape, first.get("like", ""))


OPENINGS = {  # kind → before up to three names, and in place of more
    "effect": ("the model lacks", "the model lacks {} effects"),
    "parameter": ("the model has a wrong", "the model has {} wrong parameters"),
    "sensor": ("the sensors have", "the sensors have {} errors"),
}
RESEMBLING = {  # the same where a claim may only imitate what is missing
    "effect": ("what the model lacks resembles", "what the model lacks resembles {} effects"),
    "parameter": ("what is wrong resembles another", "what is wrong resembles other values of {} parameters"),
    "sensor": ("the sensors seem to have", "the sensors seem to have {} errors"),
}


def claim_text(
    best: Hypothesis, candidates: Sequence[Candidate], subject: Subject, *, is_doubtful: bool = False
) -> str:
    """Return sentences on claimed candidates with values and intervals.

    Args:
        is_doubtful: Say that they resemble what is missing.
    """
    openings = RESEMBLING if is_doubtful else OPENINGS
    kinds = {c.name: kind_within(c, subject) for c in candidates}
    values = {c.name: [_estimate_text(best, f, subject) for f in c.free] for c in candidates}
    for c in candidates:
        if kinds[c.name] != c.kind and not best.is_away(c, NORMAL_95):
            values[c.name][-1] += "; the logs show none"
    text = _kinds_text(kinds, {name: f"{name} ({', '.join(parts)})" for name, parts in values.items()}, openings)
    if len(candidates) > MOST_NAMED or len(text.split()) > MOST_WORDS:
        sentences = chain(*map(_value_sentences, values.items()))
        text = " ".join((_kinds_text(kinds, {name: name for name in values}, openings), *sentences))
    moving = " The fit was still moving when it ended: these intervals are too narrow."
    return f"{text}{'' if best.fit.converged else moving}"


def _kinds_text(kinds: Mapping[str, str], texts: Mapping[str, str], openings: Mapping[str, tuple[str, str]]) -> str:
    """Return a phrase for each kind of claimed candidate, with names or, for more than three, their number."""
    parts = []
    for kind, (opening, several) in openings.items():
        names = [text for name, text in texts.items() if kinds[name] == kind]
        if names:
            parts.append(several.format(len(names)) if len(names) > MOST_NAMED else f"{opening} {join_names(names)}")
    text = "; ".join(parts)
    return f"{text[:1].upper()}{text[1:]}."


def _value_sentences(entry: tuple[str, Sequence[str]]) -> Iterator[str]:
    """Yield the values of a candidate, at most three in a sentence."""
    name, values = entry
    for first in range(0, len(values), MOST_NAMED):
        yield f"{name}: {', '.join(values[first : first + MOST_NAMED])}."


def _estimate_text(best: Hypothesis, f: Free, subject: Subject) -> str:
    """Return a parameter with its 95 % interval, unless the interval is wider than the allowed range."""
    name, value, half = f.name.rpartition(".")[2], best.fit.values[f.name], NORMAL_95 * best.fit.sigma(f.name)
    if half > f.high - f.low:
        return f"{name} not identified by these logs"
    if f.name in best.fit.regions:
        return f"{name} {_region_text(best.fit.regions[f.name], f, written(subject.declared[f.name].unit))}"
    digits = max(4, min(math.floor(math.log10(abs(value) / half)) + 3, 12)) if value and half else 4
    return f"{name} = {value:.{digits}g} ± {half:.2g} {written(subject.declared[f.name].unit)}".rstrip()


def _region_text(region: tuple[float, float], f: Free, unit: str) -> str:
    """Return the region of a parameter within which the logs do not distinguish its values."""
    low, high = (f"{limit:.2g} {unit}".rstrip() for limit in region)
    if region[0] <= f.low:
        return f"at most {high}"
    return f"at least {low}" if region[1] >= f.high else f"between {low} and {high}"


def small_gains_text(names: Sequence[str]) -> str:
    """Return a sentence on gains that may be chance."""
    return f" Perhaps also {join_names(names)}; that gain may be chance." if names else ""


def remainder_text(term: UnnamedTerm, gained: float) -> str:
    """Return sentences on an unnamed term beside a claim."""
    if term.share is not None and term.share < LITTLE:
        return f"Something remains in the equation of {term.equation}; {NO_TERM} {percent(LITTLE)} of it."
    depends = dependence_text(term.signal, term.shape, term.like)
    rest = f"Something remains in the equation of {term.equation} that {depends}."
    return f"{rest} A term without a name would add {percent(term.gain / gained)} to the claim's gain."
