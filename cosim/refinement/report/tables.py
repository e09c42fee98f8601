"""Tables of the report: probabilities, hypotheses, parameters and process noise; marks are shares of their column."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cosim.core.text import MISSING, amount, append_unit, counted, display, finer, percent, plain
from cosim.estimation.subject.candidates import Free
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.decision.posterior import CERTAIN
from cosim.refinement.decision.sentences import rounded
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.hypotheses import Hypothesis

LADDER_NOTE = (
    "{part} is predicted by a fit to the rest; the error (root mean square) is relative to the model of the study. The "
    "last column is the standard error of the difference from the best over {count}: within it, a model with fewer "
    "candidates is as good."
)
INTERVALS = "Bar: 95 % interval; dashed line: the value before. Of one log, intervals do not show how logs differ."
TOLERANCE = (
    "± is the tolerance of the data sheet; a parameter is wrong only if its whole interval lies outside the tolerance. "
    "Beside sensor errors alone, the model keeps its values."
)
WITHDRAWN = {  # reason → why a part is not claimed
    "held out": "held-out logs are predicted no better with it",
    "interval": "its interval holds the value without it",
}
Rows = list[dict[str, Any]]


def ranking(r: Refinement) -> dict[str, Rows]:
    """Return the rows of fitted and of screened single candidates, and of several candidates together."""
    claim, declared = r.verdict.claimed, r.study.subject.declared
    entries = [e for e in r.record["candidates"] if e["names"]]
    best = max((e["score_gain"] or 0.0 for e in entries), default=0.0)
    tables: dict[str, Rows] = {"singles": [], "more": [], "pairs": []}
    for e in entries:
        names, gain, values = e["names"], -math.inf if e["score_gain"] is None else e["score_gain"], []
        for n, value in e["parameters"].items():
            short = n.removesuffix(".value") if len(names) > 1 else n.partition(".")[2] or "value"
            values.append(f"{short} = {amount(value, declared[n].unit if n in declared else '')}")
        row = {"names": " + ".join(names), "gain": plain(gain), "fitted": ", ".join(values), "why": e["why"]}
        row |= {"share": max(0.0, gain) / best if best > 0.0 else 0.0}
        row |= {"claimed": claim is not None and tuple(names) == claim.names}
        tables["pairs" if len(names) > 1 else "singles" if e["fitted"] else "more"].append(row)
    return tables


def ladder(r: Refinement) -> dict[str, Any]:
    """Return errors of predictions of held-out logs, from the given model to the largest set, with an explanation."""
    count = max((errors.size for _, errors in r.verdict.ladder), default=0)  # held-out logs, or parts of a log
    noun, part = ("log", "Each log") if len(r.study.logs) > 1 else ("part", "Each part of the log")
    titles = {"before": "model of the study", "recalibrated": "recalibrated"}
    chosen = next((list(h.names) for h in (r.verdict.claimed, r.verdict.nearest) if h), None)
    most, rows = max((e["ratio"] for e in r.record["ladder"]), default=1.0), []
    for e in r.record["ladder"]:
        row = {"names": titles.get(e["model"], " + ".join(e["names"])), "count": len(e["names"])}
        row |= {"error": percent(e["ratio"]), "share": e["ratio"] / most}
        row |= {"scatter": f"± {percent(e['ratio'] * e['standard_error'])}" if e["standard_error"] else ""}
        rows.append({**row, "chosen": e["names"] == chosen and e["model"] != "before"})
    return {"ladder": rows, "ladder_note": LADDER_NOTE.format(part=part, count=counted(count, noun))}


def posterior_rows(r: Refinement) -> Rows:
    """Return the probable sets of parts, the recalibrated model and the delivered set; what remains is one row."""
    record, claim, near, rows = r.record, r.verdict.claimed, r.verdict.nearest, list[dict[str, Any]]()
    held_out = {frozenset(e["names"]): e["ratio"] for e in record["ladder"] if e["model"] != "before"}
    claimed = "delivered" if r.verdict.name == "ambiguous" else "claimed"  # of rivals, the whole set is no claim
    delivered = {frozenset(h.names): outcome for h, outcome in ((near, "nearest model"), (claim, claimed)) if h}
    sealed = {frozenset[str](): "recalibrated"} | ({frozenset(near.names): "nearest"} if near else {})
    sealed |= {frozenset(claim.names): "after"} if claim else {}
    others = []
    for entry in record["posterior"]:
        names, probability = frozenset[str](entry["names"]), entry["probability"]
        if names and names not in delivered and probability < 1.0 - CERTAIN:
            others.append(probability)
            continue
        rival = "rival" if r.verdict.decision.is_rival(names) else ""
        row = {"names": " + ".join(entry["names"]) or "nothing: the model recalibrated", "share": probability}
        row |= {"why": ", ".join(filter(None, (rival, delivered.get(names, ""))))}
        row |= {"error": percent(held_out.get(names, math.nan)), "claimed": delivered.get(names) == "claimed"}
        rows.append({**row, "sealed": percent(_sealed_ratio(record["error"], sealed.get(names, "")))})
    if others:
        row = {"names": f"{counted(len(others), 'other set')} together", "share": sum(others), "why": ""}
        rows.append({**row, "error": MISSING, "sealed": MISSING, "claimed": False})
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
    withdrawn |= dict.fromkeys(decision.disputed, "a term without a name may take its place")
    for name, probability in sorted(decision.inclusion.items(), key=lambda item: -item[1]):
        why = "uncertain" if name in decision.uncertain else ""
        if name in withdrawn or probability >= CERTAIN:
            why = f"withdrawn: {withdrawn.get(name, 'the logs are not explained')}"
        claimed = name in decision.claimed
        row = {"name": name, "share": probability, "why": "claimed" if claimed else why, "claimed": claimed}
        rows += [row] if probability >= 1.0 - CERTAIN else []
    return rows


def parameter_tables(r: Refinement) -> Rows:
    """Return the tables of added and of base parameters, of the claim or the recalibrated and the nearest model."""
    near, found = r.verdict.nearest, []
    shown = [(r.verdict.claimed or r.verdict.base, "")]
    if r.verdict.claimed is None and near is not None and near.candidates:
        shown.append((near, " of the nearest model, not claimed"))
    for h, of in shown:
        own = {n for c in h.candidates for n in c.parameters}
        for title, note, added in (("Added parameters", INTERVALS, True), ("Base parameters", TOLERANCE, False)):
            rows = [_parameter_row(r, f, h) for f in h.fit.free if not f.group and (f.name in own) == added]
            found += [{"title": title + of, "note": note, "rows": rows}] if rows else []
    return found


def _parameter_row(r: Refinement, free: Free, h: Hypothesis) -> dict[str, Any]:
    """Return an estimate with its interval, and the places of both between the value before and the interval."""
    declared, fit, start = r.study.subject.declared[free.name], h.fit, r.problem.values[free.name]
    (unit, factor), value, (low, high) = display(declared.unit), fit.values[free.name], fit.interval(free.name)
    least, most = min(start, low), max(start, high)
    places = {"neutral": start, "low": low, "high": high, "estimate": value}
    at = {
        key: (min(max(x, least), most) - least) / (most - least) if most > least else 0.5 for key, x in places.items()
    }
    half = NORMAL_95 * fit.sigma(free.name)
    estimate, lower, upper = (rounded(x * factor, half * factor) for x in (value, low, high))
    neutral = amount(start, declared.unit, None)
    if free.prior:  # the tolerance is the half-width of the 95 % interval of the prior
        tolerance = amount(NORMAL_95 * free.prior[1], declared.unit, 2)
        neutral = f"{plain(start * factor, None)} ± {tolerance}"
    return {
        "name": free.name,
        "neutral": neutral,
        "value": append_unit(estimate, unit),
        "interval": f"{lower} … {append_unit(upper, unit)}",
        "bounds": f"{plain(free.low * factor, None)} … {amount(free.high, declared.unit, None)}",
        "at": at,
        "meaning": declared.doc,
    }


def per_log_rows(r: Refinement) -> Rows:
    """Return a row for each parameter per log and group, fitted values first."""
    rows = []
    for name, entry in r.record["per_log"].items():
        unit = entry["unit"]
        for group, e in (entry["groups"] | entry["followed"]).items():
            interval, how = MISSING, "fitted"
            if "ci95" in e:
                interval = " … ".join(amount(bound, unit) for bound in e["ci95"])
            else:
                start = f"{amount(e['expected'], unit)} ± {amount(e['spread'], unit, 2)}"
                how = f"by the filter at the end of the log, from {start} (one standard deviation)"
            value = amount(e["value"], unit, None)
            rows.append({"name": name, "group": group, "value": value, "interval": interval, "how": how})
    return rows


def noise_rows(r: Refinement) -> Rows:
    """Return the process noise of each equation; none if the fit trusted the equations.

    √q is the drift of a state in a second that its equation does not explain, in the unit of the state per √s.
    """
    units, rows = {q.name: q.unit for q in r.study.subject.states}, []
    for name, q in ({} if r.problem.trusted else r.record["residual"]["process_noise"]).items():
        sizes = {key: math.sqrt(q[key]) for key in ("before", "after")}
        unit, factor = finer(units.get(name, ""), max(sizes.values()))
        row: dict[str, Any] = {"equation": name, "words": "incomplete" if q["inflated"] else "complete"}
        for key, size in sizes.items():
            row[key] = append_unit(plain(size * factor, 2), f"{unit} per √s".lstrip())
            row[f"{key}_share"] = size / max(*sizes.values(), math.ulp(0.0))
        rows.append(row)
    return rows
