"""The page of a refinement: missing effect, evidence and improvement."""

from __future__ import annotations

import hashlib
import math
import platform
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosim.core.text import MISSING, counted, join_names, percent, plain, split_sentence
from cosim.core.version import __version__
from cosim.files.files import atomic_write, path_from_here
from cosim.fmi.building.refined import NEAREST, REFINED
from cosim.logs.log import Log
from cosim.refinement.decision.prediction_fit import why_no_predictions
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.effect_plots import EffectComparison, compare_effects
from cosim.refinement.report.error_tables import (
    NOTHING_TO_EXPLAIN,
    TOO_LITTLE,
    ErrorTable,
    error_tables,
    has_free_run,
    has_unknown_input,
    horizon,
    horizon_table,
    is_below_floor,
    leading_channel,
    second_sentence,
)
from cosim.refinement.report.innovations import innovations, modes
from cosim.refinement.report.log_parameters import per_log_rows
from cosim.refinement.report.plots import (
    MAX_FAST_SHARE,
    Pairs,
    Run,
    against_signal,
    over_time,
    rows_shown,
    runs,
)
from cosim.refinement.report.rankings import (
    SHOWN_PAIRS,
    ladder_note,
    ladder_rows,
    noise_rows,
    parameter_tables,
    ranking_tables,
)
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge, Row
from cosim.report.template import render
from cosim.residuals.windows import SKIPPED

TEMPLATE = Path(__file__).with_name("templates") / "refine.html.j2"
TITLES: Mapping[str, tuple[str, str]] = {  # verdict → badge, tone
    "effect_found": ("effect found", "good"),
    "parameter_error": ("wrong parameter", "good"),
    "sensor_error": ("sensor error", "good"),
    "no_effect": ("nothing missing", "good"),
    "ambiguous": ("ambiguous", "warn"),
    "unexplained": ("unexplained", "warn"),
}


def write_refine_report(path: Path, r: Refinement) -> None:
    """Write the self-contained page of a refinement."""
    page = render(TEMPLATE, context(r))
    with atomic_write(path) as stream:
        stream.write(page)


def context(r: Refinement) -> Mapping[str, Any]:
    """Return the variables of the page's template."""
    charts = Charts()
    headline, details = split_sentence(str(r.record["sentence"]))
    tables = error_tables(r)
    return {
        "name": f"Study {r.study.name}",
        "description": f"{r.study.subject.title}, refined from measured logs.",
        "headline": headline,
        "details": details,
        "tone": {"warn": "warn"}.get(TITLES.get(r.verdict.name, ("", ""))[1], "plain"),
        "second": second_sentence(r),
        "badges": _badges(r),
        "disputed": r.verdict.name == "ambiguous",
        "claimed": r.verdict.claimed is not None,
        "rivals": r.verdict.rivals,
        "next_step": _next_step(r),
        "warnings": r.record["warnings"],
        "tables": tables,
        "error_lead": _error_lead(r),
        "error_words": _error_words(r, tables),
        "sealed": _sealed_text(r),
        "uncompared": _uncompared_text(r),
        **_in_time(r, charts),
        **_ranking(r),
        "parameters": parameter_tables(r),
        "per_log": per_log_rows(r),
        "noise": noise_rows(r),
        "noise_note": NOISE_NOTE,
        **_use(r),
        "repeat": _repeat_command(r),
        "provenance": _provenance(r),
        "data": charts.data(),  # after all drawings
        "version": __version__,
    }


NOISE_NOTE = (
    "Drift of each state in a second that its equation does not explain, in the unit of the state per √s, as random "
    "drift grows with the root of time; logarithmic bars."
)


def _in_time(r: Refinement, charts: Charts) -> Mapping[str, Any]:
    """Return the template's values for plots over time."""
    plots = runs(r, charts)
    lead = _lead(plots, leading_channel(r))
    return {
        "lead": lead and {"run": lead[0].title, "channel": lead[1].channel, "plots": lead[1].plots},
        "horizons": horizon_table(r),
        "horizon": horizon(r),
        "windowed": horizon(r) != "a whole run",
        "terms": [_term(s, charts) for s in compare_effects(r)],
        "term_lead": _term_lead(r),
        "runs": [run for run in (lead[2] if lead else plots) if run.channels or run.quiet],
        **_whiteness(r, charts),
    }


def _lead(plots: Sequence[Run], channel: str) -> tuple[Run, Pairs, list[Run]] | None:
    """Return log and plots of a channel in the last log (sealed, if any), and the remaining plots of all logs."""
    if not plots:
        return None
    *others, last = plots
    channels = (*last.channels, *last.quiet)
    pair = next((p for p in channels if p.channel == channel), channels[0])
    return last, pair, [*others, last.without(pair)]


def _whiteness(r: Refinement, charts: Charts) -> Mapping[str, Any]:
    """Return the template's values for innovations."""
    white = innovations(r, charts)
    coloured = [w for w in white if w.tells]
    return {
        "whiteness": white,
        "coloured": coloured or white,
        "quiet": [w for w in white if not w.tells] if coloured else [],
        "modes": modes(r),
        "innovation_lead": _innovation_lead(r.verdict.claimed is not None),
    }


def _ranking(r: Refinement) -> Mapping[str, Any]:
    """Return the template's values for the ranking."""
    singles, more, pairs = ranking_tables(r)
    return {
        "singles": singles,
        "more": more,
        "pairs": pairs[:SHOWN_PAIRS],
        "pairs_count": len(pairs),
        "pairs_open": r.verdict.claimed is not None and len(r.verdict.claimed.candidates) > 1,
        "ranking_lead": _ranking_lead(r),
        "ladder": ladder_rows(r),
        "ladder_note": ladder_note(r),
    }


# -- sentences --------------------------------------------------------------------------------


def _badges(r: Refinement) -> list[Badge]:
    text, tone = TITLES.get(r.verdict.name, (r.verdict.name, "plain"))
    sealed = len(r.evidence["before"].get("validation", ()))
    amount = f"{plain(sum(float(log.time[-1] - log.time[0]) for log in r.study.logs))} s"
    hypotheses = [row for row in r.record["candidates"] if row["names"]]  # without the model recalibrated
    fitted = sum(bool(row["fitted"]) for row in hypotheses)
    screened = len(hypotheses) - fitted
    return [
        Badge(text, tone),
        *([Badge("a part of it", "warn")] if r.verdict.grade == "part" else []),
        *([Badge("every rival misses the sealed logs", "warn")] if r.verdict.missed else []),
        Badge(f"{counted(len(r.study.logs), 'log')} used for the fits, {amount}"),
        Badge(
            f"{counted(sealed, 'log')} sealed until the end" if sealed else "no log sealed",
            "plain" if sealed else "warn",
        ),
        Badge(f"{fitted} hypotheses fitted" + (f", {screened} screened" if screened else "")),
        Badge(f"{r.record['seconds']:.0f} s elapsed"),
    ]


def _next_step(r: Refinement) -> str:
    """Return a text on the next step after a verdict without a complete claim."""
    if r.verdict.name == "ambiguous":
        rest = "Nothing is claimed: the model is left as it was. Not visible in these logs, present or not:"
        if r.verdict.claimed:
            shared = [c.name for c in r.verdict.certain]
            every = f"Claimed, since the rivals share it: {join_names(shared)}. " if shared else ""
            rest = (
                f"{every}Until then the refined model contains the rival that fits best. The rivals, which predict "
                "these runs equally well:"
            )
        return f"Next step: record a log with {r.verdict.experiment}. {rest}"
    if r.verdict.name == "unexplained" and r.verdict.rivals:
        inputs, as_it_was = r.verdict.inputs, r.study.subject.main_file("refined")
        first = f"refine again with {inputs}, if the rig commands its inputs that way; else " if inputs else ""
        return (
            f"Next step: {first}look at the figure of the remainder for what an effect of your own would have to do. "
            f"{as_it_was} is the model as it was. Best candidates, not confirmed:"
        )
    return ""


def _term_lead(r: Refinement) -> str:
    if r.verdict.name == "sensor_error":
        return "Each reading minus the output of the refined model, and over it the estimated sensor error."
    way = "A smoother estimates, row by row, the input that an equation lacks, without knowing the proposed effect. "
    if r.verdict.claimed:
        with_it = "Over it the claimed term: a step of the refined model minus a step of the model without the term"
        return f"{way}{with_it}, recalibrated."
    rivals = f" beside {join_names(r.verdict.rivals)}" if r.verdict.rivals else ""
    return f"{way}Over the remainder{rivals}: the unnamed term that would explain most of it, if there is one."


def _term(s: EffectComparison, charts: Charts) -> Mapping[str, Any]:
    return {
        "title": s.effect or s.where,
        "sentence": _term_sentence(s),
        "against": against_signal(s, charts),
        "time": over_time(s, charts),
    }


def _term_sentence(s: EffectComparison) -> str:
    """Return a sentence on a term's share and correlation."""
    quantity = s.quantity
    if s.term is None:
        return f"The {quantity} is drawn against {s.against.name}, which it follows most ({rows_shown(s)})."
    if not np.any(s.term):  # the effect acts elsewhere, for example behind a sensor
        return f"{s.effect} adds nothing to the {quantity}: it acts on another equation ({rows_shown(s)})."
    who = s.effect if s.kind != "nameless" else "a constant" if s.effect == "1" else f"the term in {s.effect}"
    share = min(1.0, max(0.0, s.share))
    if share < MAX_FAST_SHARE and s.kind != "sensor" and (mean := s.share_of_means) > share:
        text = f"Averaged over intervals of {s.against.name}, the {quantity} is explained by {who} to {percent(mean)}"
        return f"{text}; row by row to {percent(share)}, since most of it changes from row to row ({rows_shown(s)})."
    text = f"Of the mean square {quantity}, {who} explains {percent(share)}"
    if s.kind == "sensor":
        return f"{text}; the rest is the noise of the sensor ({rows_shown(s)})."
    if math.isfinite(s.correlation):
        text += f"; row by row the two correlate by {plain(s.correlation, 3)}"
    return f"{text} ({rows_shown(s)})."


def _error_lead(r: Refinement) -> str:
    """Return an introduction to the table of errors."""
    if horizon(r) == "a whole run":
        return "Root mean square of measured − model over a whole run through the FMU, from the first row to the last."
    how = "through the FMU, each started from the state that the model's own filter had estimated by then"
    left_out = f"The first {SKIPPED:g}\u00a0s of each log are left out."
    return f"Root mean square of measured − model over replays of {horizon(r)} {how}. {left_out}"


def _error_words(r: Refinement, tables: Sequence[ErrorTable]) -> list[Row]:
    """Return explanations of the columns of errors."""
    claimed = r.verdict.claimed is not None
    floor = "The error that sensor noise alone would cause."
    if has_unknown_input(r):
        floor = "The error that sensor noise and the estimated unknown input would cause. "
        floor += "The unknown input may include what is missing."
    if is_below_floor(r):
        floor += " The floor is an estimate; some errors lie below it."
    rows = [
        Row("Recalibrated", "The model with its own parameters fitted anew, nothing added."),
        Row("Nearest", "The model that predicts held-out logs best.") if tables[-1].nearest else None,
        Row("Sensor noise", "Standard deviation of the noise of one reading, estimated from the logs."),
        Row("Noise floor", floor),
        Row("Left of …", _share_words(tables)) if claimed else None,
        Row("Free run", "The model alone from the first row to the last.") if has_free_run(r) else None,
    ]
    return [row for row in rows if row]


def _share_words(tables: Sequence[ErrorTable]) -> str:
    """Return an explanation of the remaining share."""
    shown = {excess for table in tables for row in table.rows for excess in (row.excess, row.of_recalibrated)}
    text = (
        "The part of the squared error above the noise floor that the refined model keeps, relative to the model "
        "before and to the model recalibrated."
    )
    if NOTHING_TO_EXPLAIN in shown:
        text += f" “{NOTHING_TO_EXPLAIN[:1].upper()}{NOTHING_TO_EXPLAIN[1:]}”: before, the error was the noise floor."
    if TOO_LITTLE in shown:
        text += f" “{TOO_LITTLE[:1].upper()}{TOO_LITTLE[1:]}”: before, the error was below twice the noise floor."
    return text


def _sealed_text(r: Refinement) -> str:
    """Return an explanation of sealed logs, "" without sealed logs."""
    if "validation" not in r.record["error"]["before"]:
        return ""
    return "Sealed logs were used for no fit and no choice; they were opened once, at the end, as a test."


def _uncompared_text(r: Refinement) -> str:
    """Return a sentence on a claim without a second fit; "" if there was one, or if sensors alone are claimed."""
    why = why_no_predictions(r.problem, r.study.subject.horizon)
    claimed = r.verdict.claimed
    if not why or claimed is None or claimed.is_of_sensors:
        return ""
    return f"The claim could not be compared with a fit to predictions of held-out logs, because {why}."


def _innovation_lead(claimed: bool) -> str:
    way = (
        "An innovation is a reading minus its prediction by a filter one step before, in units of the expected "
        "standard deviation σ. A complete model leaves innovations of size 1 that are uncorrelated (white noise). "
    )
    if claimed:
        return way + "One filter, tuned to the refined model, ran on the model before and on the refined one."
    return way + "The model ran in a filter that trusts its equations, and in one that allows for a disturbance."


def _ranking_lead(r: Refinement) -> str:
    gain = r.record.get("held_out_gain")
    lead = (
        "A score test predicted the likelihood gain of every set of candidates. The promising sets were then fitted "
        "together with the base parameters and the noise levels. The score is the gain in log-likelihood over the base "
        "model, minus the change of the penalty of the priors of base parameters and noise levels, minus ½ ln N for "
        "each added parameter (N readings) and, for each candidate of the set, 3 plus the logarithm of the number of "
        "candidates on trial. A reason about one candidate was found in one set and is applied to all sets with it."
    )
    if (scatter := r.problem.scatter) > 1.0:
        lead += (
            f" These costs are multiplied by {plain(scatter, 3)}, since the errors of a free run are not independent."
        )
    if r.verdict.claimed is not None and gain is not None:
        lead += f" Predicted from the others, each log gains: {plain(float(gain), 3)} in all (cross-validation)."
    return lead


# -- provenance -------------------------------------------------------------------------------


def _use(r: Refinement) -> Mapping[str, str]:
    """Return the command for the delivered files, and a text on them."""
    lead = "To use the refined model"
    name: Literal["refined", "nearest"] = "refined"
    if r.verdict.claimed is None:
        lead = "Nothing was refined; the delivered model is the model as it was. To use it"
        if r.verdict.nearest_hypothesis is not None:
            name = "nearest"
            file = next((n for n in reversed(NEAREST) if (r.folder / n).is_file()), NEAREST[0])
            lead = f"Nothing was refined; the model that predicts best is {file}. To use it"
    return {
        "use": shlex.join(r.study.subject.use(path_from_here(r.folder), name)),
        "use_lead": f"{lead}, and to repeat the study:",
    }


def _repeat_command(r: Refinement) -> str:
    """Return the command that repeats the study in the current folder, or "" for a study written in Python."""
    if r.study.path is None:
        return ""
    study, folder = path_from_here(r.study.path), path_from_here(r.folder)
    return shlex.join(["cosim", "refine", str(study), "--out", str(folder)])


def _provenance(r: Refinement) -> list[Row]:
    study = r.study
    rows = [Row("Study", str(path_from_here(study.path)))] if study.path else []
    rows += [Row("Model", str(path_from_here(study.subject.source)), study.content.model if study.path else "")]
    rows += [_log_row("Estimation log", log) for log in study.logs]
    rows += _inputs(r)
    rows += [_log_row("Sealed log", log) for log, _ in r.evidence["before"].get("validation", ())]
    kinds = ("Refined model", "Refined FMU") if r.verdict.claimed else ("Model, unchanged", "FMU, unchanged")
    files = zip((*REFINED, *NEAREST), (*kinds, "Nearest model", "Nearest FMU"), strict=True)
    for name, label in files:
        if (file := r.folder / name).is_file():
            rows.append(Row(label, str(path_from_here(file)), _digest(file)))
    sensors, claim = study.subject.sensor_parameters, r.verdict.claimed
    stated = any(study.subject.values[n] != float(p.default) for n, p in sensors.items())
    if stated or any(c.kind == "sensor" for c in (claim.candidates if claim else ())):
        place = "refine.json" if study.subject.probed else "model.yaml"
        rows.append(Row("Sensors", f"errors stand in {place}; the FMU says what is there, not what is read"))
    return [*rows, Row("Made by", f"cosim {__version__}, Python {platform.python_version()}, numpy {np.__version__}")]


def _inputs(r: Refinement) -> list[Row]:
    """Return rows on the interpolation of inputs, and the likelihood gain of the alternative."""
    inputs = r.record.get("inputs")
    if not inputs:
        return []
    gain = inputs["gain_otherwise"]
    raises = "raises" if gain is not None and gain > 0.0 else "lowers"
    by = (
        ""
        if gain is None
        else f"the other way, held or interpolated, {raises} the log-likelihood by {plain(abs(gain))}"
    )
    return [Row("Inputs between rows", ", ".join(f"{name} {way}" for name, way in inputs["taken"].items()), by)]


def _log_row(label: str, log: Log) -> Row:
    times = f" t = {log.time[0]:.6g} … {log.time[-1]:.6g} s,"
    holes = f"{log.rows} rows,{times} measures {', '.join(log.outputs)}"
    return Row(label, str(path_from_here(log.path)), f"{holes}\n{_digest(log.path)}")


def _digest(path: Path) -> str:
    if not path.is_file():
        return MISSING
    with path.open("rb") as stream:
        return f"sha256 {hashlib.file_digest(stream, 'sha256').hexdigest()[:16]}…"
