"""The page of a refinement, missing effect, evidence and improvement, and its errors before and after in words."""

from __future__ import annotations

import hashlib
import math
import platform
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import geometric_mean
from typing import Any, Literal

import numpy as np

from cosim.core.text import (
    MISSING,
    amount,
    append_unit,
    counted,
    display,
    displayed,
    finer,
    join_names,
    percent,
    plain,
    split_sentence,
)
from cosim.core.version import __version__
from cosim.credibility.bands import Coverage
from cosim.estimation.subject.candidates import Free
from cosim.files.files import atomic_write, path_from_here
from cosim.fmi.building.refined import NEAREST, REFINED
from cosim.logs.log import NORMAL_95
from cosim.refinement.decision.claims import error_text, rounded
from cosim.refinement.decision.posterior import CERTAIN
from cosim.refinement.proof.measure import OTHER_HORIZONS, Part
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.plots import innovations, modes, runs, shown_effects
from cosim.refinement.search.fits import Hypothesis
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge, Row
from cosim.report.template import render
from cosim.residuals.compare import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN, remaining_excess
from cosim.residuals.windows import SKIPPED

TEMPLATE = Path(__file__).with_name("templates") / "refine.html.j2"
TONES: Mapping[str, str] = {"ambiguous": "warn", "unexplained": "bad"}  # of the other verdicts: good
DISPERSED = 2.0  # dispersion κ from which the page says that no hypothesis fits
INTERVALS = "Bar: 95 % interval; dashed line: the value before. Of one log, intervals do not show how logs differ."
TOLERANCE = (
    "± is the tolerance of the data sheet; a parameter is wrong only if its whole interval lies outside the tolerance. "
    "Beside sensor errors alone, the model keeps its values."
)
WITHDRAWN = {  # reason → why a part is not claimed
    "interval": "its interval holds the value without it",
}
Rows = list[dict[str, Any]]
PARTS: Mapping[Part, str] = {"estimation": "Logs used for the fits", "validation": "Sealed logs"}


def write_refine_report(path: Path, r: Refinement) -> None:
    """Write the self-contained page of a refinement."""
    charts, record, claimed = Charts(), r.record, r.verdict.claimed
    answer, tables, leading = answer_of(r), error_tables(r), leading_channel(r)
    duration = plain(sum(float(log.time[-1] - log.time[0]) for log in r.study.logs))
    sealed = len(r.evidence["before"].get("validation", ()))
    tried = [entry for entry in record["candidates"] if entry["names"]]  # without the model recalibrated
    values = {
        "name": f"Study {r.study.name}",
        "answer": answer,
        "badges": [
            Badge(f"{counted(len(r.study.logs), 'log')} used for the fits, {duration} s"),
            Badge(f"{counted(sealed, 'log')} sealed until the end") if sealed else Badge("no log sealed", "warn"),
            Badge(f"{record['seconds']:.0f} s elapsed"),
        ],
        "r": r,
        "record": record,
        "claimed": claimed is not None,
        "tables": tables,
        "largest": next((row for row in tables[-1]["rows"] if row["channel"] == leading), None),
        "skipped": f"{SKIPPED:g}\u00a0s",
        "sealed": sealed,
        "horizons": horizon_table(r),
        "coverage": Coverage.model_validate(record["coverage"]).sentence if record["coverage"] else "",
        "horizon": horizon(r),
        "terms": shown_effects(r, charts),
        "beside": join_names(r.verdict.best.names),
        "runs": runs(r, charts, leading),
        "whiteness": innovations(r, charts),
        "modes": modes(r),
        "fitted": f"{sum(e['fitted'] for e in tried)} of {counted(len(tried), 'hypothesis')} fitted",
        "ranking": ranking(r),
        "posterior": posterior_rows(r),
        "inclusion": inclusion_rows(r),
        "certain": CERTAIN,
        "percent": percent,
        "plain": plain,
        "dispersed": DISPERSED,
        "parameters": parameter_tables(r),
        "per_log": per_log_rows(r),
        "noise": noise_rows(r),
        "repeat": _repeat(r),
        "provenance": _provenance(r),
        "data": charts.data(),  # after all drawings
        "version": __version__,
    }
    with atomic_write(path) as stream:
        stream.write(render(TEMPLATE, values))


@dataclass(frozen=True)
class Answer:
    """The head of the page and of the terminal.

    Attributes:
        word: Verdict, with a remark on its grade.
        tone: good, warn or bad.
        headline: Verdict in a sentence.
        lines: Error on sealed logs, and what could not be tested.
        details: Further sentences.
        step, command: What to do next, and the command for it; "" without one.
    """

    word: str
    tone: str
    headline: str
    lines: list[str]
    details: str
    step: str
    command: str


def answer_of(r: Refinement) -> Answer:
    """Return the head of the page and of the terminal."""
    headline, details = split_sentence(str(r.record["sentence"]))
    word, tone = str(r.record["verdict"]).replace("_", " "), TONES.get(r.verdict.name, "good")
    if r.verdict.grade == "part" and r.verdict.name != "ambiguous":
        word += ", explains a part of the error"
    if r.risen and r.verdict.claimed:
        word, tone = f"{word}, but sealed logs speak against it", "bad"
    untested = "; ".join(r.record["untested"])
    lines = [second_sentence(r), f"Not tested: {untested}." if untested else ""]
    return Answer(word, tone, headline, [line for line in lines if line], details, *_next_step(r))


def _next_step(r: Refinement) -> tuple[str, str]:
    """Return what to do next, and the command for it."""
    folder, subject = path_from_here(r.folder), r.study.subject
    if r.verdict.name == "ambiguous":
        step = f"Record a log with {r.verdict.experiment}. To design the input, and see if it would decide:"
        return step, shlex.join(["cosim", "excite", str(folder)])
    if r.verdict.name == "unexplained":
        own = "Add an effect of your own to the model"
        if subject.probed:
            own = "Add a term of your own (`terms:` of the study)"
            own += ", or take an FMU for model exchange" if subject.untried else ""
        return f"{own}, and repeat the study:", _repeat(r)
    is_nearest = r.verdict.claimed is None and r.verdict.nearest is not None
    name: Literal["refined", "nearest"] = "nearest" if is_nearest else "refined"
    command = subject.use(folder, name)
    if not command:
        return "Use the refined object: it exists in Python only.", ""
    unclaimed = "recalibrated" if is_nearest else "unchanged"
    what = "the refined model" if r.verdict.claimed else f"the given model, {unclaimed}"
    return f"Use {Path(command[-1]).name}, {what}. To simulate it:", shlex.join(command)


def _repeat(r: Refinement) -> str:
    """Return the command that repeats the study, or ""."""
    if r.study.path is None:
        return ""
    return shlex.join(["cosim", "refine", str(path_from_here(r.study.path)), "--out", str(path_from_here(r.folder))])


def _provenance(r: Refinement) -> list[Row]:
    """Return the files of the study and of its results, and the versions."""
    study, subject, claim, inputs = r.study, r.study.subject, r.verdict.claimed, r.record["inputs"]
    rows = [Row("Study", str(path_from_here(study.path)))] if study.path else []
    rows.append(Row("Model", str(path_from_here(subject.source)), study.content.model if study.path else ""))
    logs = [("Estimation log", log) for log in study.logs]
    logs += [("Sealed log", log) for log, _ in r.evidence["before"].get("validation", ())]
    for label, log in logs:
        note = f"{log.rows} rows, t = {log.time[0]:g} … {log.time[-1]:g} s, measures {', '.join(log.outputs)}"
        rows.append(Row(label, str(path_from_here(log.path)), f"{note}\n{_digest(log.path)}"))
    gain, note = inputs["gain_otherwise"], ""
    if gain is not None:
        raises = "raises" if gain > 0.0 else "lowers"
        note = f"the other way, held or interpolated, {raises} the log-likelihood by {plain(abs(gain))}"
    rows.append(Row("Inputs between rows", ", ".join(f"{n} {way}" for n, way in inputs["taken"].items()), note))
    labels = ("Refined model", "Refined FMU") if claim else ("Model, unchanged", "FMU, unchanged")
    licence = f"\ncontains {Path(subject.source).name}: check its licence before you distribute it" * subject.probed
    for name, label in zip((*REFINED, *NEAREST), (*labels, "Nearest model", "Nearest FMU"), strict=True):
        if (file := r.folder / name).is_file():
            rows.append(Row(label, str(path_from_here(file)), _digest(file) + licence))
    is_stated = any(subject.values[n] != float(p.default) for n, p in subject.sensor_parameters.items())
    if is_stated or any(c.kind == "sensor" for c in (claim.candidates if claim else ())):
        place = "refine.json" if subject.probed else "model.yaml"
        rows.append(Row("Sensors", f"errors stand in {place}; the FMU says what is there, not what is read"))
    return [*rows, Row("Made by", f"cosim {__version__}, Python {platform.python_version()}, numpy {np.__version__}")]


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return f"sha256 {hashlib.file_digest(stream, 'sha256').hexdigest()}"


def ranking(r: Refinement) -> Rows:
    """Return the rows of the hypotheses, best first."""
    claim, declared, rows = r.verdict.claimed, r.study.subject.declared, list[dict[str, Any]]()
    for e in (e for e in r.record["candidates"] if e["names"]):
        names, gain, values = e["names"], -math.inf if e["score_gain"] is None else e["score_gain"], []
        for n, value in e["parameters"].items():
            short = n.removesuffix(".value") if len(names) > 1 else n.partition(".")[2] or "value"
            values.append(f"{short} = {amount(value, declared[n].unit if n in declared else '')}")
        row = {
            "names": " + ".join(names),
            "gain": plain(gain),
            "fitted": ", ".join(values),
            "why": e["why"],
            "claimed": claim is not None and tuple(names) == claim.names,
        }
        rows.append(row)
    return rows


def posterior_rows(r: Refinement) -> Rows:
    """Return the probable sets of parts, the recalibrated model and the delivered set; what remains is one row."""
    record, claim, near, rows = r.record, r.verdict.claimed, r.verdict.nearest, list[dict[str, Any]]()
    held_out = {
        frozenset[str](e["names"]): percent(e["ratio"])
        + (f" ± {percent(e['ratio'] * e['standard_error'])}" if e["standard_error"] else "")
        for e in record["ladder"]
        if e["model"] != "before"
    }
    claimed = "delivered" if r.verdict.name == "ambiguous" else "claimed"  # of rivals, the whole set is no claim
    delivered = {h.key: outcome for h, outcome in ((near, "nearest model"), (claim, claimed)) if h}
    sealed = {frozenset[str](): "recalibrated"} | ({near.key: "nearest"} if near else {})
    sealed |= {claim.key: "after"} if claim else {}
    others = []
    for entry in record["posterior"]:
        names, probability = frozenset[str](entry["names"]), entry["probability"]
        if names and names not in delivered and probability < 1.0 - CERTAIN:
            others.append(probability)
            continue
        rival = "rival" if r.verdict.decision.is_rival(names) else ""
        row = {
            "names": " + ".join(entry["names"]) or "nothing: the model recalibrated",
            "share": probability,
            "why": ", ".join(filter(None, (rival, delivered.get(names, "")))),
            "error": held_out.get(names, MISSING),
            "sealed": percent(_sealed_ratio(record["error"], sealed.get(names, ""))),
            "claimed": delivered.get(names) == "claimed",
        }
        rows.append(row)
    if others:
        row = {"names": f"{counted(len(others), 'other set')} together", "share": sum(others), "why": ""}
        rows.append({**row, "error": MISSING, "sealed": MISSING, "claimed": False})
    return rows


def _sealed_ratio(errors: Mapping[str, Any], variant: str) -> float:
    """Return the error on sealed logs relative to the given model, geometric mean over outputs; NaN without any."""
    before, after = ((errors.get(name) or {}).get("validation") or {} for name in ("before", variant))
    ratios = [after[n] / error for n, error in before.items() if error > 0.0 and after.get(n, 0.0) > 0.0]
    return geometric_mean(ratios) if ratios else math.nan


def inclusion_rows(r: Refinement) -> Rows:
    """Return the probable parts, most probable first, with what became of them."""
    decision, rows = r.verdict.decision, list[dict[str, Any]]()
    withdrawn = {name: WITHDRAWN.get(why, "") for why, _, name in (r.partition(": ") for r in decision.reasons)}
    withdrawn |= dict.fromkeys(decision.disputed, "the model also lacks something without a name")
    for name, probability in sorted(decision.inclusion.items(), key=lambda item: -item[1]):
        why = "uncertain" if name in decision.uncertain else ""
        if name in withdrawn or probability >= CERTAIN:
            why = f"withdrawn: {withdrawn.get(name, 'the logs are not explained')}"
        claimed = name in decision.claimed
        text = f"{name} {percent(probability)}"
        row = {"name": name, "text": text, "share": probability, "why": "claimed" if claimed else why}
        row["claimed"] = claimed
        rows += [row] if probability >= 1.0 - CERTAIN else []
    return rows


def parameter_tables(r: Refinement) -> Rows:
    """Return the tables of added and of base parameters, of the claim or the recalibrated and the nearest model."""
    near, found = r.verdict.nearest, []
    shown = [(r.verdict.claimed or r.verdict.base, "")]
    if r.verdict.claimed is None and near is not None and near.candidates:
        shown.append((near, " of the nearest model, not claimed"))
    for h, of in shown:
        for title, note, added in (("Added parameters", INTERVALS, True), ("Base parameters", TOLERANCE, False)):
            rows = [_parameter_row(r, f, h) for f in h.fit.free if not f.group and (f.name in h.parameters) == added]
            found += [{"title": title + of, "note": note, "rows": rows}] if rows else []
    return found


def _parameter_row(r: Refinement, free: Free, h: Hypothesis) -> dict[str, Any]:
    """Return an estimate with its interval, and the places of both between the value before and the interval."""
    declared, fit, start = r.study.subject.declared[free.name], h.fit, r.problem.values[free.name]
    own, value, (low, high) = declared.unit, fit.values[free.name], fit.interval(free.name)
    unit, factor = display(own)
    ends, places = (min(start, low), max(start, high)), {"neutral": start, "low": low, "high": high, "estimate": value}
    half = NORMAL_95 * fit.sigma(free.name)
    estimate, lower, upper = (rounded(displayed(x, own), half * factor) for x in (value, low, high))
    neutral = amount(start, own, None)
    if free.prior:  # the tolerance is the half-width of the 95 % interval of the prior
        tolerance = amount(NORMAL_95 * free.prior[1], own, 2, difference=True)
        neutral = f"{plain(displayed(start, own), None)} ± {tolerance}"
    return {
        "name": free.name,
        "neutral": neutral,
        "value": append_unit(estimate, unit),
        "interval": f"{lower} … {append_unit(upper, unit)}",
        "bounds": f"{plain(displayed(free.low, own), None)} … {amount(free.high, own, None)}",
        "at": {key: np.interp(x, ends, (0.0, 1.0)) for key, x in places.items()},
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
                start = f"{amount(e['expected'], unit)} ± {amount(e['spread'], unit, 2, difference=True)}"
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
        row |= {key: append_unit(plain(x * factor, 2), f"{unit} per √s".lstrip()) for key, x in sizes.items()}
        rows.append(row)
    return rows


def horizon(r: Refinement) -> str:
    """Return the horizon as text: `2 s`, `a whole run`."""
    judged = r.study.subject.horizon
    return "a whole run" if judged == FREE_RUN else horizon_name(judged)


def decisive_part(r: Refinement) -> Part:
    """Return the sealed logs, else the estimation logs."""
    return "validation" if "validation" in r.record["error"]["before"] else "estimation"


def _numbers(r: Refinement, part: str, name: str) -> dict[str, float]:
    """Return the errors of a channel by model, and its noise floor; NaN if missing."""
    error = r.record["error"]
    found = {v: (error.get(v) or {}).get(part, {}) for v in ("before", "recalibrated", "after", "nearest")}
    found["floor"] = r.record["noise_floors"].get(part, {})
    return {key: float(of.get(name, math.nan)) for key, of in found.items()}


def error_tables(r: Refinement) -> list[dict[str, Any]]:
    """Return a table for each set of logs, its rows with the errors of a channel as texts."""
    tables = []
    for part, title in PARTS.items():
        rows = []
        for name in r.record["error"]["before"].get(part, {}):
            sizes = _numbers(r, part, name)
            after, floor = sizes["after"], sizes["floor"]
            row: dict[str, Any] = {key: error_text(r.study.subject, name, size, after) for key, size in sizes.items()}
            row["sensor_noise"] = error_text(r.study.subject, name, r.record["sensor_noise"].get(name, math.nan), after)
            for key, model in (("excess", "before"), ("of_recalibrated", "recalibrated")):
                row[key] = percent(max(0.0, remaining_excess(sizes[model], after, floor)))
            rows.append({**row, "channel": name})
        has_nearest = any(row["nearest"] not in (MISSING, row["after"]) for row in rows)
        tables += [{"title": title, "rows": rows, "nearest": has_nearest}] if rows else []
    return tables


def horizon_table(r: Refinement) -> dict[str, Any]:
    """Return the errors over each horizon, shortest first; horizons shorter than a log's step are omitted."""
    part, subject, error = decisive_part(r), r.study.subject, r.record["error"]
    better = "after" if r.verdict.claimed else "nearest" if error.get("nearest") else ""
    errors = {seconds: r.record["horizons"][name] for name, seconds in OTHER_HORIZONS.items()}
    errors[subject.horizon] = error
    ordered, rows = sorted(h for h in errors if errors[h]["before"][part]), []
    for channel in error["before"][part]:
        pairs = [[errors[h][m].get(part, {}).get(channel, math.nan) for m in ("before", better) if m] for h in ordered]
        rows.append((channel, [" → ".join(error_text(subject, channel, e, pair[-1]) for e in pair) for pair in pairs]))
    to = {"after": " → the refined one", "nearest": " → the nearest one"}.get(better, "")
    return {
        "title": PARTS[part],
        "heading": f"The given model{to}, over",
        "horizons": [*map(horizon_name, ordered)],
        "rows": rows,
    }


def leading_channel(r: Refinement) -> str:
    """Return the channel with the largest error of the given model relative to the noise floor, or ""."""
    part = decisive_part(r)
    numbers = {name: _numbers(r, part, name) for name in r.record["error"]["before"][part]}
    ratios = {name: n["before"] / n["floor"] for name, n in numbers.items() if n["floor"] > 0.0}
    return max(ratios, key=lambda name: ratios[name], default=next(iter(numbers), ""))


def second_sentence(r: Refinement) -> str:
    """Return a sentence on the error farthest above its noise floor, on sealed logs if available."""
    part, name = decisive_part(r), leading_channel(r)
    if not name:
        return ""
    where = "On sealed logs" if part == "validation" else "On the logs of the fits (none was sealed)"
    sizes = _numbers(r, part, name)
    shown = {key: error_text(r.study.subject, name, size, sizes["after"]) for key, size in sizes.items()}
    verb = "fell" if sizes["after"] < sizes["before"] else "rose"
    text = f"{where} the error of {name} over {horizon(r)} {verb} from {shown['before']} to {shown['after']}"
    if r.verdict.claimed is None:
        text = f"{where} the given model misses {name} by {shown['after']} over {horizon(r)}"
        text += f", the nearest model by {shown['nearest']}" if sizes["nearest"] < sizes["after"] else ""
    return f"{text}." if math.isnan(sizes["floor"]) else f"{text}; the noise floor is {shown['floor']}."
