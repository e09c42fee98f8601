"""Tables of the report: hypotheses, parameters and process noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cosim.core.text import MISSING, amount, append_unit, counted, display, percent, plain
from cosim.estimation.subject.candidates import Free
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.posterior import CERTAIN
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
SHOWN_CLASSES = 6  # of the posterior
VISIBLE = 0.005  # probability of a bar that can be seen
WITHDRAWN = {  # reason → why a part is not claimed
    "held out": "held-out logs are predicted no better with it",
    "interval": "its interval holds the value without it",
}
NOISE_NOTE = (
    "Drift of each state in a second that its equation does not explain, in the unit of the state per √s, as random "
    "drift grows with the root of time; logarithmic bars."
)
Rows = list[dict[str, Any]]  # of a table; each holds a text, or the place of a mark [%], for each key


def ranking(r: Refinement) -> dict[str, Any]:
    """Return the template's values for the ranking and for the number of candidates."""
    claim, declared, rows = r.verdict.claimed, r.study.subject.declared, list[tuple[int, dict[str, Any]]]()
    entries = [e for e in r.record["candidates"] if e["names"]]
    gains = [-math.inf if e["score_gain"] is None else float(e["score_gain"]) for e in entries]
    best = max(gains, default=0.0)
    for entry, gain in zip(entries, gains, strict=True):
        names, values = entry["names"], []
        for n, value in entry["parameters"].items():
            short = n.removesuffix(".value") if len(names) > 1 else n.partition(".")[2] or "value"
            values.append(f"{short} = {amount(float(value), declared[n].unit if n in declared else '', 4)}")
        width = round(100 * max(0.0, gain) / best, 1) if best > 0 else 0.0
        row = {"names": " + ".join(names), "gain": plain(gain, 3), "width": width, "fitted": ", ".join(values)}
        is_claimed = claim is not None and tuple(names) == claim.names
        rows.append((len(names), {**row, "why": entry["why"], "claimed": is_claimed}))
    singles, pairs = [row for n, row in rows if n == 1], [row for n, row in rows if n > 1]
    return {
        "singles": singles[:SHOWN_SINGLES],
        "more": singles[SHOWN_SINGLES:],
        "pairs": pairs[:SHOWN_PAIRS],
        "pairs_count": len(pairs),
        "pairs_open": claim is not None and len(claim.candidates) > 1,
        **_ladder(r),
    }


def _ladder(r: Refinement) -> dict[str, Any]:
    """Return errors of predictions of held-out logs, from the given model to the largest set, with an explanation."""
    count = max((errors.size for _, errors in r.verdict.ladder), default=0)  # held-out logs, or parts of a log
    noun, part = ("log", "Each log") if len(r.study.logs) > 1 else ("part", "Each part of the log")
    entries, note = r.record.get("ladder", []), LADDER_NOTE.format(part=part)
    if 0 < count <= FEW:
        degrees = counted(count - 1, "degree") + " of freedom"
        note += f" From {counted(count, noun)} it has {degrees}, so it is only a rough number."
    titles = {"before": "model of the study", "recalibrated": "recalibrated"}
    chosen = next((list(h.names) for h in (r.verdict.claimed, r.verdict.nearest) if h), None)
    most, rows = max((float(e["ratio"]) for e in entries), default=0.0), []
    for e in entries:
        ratio, error, scatter = float(e["ratio"]), e["standard_error"], ""
        if error:
            scatter = f"± {plain(100.0 * ratio * error, 2)}\u00a0%, {counted(count, noun)}"
        if e["model"] == "recalibrated" and ratio > 1.0:
            others = "the other log" if count == 2 and noun == "log" else f"the other {noun}s"
            note += f" Recalibration from {others} does not carry over to the one held out: {percent(ratio)}."
        row = {"names": titles.get(e["model"], " + ".join(e["names"])), "count": len(e["names"])}
        row |= {"error": percent(ratio), "width": round(100.0 * ratio / most, 1), "scatter": scatter}
        rows.append({**row, "chosen": e["names"] == chosen and e["model"] != "before"})
    return {"ladder": rows, "ladder_note": note}


def posterior_rows(r: Refinement) -> Rows:
    """Return the probable sets of parts, the recalibrated model and the delivered set; what remains is one row."""
    record, claim, near, rows = r.record, r.verdict.claimed, r.verdict.nearest, list[dict[str, Any]]()
    held_out = {frozenset(e["names"]): float(e["ratio"]) for e in record["ladder"] if e["model"] != "before"}
    claimed = "delivered" if r.verdict.name == "ambiguous" else "claimed"  # of rivals, the whole set is no claim
    delivered = {frozenset(h.names): outcome for h, outcome in ((near, "nearest model"), (claim, claimed)) if h}
    sealed = {frozenset[str](): "recalibrated"} | ({frozenset(near.names): "nearest"} if near else {})
    sealed |= {frozenset(claim.names): "after"} if claim else {}
    others, rest = 0, 0.0
    for entry in record["posterior"]:
        names, probability = frozenset[str](entry["names"]), float(entry["probability"])
        if names and names not in delivered and (probability < VISIBLE or len(rows) == SHOWN_CLASSES):
            others, rest = others + 1, rest + probability
            continue
        rival = "rival" if r.verdict.decision.is_rival(names) else ""
        outcome = ", ".join(filter(None, (rival, delivered.get(names, ""))))
        row = {"names": " + ".join(entry["names"]) or "nothing: the model recalibrated", "why": outcome}
        row["error"] = percent(held_out[names]) if names in held_out else MISSING
        row["sealed"] = percent(_sealed_ratio(record["error"], sealed[names])) if names in sealed else MISSING
        rows.append({**row, **_probability(probability), "claimed": delivered.get(names) == "claimed"})
    if others:
        row = {"names": f"{counted(others, 'other set')} together", "error": MISSING, "sealed": MISSING, "why": ""}
        rows.append({**row, **_probability(rest), "claimed": False})
    return rows


def _sealed_ratio(errors: Mapping[str, Any], variant: str) -> float:
    """Return the error on sealed logs relative to the given model, geometric mean over outputs; NaN without any."""
    before, after = ((errors.get(name) or {}).get("validation") or {} for name in ("before", variant))
    ratios = [after[n] / error for n, error in before.items() if error > 0.0 and after.get(n, 0.0) > 0.0]
    return math.exp(sum(map(math.log, ratios)) / len(ratios)) if ratios else math.nan


def inclusion_rows(r: Refinement) -> Rows:
    """Return the probable parts, most probable first, with what became of them."""
    decision, rows = r.verdict.decision, list[dict[str, Any]]()
    withdrawn = {name: WITHDRAWN.get(why, "") for why, _, name in (r.partition(": ") for r in decision.reasons)}
    for name, probability in sorted(decision.inclusion.items(), key=lambda item: -item[1]):
        why = "uncertain" if name in decision.uncertain else ""
        if probability >= CERTAIN:
            why = "withdrawn: the logs are not explained"
        if name in withdrawn:
            why = f"withdrawn: {withdrawn[name]}"
        elif name in decision.disputed:
            why = "withdrawn: a term without a name may take its place"
        claimed = name in decision.claimed
        row = {"name": name, "why": "claimed" if claimed else why, "claimed": claimed, **_probability(probability)}
        rows += [row] if probability >= VISIBLE else []
    return rows


def _probability(value: float) -> dict[str, Any]:
    """Return a probability as text and as width of its bar [%]."""
    return {"probability": percent(value), "width": round(100.0 * value, 1)}


def parameter_tables(r: Refinement) -> list[dict[str, Any]]:
    """Return the tables of added and of base parameters."""
    subject, claim, near = r.study.subject, r.verdict.claimed, r.verdict.nearest
    h = claim or r.verdict.base
    title = "Added parameters" if r.verdict.name != "parameter_error" else "Wrong parameters"
    note = "Bar: 95 % interval; dashed line: neutral value or data sheet."
    if len(r.study.logs) == 1:
        note += " The intervals are of one log: how much the values differ from log to log is not in them."
    tables = [(title, note, "Neutral", h, True)]
    title, note = "Base parameters, recalibrated", TOLERANCE
    base = {n: value for n, value in subject.values.items() if n not in subject.sensor_parameters}
    if h.is_of_sensors and base.items() <= refined_subject(subject, r.study.settings, h).values.items():
        title = "Base parameters, fitted beside it"
        note = "The model keeps its values: the error is in a sensor, not in the plant."
    tables.append((title, note, "Data sheet", h, False))
    if claim is None and near is not None and near.candidates:
        note = "The nearest model contains them; they are not claimed."
        if near.fit.scattered is None and len(r.study.logs) > 1:
            note += " The intervals leave out how much the values differ from log to log."
        tables.append(("Added parameters of the nearest model", note, "Neutral", near, True))
        tables.append(("Base parameters of the nearest model", TOLERANCE, "Data sheet", near, False))
    found = []
    for title, note, first, h, added in tables:
        own = {n for c in h.candidates for n in c.parameters}
        rows = [_parameter_row(r, f, h) for f in h.fit.free if not f.group and (f.name in own) == added]
        if rows:
            found.append({"title": title, "note": note, "first": first, "rows": rows})
    return found


def _parameter_row(r: Refinement, free: Free, h: Hypothesis) -> dict[str, Any]:
    """Return an estimate with its interval, and its position between neutral and bounds."""
    declaration, value, start = (
        r.study.subject.declared[free.name],
        h.fit.values[free.name],
        r.problem.values[free.name],
    )
    unit, sigma, (low, high) = declaration.unit, h.fit.sigma(free.name), h.fit.interval(free.name)
    least, most = min(start, low), max(start, high)
    room = 0.12 * (most - least) or 0.1 * abs(value) or 1.0
    least, most = max(free.low, least - room), min(free.high, most + room)
    digits = 4
    if math.isfinite(value) and math.isfinite(sigma) and value != 0 and sigma > 0:  # two digits of the interval
        digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(NORMAL_95 * sigma)) + 2
        digits = min(7, max(3, digits))

    def bare(x: float, digits: int) -> str:
        return plain(x * display(unit)[1], digits)

    def at(x: float) -> float:
        return round(100 * min(1.0, max(0.0, (x - least) / (most - least))), 2) if most > least else 50.0

    neutral = amount(start, unit, 4)
    if free.prior:  # the tolerance is the half-width of the 95 % interval of the prior
        neutral = f"{bare(start, 4)} ± {amount(NORMAL_95 * free.prior[1], unit, 2)}"
    elif "." in free.name and declaration.neutral is None:
        neutral += " (start)"
    return {
        "name": free.name,
        "neutral": neutral,
        "value": amount(value, unit, digits),
        "interval": f"{bare(low, digits) if unit else amount(low, '', digits)} … {amount(high, unit, digits)}",
        "bounds": f"{bare(free.low, 3)} … {amount(free.high, unit, 3)}",
        "at_neutral": at(start),
        "at_low": at(low),
        "wide": round(at(high) - at(low), 2),
        "at_value": at(value),
        "meaning": declaration.doc,
    }


def per_log_rows(r: Refinement) -> Rows:
    """Return a row for each parameter per log and group, fitted values first."""
    rows = []
    for name, entry in r.record.get("per_log", {}).items():
        unit = entry["unit"]
        for group, e in entry["groups"].items():
            interval = " … ".join(amount(bound, unit, 3) for bound in e["ci95"])
            row = {"name": name, "group": group, "value": amount(e["value"], unit, 4), "interval": interval}
            rows.append({**row, "how": "fitted"})
        for group, f in entry["followed"].items():
            from_, by = amount(f["expected"], unit, 3), amount(f["spread"], unit, 2)
            how = f"by the filter at the end of the log, from {from_} ± {by} (one standard deviation)"
            row = {"name": name, "group": group, "value": amount(f["value"], unit, 4), "interval": MISSING}
            rows.append({**row, "how": how})
    return rows


def noise_rows(r: Refinement) -> Rows:
    """Return the process noise of each equation; none if the fit trusted the equations.

    √q is the drift of a state in a second that its equation does not explain, in the unit of the state per √s.
    """
    noise, size = {} if r.problem.trusted else r.verdict.residual.get("process_noise", {}), r.problem.noise
    usual = math.log(2.0) + r.problem.plain.memory  # from ln of a power to ln of a density
    unit = {q.name: q.unit for q in r.study.subject.states}
    rows = []
    for k, name in enumerate(r.problem.layout.forced):
        if name not in noise:
            continue
        smallest, largest = size.smallest[k] + usual, size.largest[k] + usual
        drift_unit, factor = ("mm/s", 1000.0) if unit.get(name) == "m/s" else display(unit.get(name, ""))
        words = _noise_text(noise[name], size.quiet[k] + usual, claimed=r.verdict.claimed is not None)
        row: dict[str, Any] = {"equation": name, "words": words}
        for key in ("before", "after"):
            q = noise[name][key]
            row[key] = append_unit(plain(math.sqrt(q) * factor, 2), f"{drift_unit} per √s".lstrip())
            share = ((math.log(q) if q > 0.0 else smallest) - smallest) / (largest - smallest)
            row[f"{key}_width"] = round(100 * min(1.0, max(0.0, share)), 1)
        rows.append(row)
    return rows


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
