"""The page of a refinement: missing effect, evidence and improvement."""

from __future__ import annotations

import hashlib
import platform
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from cosim.core.text import counted, join_names, percent, plain, split_sentence
from cosim.core.version import __version__
from cosim.files.files import atomic_write, path_from_here
from cosim.fmi.building.refined import NEAREST, REFINED
from cosim.refinement.decision.posterior import CERTAIN
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.effect_plots import shown_effects
from cosim.refinement.report.errors import (
    error_tables,
    has_unknown_input,
    horizon,
    horizon_table,
    leading_channel,
    second_sentence,
)
from cosim.refinement.report.plots import innovations, modes, runs
from cosim.refinement.report.tables import (
    inclusion_rows,
    ladder,
    noise_rows,
    parameter_tables,
    per_log_rows,
    posterior_rows,
    ranking,
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
DISPERSED = 2.0  # dispersion κ from which a page says that no hypothesis fits


def write_refine_report(path: Path, r: Refinement) -> None:
    """Write the self-contained page of a refinement."""
    charts, record, claimed = Charts(), r.record, r.verdict.claimed
    headline, details = split_sentence(str(record["sentence"]))
    tables, plots, lead = error_tables(r), runs(r, charts), None
    if plots:  # a channel of the last log, which is sealed if any is
        last = plots[-1]
        channels = [*last["channels"], *last["quiet"]]
        first = next((c for c in channels if c["channel"] == leading_channel(r)), channels[0])
        lead = {"run": last["title"], "channel": first["channel"], "plots": first["plots"]}
        last |= {key: [c for c in last[key] if c is not first] for key in ("channels", "quiet")}
    terms, white = shown_effects(r, charts), innovations(r, charts)
    coloured, (title, tone) = [w for w in white if w["tells"]], TITLES[r.verdict.name]
    sealed = len(r.evidence["before"].get("validation", ()))
    duration = plain(sum(float(log.time[-1] - log.time[0]) for log in r.study.logs))
    tried = [entry for entry in record["candidates"] if entry["names"]]  # without the model recalibrated
    values = {
        "name": f"Study {r.study.name}",
        "description": f"{r.study.subject.title}, refined from measured logs.",
        "headline": headline,
        "details": details,
        "tone": "warn" if tone == "warn" else "plain",
        "second": second_sentence(r),
        "badges": [
            Badge(title, tone),
            *([Badge("a part of it", "warn")] if r.verdict.grade == "part" else []),
            Badge(f"{counted(len(r.study.logs), 'log')} used for the fits, {duration} s"),
            Badge(f"{counted(sealed, 'log')} sealed until the end") if sealed else Badge("no log sealed", "warn"),
            Badge(f"{sum(e['fitted'] for e in tried)} of {counted(len(tried), 'hypothesis')} fitted"),
            Badge(f"{record['seconds']:.0f} s elapsed"),
        ],
        "verdict": r.verdict,
        "claimed": claimed is not None,
        "shared": join_names([c.name for c in r.verdict.claimed_candidates]),
        "unchanged": r.study.subject.main_file("refined"),
        "warnings": record["warnings"],
        "tables": tables,
        "skipped": f"{SKIPPED:g}\u00a0s",
        "unknown_input": has_unknown_input(r),
        "sealed": sealed,
        "lead": lead,
        "horizons": horizon_table(r),
        "horizon": horizon(r),
        "windowed": horizon(r) != "a whole run",
        "terms": terms,
        "beside": join_names(r.verdict.best.names),
        "runs": [run for run in plots if run["channels"] or run["quiet"]],
        "whiteness": white,
        "coloured": coloured or white,
        "quiet": [w for w in white if not w["tells"]] if coloured else [],
        "modes": modes(r),
        **ranking(r),
        **ladder(r),
        "posterior": posterior_rows(r),
        "inclusion": inclusion_rows(r),
        "certain": CERTAIN,
        "certain_text": percent(CERTAIN),
        "percent": percent,
        "dispersion": plain(record["dispersion"]) if record["dispersion"] > 1.0 else "",
        "dispersed": record["dispersion"] > DISPERSED,
        "parameters": parameter_tables(r),
        "per_log": per_log_rows(r),
        "noise": noise_rows(r),
        **_use(r),
        "provenance": _provenance(r),
        "data": charts.data(),  # after all drawings
        "version": __version__,
    }
    with atomic_write(path) as stream:
        stream.write(render(TEMPLATE, values))


def _use(r: Refinement) -> Mapping[str, str]:
    """Return the commands that use the delivered files and repeat the study, and a text on them."""
    lead, repeat = "To use the refined model", ""
    name: Literal["refined", "nearest"] = "refined"
    if r.verdict.claimed is None:
        lead = "Nothing was refined; the delivered model is the model as it was. To use it"
        if r.verdict.nearest is not None:
            name = "nearest"
            file = next((n for n in reversed(NEAREST) if (r.folder / n).is_file()), NEAREST[0])
            lead = f"Nothing was refined; the most probable model is {file}. To use it"
    folder = path_from_here(r.folder)
    if r.study.path is not None:
        repeat = shlex.join(["cosim", "refine", str(path_from_here(r.study.path)), "--out", str(folder)])
    command = shlex.join(r.study.subject.use(folder, name))
    return {"use": command, "use_lead": f"{lead}, and to repeat the study:", "repeat": repeat}


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
    for name, label in zip((*REFINED, *NEAREST), (*labels, "Nearest model", "Nearest FMU"), strict=True):
        if (file := r.folder / name).is_file():
            rows.append(Row(label, str(path_from_here(file)), _digest(file)))
    is_stated = any(subject.values[n] != float(p.default) for n, p in subject.sensor_parameters.items())
    if is_stated or any(c.kind == "sensor" for c in (claim.candidates if claim else ())):
        place = "refine.json" if subject.probed else "model.yaml"
        rows.append(Row("Sensors", f"errors stand in {place}; the FMU says what is there, not what is read"))
    return [*rows, Row("Made by", f"cosim {__version__}, Python {platform.python_version()}, numpy {np.__version__}")]


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return f"sha256 {hashlib.file_digest(stream, 'sha256').hexdigest()}"
