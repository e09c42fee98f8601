"""The page of a refinement: verdict, probabilities, logs, missing effect in the data, errors before and after."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import geometric_mean
from typing import Any, Literal, NamedTuple

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import (
    MISSING,
    amount,
    append_unit,
    counted,
    display,
    displayed,
    join_names,
    percent,
    plain,
    shown_unit,
    split_sentence,
)
from cosim.core.units import unit_of_rate
from cosim.core.version import __version__
from cosim.credibility.bands import Coverage
from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Free
from cosim.files.files import atomic_write, path_from_here
from cosim.fmi.building.refined import NEAREST, REFINED
from cosim.logs.log import NORMAL_95
from cosim.refinement.decision.claims import error_text, rounded
from cosim.refinement.decision.posterior import CERTAIN
from cosim.refinement.proof.measure import Part, ReplayedLogs
from cosim.refinement.refinement import Refinement
from cosim.refinement.search.fits import Hypothesis
from cosim.refinement.search.unnamed import contributions, signal_units, signals_of, smooth_logs
from cosim.report.charts import Charts, Drawing, Plot
from cosim.report.panels import Band, Panel, Trace, extent, signal_panel
from cosim.report.template import Row, command, places, render
from cosim.residuals.compare import horizon_name
from cosim.residuals.residual_statistics import FREE_RUN, remaining_excess
from cosim.residuals.windows import SKIPPED
from cosim.scenario.scenario_file import sha256

TEMPLATE = Path(__file__).with_name("templates") / "refine.html.j2"
VERDICT_TONES: Mapping[str, str] = {"ambiguous": "warn", "unexplained": "bad"}  # of the other verdicts: good
DISPERSED = 2.0  # dispersion κ from which the page says that no hypothesis fits
INTERVALS = "Bar: 95 % interval; dashed line: the value before. Of one log, intervals do not show how logs differ."
TOLERANCE_NOTE = (
    "± is the tolerance of the data sheet; a parameter is wrong only if its whole interval lies outside the tolerance. "
    "Beside sensor errors alone, the model keeps its values."
)
TableRows = list[dict[str, Any]]
PART_TITLES: Mapping[Part, str] = {"estimation": "Logs used for the fits", "validation": "Sealed logs"}


def write_refine_report(path: Path, r: Refinement) -> None:
    """Write the self-contained page of a refinement."""
    charts, record, claimed = Charts(), r.record, r.verdict.claimed
    tables, leading = error_tables(r), leading_channel(r)
    duration = plain(sum(float(log.time[-1] - log.time[0]) for log in r.study.logs))
    sealed = len(r.evidence["before"].get("validation", ()))
    tried = [entry for entry in record["candidates"] if entry["names"]]  # without the recalibrated model
    values = {
        "name": f"Study {r.study.name}",
        "answer": answer_of(r),
        "badges": [
            f"{counted(len(r.study.logs), 'log')} used for the fits, {duration} s",
            f"{counted(sealed, 'log')} sealed until the end" if sealed else ("no log sealed", "warn"),
            f"{record['seconds']:.0f} s elapsed",
        ],
        "r": r,
        "record": record,
        "claimed": claimed is not None,
        "tables": tables,
        "largest": next((row for row in tables[-1]["rows"] if row["channel"] == leading), None),
        "skipped": f"{SKIPPED:g}\u00a0s",
        "sealed": sealed,
        "coverage": Coverage.model_validate(record["coverage"]).sentence if record["coverage"] else "",
        "horizon": horizon(r),
        "terms": shown_effects(r, charts),
        "beside": join_names(r.verdict.best.names),
        "runs": runs(r, charts, leading),
        "fitted": f"{sum(e['fitted'] for e in tried)} of {counted(len(tried), 'hypothesis')} fitted",
        "ranking": ranking(r),
        "posterior": posterior_rows(r),
        "inclusion": inclusion_rows(r),
        "certain": CERTAIN,
        "dispersed": DISPERSED,
        "parameters": parameter_tables(r),
        "per_log": per_log_rows(r),
        "repeat": _repeat(r),
        "provenance": _provenance(r),
    }
    with atomic_write(path) as stream:
        stream.write(render(TEMPLATE, values, charts))


@dataclass(frozen=True)
class Answer:
    """The head of the page, and the text on the terminal.

    Attributes:
        word: Name of the verdict, with a remark on its grade.
        tone: good, warn or bad.
        headline: Verdict as a sentence.
        lines: Sentences on the error on sealed logs, and on what could not be tested.
        details: Further sentences.
        step, command: Next step for the user, and its command; "" if there is none.
    """

    word: str
    tone: str
    headline: str
    lines: list[str]
    details: str
    step: str
    command: str


def answer_of(r: Refinement) -> Answer:
    """Return the head of the page, also used on the terminal."""
    headline, details = split_sentence(str(r.record["sentence"]))
    word, tone = str(r.record["verdict"]).replace("_", " "), VERDICT_TONES.get(r.verdict.name, "good")
    if r.verdict.grade == "part" and r.verdict.name != "ambiguous":
        word += ", explains a part of the error"
    if r.risen and r.verdict.claimed:
        word, tone = f"{word}, but sealed logs speak against it", "bad"
    untested = "; ".join(r.record["untested"])
    lines = [second_sentence(r), f"Not tested: {untested}." if untested else ""]
    return Answer(word, tone, headline, [line for line in lines if line], details, *_next_step(r))


def _next_step(r: Refinement) -> tuple[str, str]:
    """Return a sentence on the next step for the user, and its command."""
    folder, subject = path_from_here(r.folder), r.study.subject
    if r.verdict.name == "ambiguous":
        step = f"Record a log with {r.verdict.experiment}. To design its input, and to see whether it would decide:"
        return step, command("cosim", "excite", str(folder))
    if r.verdict.name == "unexplained":
        own = "Add an effect of your own to the model"
        if subject.probed:
            own = "Add a term of your own (`terms:` of the study)"
            own += ", or use an FMU for model exchange" if subject.untried else ""
        return f"{own}, and repeat the study:", _repeat(r)
    is_nearest = r.verdict.claimed is None and r.verdict.nearest is not None
    name: Literal["refined", "nearest"] = "nearest" if is_nearest else "refined"
    use = subject.use(folder, name)
    if not use:
        return "Use the refined object: it exists in Python only.", ""
    unclaimed = "recalibrated" if is_nearest else "unchanged"
    what = "the refined model" if r.verdict.claimed else f"the given model, {unclaimed}"
    return f"Use {Path(use[-1]).name}, {what}. To simulate it:", command(*use)


def _repeat(r: Refinement) -> str:
    """Return the command that repeats the study, or "" for a study written in Python."""
    if r.study.path is None:
        return ""
    return command("cosim", "refine", str(path_from_here(r.study.path)), "--out", str(path_from_here(r.folder)))


def _provenance(r: Refinement) -> list[Row]:
    """Return table rows with the files of the study and of its results, and versions."""
    study, subject = r.study, r.study.subject
    rows = [Row("Study", str(path_from_here(study.path)))] if study.path else []
    rows.append(Row("Model", str(path_from_here(subject.source)), subject.title))
    logs = [("Estimation log", log) for log in study.logs]
    logs += [("Sealed log", log) for log, _ in r.evidence["before"].get("validation", ())]
    for label, log in logs:
        note = f"{log.rows} rows, t = {log.time[0]:g} … {log.time[-1]:g} s, measures {', '.join(log.outputs)}"
        rows.append(Row(label, str(path_from_here(log.path)), f"{note}\nsha256 {sha256(log.path)}"))
    taken = r.record["inputs"]["taken"].items()
    rows.append(Row("Inputs between rows", ", ".join(f"{n} {way}" for n, way in taken)))
    for name in (*REFINED, *NEAREST):
        if (file := r.folder / name).is_file():
            rows.append(Row("Result", str(path_from_here(file)), f"sha256 {sha256(file)}"))
    if subject.probed:
        rows.append(Row("Licence", f"the result contains {Path(subject.source).name}: check its licence"))
    if any(c.kind == "sensor" for c in (r.verdict.claimed.candidates if r.verdict.claimed else ())):
        place = "refine.json" if subject.probed else "model.yaml"
        rows.append(Row("Sensors", f"sensor errors are in {place}; the FMU computes true outputs, not readings"))
    return [*rows, Row("Made by", f"cosim {__version__}, Python {platform.python_version()}, numpy {np.__version__}")]


def ranking(r: Refinement) -> TableRows:
    """Return table rows of the hypotheses, best first."""
    claim, declared, rows = r.verdict.claimed, r.study.subject.declared, list[dict[str, Any]]()
    for e in (e for e in r.record["candidates"] if e["names"]):
        names, gain, values = e["names"], -math.inf if e["score_gain"] is None else e["score_gain"], []
        for n, value in e["parameters"].items():
            short = n.removesuffix(".value") if len(names) > 1 else n.partition(".")[2] or "value"
            values.append(f"{short} = {amount(value, declared[n].unit if n in declared else '')}")
        row = {"names": " + ".join(names), "gain": plain(gain), "fitted": ", ".join(values), "why": e["why"]}
        rows.append({**row, "claimed": claim is not None and tuple(names) == claim.names})
    return rows


def posterior_rows(r: Refinement) -> TableRows:
    """Return table rows of probable hypotheses, the recalibrated and the delivered model."""
    record, claim, near, rows = r.record, r.verdict.claimed, r.verdict.nearest, list[dict[str, Any]]()
    held_out = {}
    for e in record["ladder"]:
        if e["model"] != "before":
            spread = f" ± {percent(e['ratio'] * e['standard_error'])}" if e["standard_error"] else ""
            held_out[frozenset(e["names"])] = percent(e["ratio"]) + spread
    outcome = "delivered" if r.verdict.name == "ambiguous" else "claimed"  # rivals are not claimed
    known = [(near, "nearest model", "nearest"), (claim, outcome, "after")]  # with the key of their errors
    delivered = {h.key: (outcome, variant) for h, outcome, variant in known if h}
    for entry in record["posterior"]:
        names, probability = frozenset[str](entry["names"]), entry["probability"]
        if names and names not in delivered and probability < 1.0 - CERTAIN:
            continue
        outcome, variant = delivered.get(names, ("", "" if names else "recalibrated"))
        rival = "rival" if r.verdict.decision.is_rival(names) else ""
        row = {
            "names": " + ".join(entry["names"]) or "nothing: recalibrated model",
            "share": probability,
            "why": ", ".join(filter(None, (rival, outcome))),
            "error": held_out.get(names, MISSING),
            "sealed": percent(_sealed_ratio(record["error"], variant)),
            "claimed": outcome == "claimed",
        }
        rows.append(row)
    return rows


def _sealed_ratio(errors: Mapping[str, Any], variant: str) -> float:
    """Return the error on sealed logs relative to the given model: geometric mean over outputs, NaN without logs."""
    before, after = ((errors.get(name) or {}).get("validation") or {} for name in ("before", variant))
    ratios = [after[n] / error for n, error in before.items() if error > 0.0 and after.get(n, 0.0) > 0.0]
    return geometric_mean(ratios) if ratios else math.nan


def inclusion_rows(r: Refinement) -> TableRows:
    """Return table rows of the probable parts, most probable first, each with its outcome."""
    decision, rows = r.verdict.decision, list[dict[str, Any]]()
    withdrawn = dict.fromkeys(decision.disputed, "unmodelled dynamics remain")
    for reason, _, name in (text.partition(": ") for text in decision.reasons):
        withdrawn.setdefault(name, "its interval contains the value without effect" if reason == "interval" else "")
    for name, probability in sorted(decision.inclusion.items(), key=lambda item: -item[1]):
        if probability < 1.0 - CERTAIN:
            continue
        why = "uncertain" if name in decision.uncertain else ""
        if name in withdrawn or probability >= CERTAIN:
            why = f"withdrawn: {withdrawn.get(name, 'the logs are not explained')}"
        claimed = name in decision.claimed
        row = {"name": name, "text": f"{name} {percent(probability)}", "share": probability, "claimed": claimed}
        rows.append({**row, "why": "claimed" if claimed else why})
    return rows


def parameter_tables(r: Refinement) -> TableRows:
    """Return tables of added and base parameters, for the claim (or recalibrated model) and the nearest model."""
    near, found = r.verdict.nearest, []
    shown = [(r.verdict.claimed or r.verdict.base, "")]
    if r.verdict.claimed is None and near is not None and near.candidates:
        shown.append((near, " of the nearest model, not claimed"))
    for h, of in shown:
        for title, note, added in (("Added parameters", INTERVALS, True), ("Base parameters", TOLERANCE_NOTE, False)):
            rows = [_parameter_row(r, f, h) for f in h.fit.free if not f.group and (f.name in h.parameters) == added]
            found += [{"title": title + of, "note": note, "rows": rows}] if rows else []
    return found


def _parameter_row(r: Refinement, free: Free, h: Hypothesis) -> dict[str, Any]:
    """Return a table row with an estimate, its interval, and their positions on a ruler."""
    declared, fit, start = r.study.subject.declared[free.name], h.fit, r.problem.values[free.name]
    own, value, (low, high) = declared.unit, fit.values[free.name], fit.interval(free.name)
    unit, factor = display(own)
    half = factor * NORMAL_95 * fit.sigma(free.name)
    estimate, lower, upper = (rounded(displayed(x, own), half) for x in (value, low, high))
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
        "places": places(dot=value, low=low, high=high, neutral=start),
        "meaning": declared.doc,
    }


def per_log_rows(r: Refinement) -> list[tuple[str, ...]]:
    """Return a row for each parameter per log and group."""
    return [
        (name, group, amount(e["value"], e["unit"], None), " … ".join(amount(bound, e["unit"]) for bound in e["ci95"]))
        for name, entry in r.record["per_log"].items()
        for group, e in entry["groups"].items()
    ]


def horizon(r: Refinement) -> str:
    """Return the horizon as text: `2 s`, `a whole run`."""
    judged = r.study.subject.horizon
    return "a whole run" if judged == FREE_RUN else horizon_name(judged)


def decisive_part(r: Refinement) -> Part:
    """Return the set of logs whose errors decide: sealed logs, or estimation logs if none are sealed."""
    return "validation" if "validation" in r.record["error"]["before"] else "estimation"


def _errors_by_model(r: Refinement, part: str, name: str) -> dict[str, float]:
    """Return the errors of a channel by model, and its noise floor; NaN if missing."""
    error = r.record["error"]
    found = {v: (error.get(v) or {}).get(part, {}) for v in ("before", "recalibrated", "after", "nearest")}
    found["floor"] = r.record["noise_floors"].get(part, {})
    return {key: float(of.get(name, math.nan)) for key, of in found.items()}


def error_tables(r: Refinement) -> list[dict[str, Any]]:
    """Return a table for each set of logs; a row contains the errors of a channel as texts."""
    tables = []
    for part, title in PART_TITLES.items():
        rows = []
        for name in r.record["error"]["before"].get(part, {}):
            sizes = _errors_by_model(r, part, name)
            after, floor = sizes["after"], sizes["floor"]
            row: dict[str, Any] = {key: error_text(r.study.subject, name, size) for key, size in sizes.items()}
            row["sensor_noise"] = error_text(r.study.subject, name, r.record["sensor_noise"].get(name, math.nan))
            for key, model in (("excess", "before"), ("of_recalibrated", "recalibrated")):
                row[key] = percent(max(0.0, remaining_excess(sizes[model], after, floor)))
            rows.append({**row, "channel": name})
        has_nearest = any(row["nearest"] not in (MISSING, row["after"]) for row in rows)
        tables += [{"title": title, "rows": rows, "nearest": has_nearest}] if rows else []
    return tables


def leading_channel(r: Refinement) -> str:
    """Return the channel with the largest error of the given model relative to the noise floor, or ""."""
    part = decisive_part(r)
    numbers = {name: _errors_by_model(r, part, name) for name in r.record["error"]["before"][part]}
    ratios = {name: n["before"] / n["floor"] for name, n in numbers.items() if n["floor"] > 0.0}
    return max(ratios, key=lambda name: ratios[name], default=next(iter(numbers), ""))


def second_sentence(r: Refinement) -> str:
    """Return a sentence on the channel with the largest error relative to its noise floor, on sealed logs if any."""
    part, name = decisive_part(r), leading_channel(r)
    if not name:
        return ""
    where = "On sealed logs" if part == "validation" else "On the logs of the fits (none was sealed)"
    sizes = _errors_by_model(r, part, name)
    shown = {key: error_text(r.study.subject, name, size) for key, size in sizes.items()}
    verb = "fell" if sizes["after"] < sizes["before"] else "rose"
    text = f"{where} the error of {name} over {horizon(r)} {verb} from {shown['before']} to {shown['after']}"
    if r.verdict.claimed is None:
        text = f"{where} the error of {name} over {horizon(r)} is {shown['after']} with the given model"
        text += f", {shown['nearest']} with the nearest model" if sizes["nearest"] < sizes["after"] else ""
    return f"{text}." if math.isnan(sizes["floor"]) else f"{text}; the noise floor is {shown['floor']}."


def runs(r: Refinement, charts: Charts, leading: str) -> list[dict[str, Any]]:
    """Return title, channels and plots of the first sealed and the first estimation log; channel `leading` is first."""
    pages = []
    words: dict[Part, str] = {"validation": "sealed", "estimation": "used for the fits"}
    for part, word in words.items():
        before, after, near = (r.evidence.get(v, {}).get(part) for v in ("before", "after", "nearest"))
        if not before or not after:
            continue
        log, old = before[0]
        curves = [("model", "true", after)]
        if r.verdict.claimed:
            curves = [("before", "s1", before), ("refined", "true", after)]
        elif r.verdict.nearest and near:
            curves = [("model", "s1", before), ("nearest", "true", near)]
        drawing = charts.over(log.time, breaks=sorted(old.starts))
        names = sorted(log.outputs, key=lambda name: name != leading)
        plots = [plot for name in names for plot in _channel(drawing, curves, name)]
        pages.append({"title": f"{log.path.name}, {word}", "channels": ", ".join(names), "plots": plots})
    return pages


def _channel(drawing: Drawing, curves: Sequence[tuple[str, str, ReplayedLogs]], name: str) -> list[Plot]:
    """Draw two charts of a channel: measurement with model output, and residual.

    The model's output is the reading minus its error, and includes sensor errors in the model.

    Args:
        curves: Label, style and replays of each model.
    """
    log, old = curves[0][2][0]
    errors = [(label, e[0][1].errors(e[0][0])[name], style) for label, style, e in curves]
    unit, reading = log.units.get(name, ""), log.outputs[name]
    fine, scale = display(unit)
    lines = [("measured", reading, "estimate"), *((label, reading - e, style) for label, e, style in errors)]
    residuals = [Trace(label, e * scale, style) for label, e, style in errors]
    starts, inside = sorted(old.starts), np.zeros(log.time.size, dtype=bool)
    for k in starts[::2]:
        inside |= (log.time >= log.time[k]) & (log.time <= log.time[k] + old.horizon)
    panels = []
    for panel in (signal_panel(name, unit, lines), Panel(f"{name}: measured − model", fine or "1", residuals)):
        traces = [replace(trace, anew=trace.label != "measured") for trace in panel.traces]
        ends, band = extent([trace.values for trace in traces]), None
        if ends is not None and len(starts) > 1:
            band = Band("every other replay", *(np.where(inside, end, np.nan) for end in ends))
        panels.append(replace(panel, traces=traces, band=band))
    return drawing.plots(panels)


class Regressor(NamedTuple):
    """A signal over which a missing derivative is plotted, with the rows of some logs one after another."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class EffectComparison:
    """A missing derivative, estimated from the logs, and the claimed term.

    Attributes:
        where: State whose derivative is incomplete.
        unit: Unit of the derivative.
        estimated: Estimate without the claim, in each row.
        term: Claimed value; None without a claim.
    """

    effect: str
    where: str
    unit: str
    against: Regressor
    estimated: Array
    term: Array | None = None

    @property
    def share(self) -> float:
        """Return the share of the mean square that the term explains, at least 0."""
        power = float(np.mean(self.estimated**2))
        if self.term is None or not power:
            return math.nan
        return max(0.0, 1.0 - float(np.mean((self.estimated - self.term) ** 2)) / power)


def compare_effects(r: Refinement) -> list[EffectComparison]:
    """Return a comparison for each claimed effect; without a claim, the unexplained missing derivative."""
    claim = r.verdict.claimed
    if claim is None:
        return [_compare_equation(r, r.verdict.best.fit)] if r.verdict.name == "unexplained" else []
    compared = []
    for c in claim.candidates:
        if c.kind == "sensor" or r.problem.layout.is_free_run:
            continue
        without = r.verdict.base.fit
        if len(claim.candidates) > 1:  # keep the other candidates, so that only this term is missing
            neutral = {n: r.problem.values[n] for n in c.parameters}
            without = replace(without, values={**claim.fit.values, **neutral})
        compared.append(_compare_equation(r, without, c.name, claim.fit))
    return compared


def _compare_equation(r: Refinement, without: Fit, effect: str = "", with_it: Fit | None = None) -> EffectComparison:
    """Compare the derivative that a model lacks with the term of a claimed effect, if any.

    The equation is the one whose term is largest relative to its uncertainty; without an effect, the equation in the
    entry `residual`.
    """
    subject, problem = r.study.subject, r.problem
    missing = smooth_logs(problem, without)
    terms = missing.value
    if with_it is not None:
        terms = np.vstack([contributions(problem, without, with_it, k) for k in range(len(missing.rows))])
    column = int(np.argmax(np.sqrt(np.mean(terms**2, axis=0)) / np.median(missing.sigma, axis=0)))
    if not effect and r.verdict.residual["equation"] in missing.equations:
        column = missing.equations.index(r.verdict.residual["equation"])
    where, units, signals = missing.equations[column], signal_units(subject), list[Regressor]()
    for name, x in signals_of(problem, missing).items():
        if name in units and name.partition(".")[0] not in subject.present:
            is_wrapped = units[name] == "rad" and np.ptp(x) > 2.0 * np.pi  # an angle of more than one turn
            signals.append(Regressor(name, units[name], np.mod(x, 2.0 * np.pi) if is_wrapped else x))

    def variance_within(s: Regressor) -> float:
        return sum(float(np.var(terms[rows, column])) * rows.size for rows in _bins(s.values))

    return EffectComparison(
        effect=effect,
        where=where,
        unit=next((unit_of_rate(q.unit) for q in subject.states if q.name == where), ""),
        against=min(signals, key=variance_within),
        estimated=missing.value[:, column],
        term=terms[:, column] if effect else None,
    )


def _bins(x: Array) -> list[Rows]:
    """Return the rows in each of √n intervals of x that contain equally many rows."""
    return np.array_split(np.argsort(x, kind="stable"), max(1, round(math.sqrt(x.size))))


def shown_effects(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return title, sentence and chart of each comparison: means of both quantities over the signal."""
    shown = []
    for s in compare_effects(r):
        where, (unit, factor), x = f"missing derivative of {s.where}", display(s.unit), s.against.values
        sentence = (
            f"The chart shows the part of the derivative of {s.where} that the model lacks, over {s.against.name}, the "
            "signal on which it depends most"
        )
        if s.term is not None:
            sentence = f"{s.effect} explains {percent(s.share)} of the mean square of the {where} in single rows"
        bins = _bins(x)
        places, mean = (np.array([v[rows].mean() for rows in bins]) for v in (x, factor * s.estimated))
        places = displayed(places, s.against.unit)
        traces = [Trace("data, mean", mean, "s1 dots", x=places)]
        if s.term is not None:
            traces.append(Trace(s.effect, factor * np.array([s.term[rows].mean() for rows in bins]), "true", x=places))
        panel = Panel(f"Missing derivative of {s.where} against {s.against.name}", unit or "1", traces)
        over = s.against.name, shown_unit(s.against.unit) or "1"
        text = f"{sentence} ({counted(s.estimated.size, 'row')} of the estimation logs)."
        plot = charts.alone(panel, extent([places]) or (0.0, 1.0), over)
        shown.append({"title": s.effect or s.where, "sentence": text, "plots": [plot]})
    return shown
