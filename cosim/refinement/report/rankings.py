"""Tables of the report: hypotheses, parameters and process noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.core.text import amount, append_unit, counted, display, percent, plain
from cosim.estimation.subject.candidates import Free
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.proof.refined_models import refined_subject
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.hypotheses import Hypothesis

SHOWN_SINGLES = 8
SHOWN_PAIRS = 15
FEW = 3  # held-out logs or parts up to which a standard error is only a rough number
LADDER_NOTE = (
    "{part} is predicted by a fit to the rest; the error (root mean square) is relative to the model of the study. The "
    "last column is the standard error of the difference from the best: within it, a model with fewer candidates is as "
    "good."
)
TOLERANCE = (
    "± is the tolerance of the data sheet; a parameter is wrong only if its whole interval lies outside the tolerance."
)


@dataclass(frozen=True)
class RankingRow:
    """A hypothesis in the ranking, as texts."""

    names: str
    gain: str
    width: float
    fitted: str
    why: str
    claimed: bool


@dataclass(frozen=True)
class LadderRow:
    """A model and the error of its predictions of held-out logs relative to the model of the study."""

    names: str
    count: int
    error: str
    width: float
    scatter: str
    chosen: bool


@dataclass(frozen=True)
class ParameterRow:
    """An estimate with its interval, and its position between neutral and bounds."""

    name: str
    neutral: str
    value: str
    interval: str
    bounds: str
    at_neutral: float
    at_low: float
    wide: float
    at_value: float
    meaning: str


@dataclass(frozen=True)
class ParameterTable:
    """Table of parameters of one kind; `first` is the heading of the reference values."""

    title: str
    note: str
    first: str
    rows: tuple[ParameterRow, ...]


@dataclass(frozen=True)
class NoiseRow:
    """Process noise of an equation."""

    equation: str
    before: str
    after: str
    before_width: float
    after_width: float
    words: str


# -- ranking ----------------------------------------------------------------------------------


def ranking_tables(r: Refinement) -> tuple[list[RankingRow], list[RankingRow], list[RankingRow]]:
    """Return displayed and folded single candidates, then combinations."""
    rows = [row for row in r.record["candidates"] if row["names"]]
    best = max((_gain(row) for row in rows), default=0.0)
    claimed = tuple(r.verdict.claimed.names) if r.verdict.claimed else ()
    lines = [(len(row["names"]), _ranking_row(r, row, best, claimed)) for row in rows]
    singles, pairs = ([line for n, line in lines if (n == 1) == alone] for alone in (True, False))
    return singles[:SHOWN_SINGLES], singles[SHOWN_SINGLES:], pairs


def _ranking_row(r: Refinement, row: Mapping[str, Any], best: float, claimed: Sequence[str]) -> RankingRow:
    gain, declared, values = _gain(row), r.study.subject.declared, []
    for n, value in row["parameters"].items():
        short = n.removesuffix(".value") if len(row["names"]) > 1 else n.partition(".")[2] or "value"
        values.append(f"{short} = {amount(float(value), declared[n].unit if n in declared else '', 4)}")
    width = round(100 * max(0.0, gain) / best, 1) if best > 0 else 0.0
    is_claimed = tuple(row["names"]) == tuple(claimed)
    return RankingRow(" + ".join(row["names"]), plain(gain, 3), width, ", ".join(values), str(row["why"]), is_claimed)


def _gain(row: Mapping[str, Any]) -> float:
    """Return the gain in score, −∞ for a diverged filter."""
    return -math.inf if row["score_gain"] is None else float(row["score_gain"])


def held_out(r: Refinement) -> tuple[int, str]:
    """Return the number of held-out logs, or parts of a log, of the ladder, and their noun."""
    return max((rung.errors.size for rung in r.verdict.ladder), default=0), "log" if len(r.study.logs) > 1 else "part"


def ladder_note(r: Refinement) -> str:
    """Return an explanation of the ladder."""
    count, noun = held_out(r)
    text = LADDER_NOTE.format(part="Each log" if noun == "log" else "Each part of the log")
    if 0 < count <= FEW:
        degrees = counted(count - 1, "degree") + " of freedom"
        text += f" From {counted(count, noun)} it has {degrees}, so it is only a rough number."
    ratio = next((float(e["ratio"]) for e in r.record.get("ladder", []) if e["model"] == "recalibrated"), 0.0)
    if ratio > 1.0:
        others = "the other log" if count == 2 and noun == "log" else f"the other {noun}s"
        text += f" Recalibration from {others} does not carry over to the one held out: {percent(ratio)}."
    return text


def ladder_rows(r: Refinement) -> list[LadderRow]:
    """Return the errors of predictions of held-out logs from the given model to the largest set of candidates."""
    entries = r.record.get("ladder", [])
    most = max((float(e["ratio"]) for e in entries), default=0.0)
    titles = {"before": "model of the study", "recalibrated": "recalibrated"}
    count, noun = held_out(r)
    chosen = next((list(h.names) for h in (r.verdict.claimed, r.verdict.nearest_hypothesis) if h), None)
    rows = []
    for e in entries:
        scatter = ""
        if e["standard_error"]:
            scatter = f"± {plain(100.0 * e['ratio'] * e['standard_error'], 2)}\u00a0%, {counted(count, noun)}"
        width = round(100.0 * float(e["ratio"]) / most, 1)
        names = titles.get(e["model"], " + ".join(e["names"]))
        is_chosen = e["names"] == chosen and e["model"] != "before"
        rows.append(LadderRow(names, len(e["names"]), percent(e["ratio"]), width, scatter, is_chosen))
    return rows


# -- parameters -------------------------------------------------------------------------------


def parameter_tables(r: Refinement) -> list[ParameterTable]:
    """Return the tables of added and of base parameters."""
    hypothesis = r.verdict.claimed or r.attribution.base
    added, rest = _parameter_rows(r, hypothesis)
    title = "Added parameters" if r.verdict.name != "parameter_error" else "Wrong parameters"
    note = "Bar: 95 % interval; dashed line: neutral value or data sheet."
    if len(r.study.logs) == 1:
        note += " The intervals are of one log: how much the values differ from log to log is not in them."
    tables = [ParameterTable(title, note, "Neutral", added)]
    if _is_base_unchanged(r, hypothesis):
        title, note = "fitted beside it", "The model keeps its values: the error is in a sensor, not in the plant."
    else:
        title, note = "recalibrated", TOLERANCE
    tables.append(ParameterTable(f"Base parameters, {title}", note, "Data sheet", rest))
    near = r.verdict.nearest_hypothesis
    if r.verdict.claimed is None and near is not None and near.candidates:
        added, rest = _parameter_rows(r, near)
        note = "The model that predicts held-out logs best contains them; they are not confirmed."
        if near.fit.scattered is None and len(r.study.logs) > 1:
            note += " The intervals leave out how much the values differ from log to log."
        tables.append(ParameterTable("Added parameters of the nearest model", note, "Neutral", added))
        tables.append(ParameterTable("Base parameters of the nearest model", TOLERANCE, "Data sheet", rest))
    return [t for t in tables if t.rows]


def _parameter_rows(r: Refinement, h: Hypothesis) -> tuple[tuple[ParameterRow, ...], tuple[ParameterRow, ...]]:
    """Return the rows of added and of base parameters of a hypothesis."""
    own = {n for c in h.candidates for n in c.parameters}
    free = [f for f in h.fit.free if not f.group]
    added, rest = (
        tuple(_parameter_row(r, f, h) for f in free if (f.name in own) == is_own) for is_own in (True, False)
    )
    return added, rest


def _is_base_unchanged(r: Refinement, hypothesis: Hypothesis) -> bool:
    """Return whether all base parameters are unchanged, for a claim of sensor errors alone."""
    subject = r.study.subject
    refined = refined_subject(subject, r.study.settings, hypothesis).values
    base = {n: value for n, value in subject.values.items() if n not in subject.sensor_parameters}
    return hypothesis.is_of_sensors and base.items() <= refined.items()


def _parameter_row(r: Refinement, free: Free, hypothesis: Hypothesis) -> ParameterRow:
    """Return the row of an estimate."""
    declaration, value = r.study.subject.declared[free.name], hypothesis.fit.values[free.name]
    unit = declaration.unit
    sigma, start = hypothesis.fit.sigma(free.name), float(r.problem.values[free.name])
    is_shape = "." in free.name and declaration.neutral is None
    low, high = hypothesis.fit.interval(free.name)
    least, most = min(start, low), max(start, high)
    room = 0.12 * (most - least) or 0.1 * abs(value) or 1.0
    least, most = max(free.low, least - room), min(free.high, most + room)
    digits = _digits(value, sigma)
    neutral = f"{amount(start, unit, 4)}{' (start)' if is_shape else ''}"
    if free.prior:  # the tolerance is the half-width of the 95 % interval of the prior
        neutral = f"{_number(start, unit, 4)} ± {amount(NORMAL_95 * free.prior[1], unit, 2)}"

    def at(x: float) -> float:
        return round(100 * min(1.0, max(0.0, (x - least) / (most - least))), 2) if most > least else 50.0

    lowest = _number(low, unit, digits) if unit else amount(low, "", digits)
    interval = f"{lowest} … {amount(high, unit, digits)}"
    bounds = f"{_number(free.low, unit, 3)} … {amount(free.high, unit, 3)}"
    places = at(start), at(low), round(at(high) - at(low), 2), at(value)
    return ParameterRow(free.name, neutral, amount(value, unit, digits), interval, bounds, *places, declaration.doc)


def _number(value: float, unit: str, digits: int) -> str:
    return plain(value * display(unit)[1], digits)


def _digits(value: float, sigma: float) -> int:
    """Return the digits for two digits of the interval."""
    if not (math.isfinite(value) and math.isfinite(sigma)) or value == 0 or sigma <= 0:
        return 4
    return min(7, max(3, math.floor(math.log10(abs(value))) - math.floor(math.log10(NORMAL_95 * sigma)) + 2))


# -- process noise ----------------------------------------------------------------------------


def noise_rows(r: Refinement) -> list[NoiseRow]:
    """Return the process noise of each equation; none if the fit trusted the equations.

    √q is the drift of a state in a second that its equation does not explain, in the unit of the state per √s.
    """
    noise, size = {} if r.problem.trusted else r.verdict.misfit.get("process_noise", {}), r.problem.noise
    usual = math.log(2.0) + r.problem.plain.memory  # from ln of a power to ln of a density
    unit = {q.name: q.unit for q in r.study.subject.states}
    rows = []
    for k, name in enumerate(r.problem.layout.forced):
        if name in noise:
            before, after = noise[name]["before"], noise[name]["after"]
            drift_unit, factor = ("mm/s", 1000.0) if unit.get(name) == "m/s" else display(unit.get(name, ""))
            unit_text = f"{drift_unit} per √s".lstrip()
            drifts = [append_unit(plain(math.sqrt(q) * factor, 2), unit_text) for q in (before, after)]
            bars = [_width(q, size.smallest[k] + usual, size.largest[k] + usual) for q in (before, after)]
            words = _noise_text(noise[name], size.quiet[k] + usual, claimed=r.verdict.claimed is not None)
            rows.append(NoiseRow(name, drifts[0], drifts[1], bars[0], bars[1], words))
    return rows


def _width(q: float, smallest: float, largest: float) -> float:
    """Return the width of a bar [%]: ln q between the limits of its fit."""
    log_q = math.log(q) if q > 0.0 else smallest
    return round(100 * min(1.0, max(0.0, (log_q - smallest) / (largest - smallest))), 1)


def _noise_text(q: Mapping[str, Any], quiet: float, *, claimed: bool) -> str:
    """Return a text on the completeness of an equation.

    Args:
        quiet: Largest ln q of a complete equation.
    """
    if q["inflated"]:
        who = "the claim" if claimed else "the best hypothesis"
        return f"incomplete; {who} explains a part" if q["after"] < 0.5 * q["before"] else "incomplete"
    if q["before"] <= math.exp(quiet):
        return "complete"
    if plain(q["after"], 2) != plain(q["before"], 2) and q["after"] < q["before"]:
        return "was incomplete, now complete"
    gain = q.get("gain")  # Likelihoods say that the equation needs no unknown input, whatever its size.
    return "no unknown input needed" + (f" (gain {plain(float(gain), 2)})" if gain is not None else "")
