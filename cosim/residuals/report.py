"""The page of a replay."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.text import (
    MISSING,
    amount,
    counted,
    display,
    displayed,
    percent,
    plain,
    shown_unit,
    size,
    split_sentence,
)
from cosim.core.version import __version__
from cosim.credibility.validity import Validity, output_panels, outside_of, validity_sentence
from cosim.files.files import path_from_here
from cosim.report.charts import Abscissa, Charts, Drawing, Plot
from cosim.report.html_tables import Badge, Row
from cosim.report.panels import OTHERS_PER_PANEL, Band, Panel, Trace, held_panels
from cosim.residuals.compare import ChannelSummary, Comparison, horizon_name, sentence, verdict, worst_first
from cosim.residuals.residual_statistics import FREE_RUN, Whiteness
from cosim.residuals.windows import SKIPPED, horizons

TEMPLATE = Path(__file__).with_name("templates") / "replay.html.j2"
Cell = Callable[[ChannelSummary], str]  # of a table
STEMS = 100  # about, lags of an autocorrelation


TONES: Mapping[str, str] = {"explained": "good", "unexplained": "bad", "undecided": "warn"}


def context(comparison: Comparison, study: Path, validity: Validity, *, passing: bool = False) -> Mapping[str, Any]:
    """Return the values of the template.

    Args:
        study: Study for the next step, if it was written.
        validity: Validity of the free run in the region of the FMU's logs, empty without one.
        passing: True if the FMU was built for this replay only.
    """
    log, drive, findings = comparison.log, comparison.drive, comparison.findings
    channels, replays = worst_first(comparison.channels), comparison.replays
    charts, word = Charts(), verdict(comparison)
    drawing = charts.over(log.time)
    measure = horizons(log)[-1]
    headline, *details = filter(None, split_sentence(sentence(comparison)))
    warnings = sum(f.severity == "warning" for f in findings)
    badges = [
        Badge(f"{plain(float(log.time[-1] - log.time[0]))} s at {plain(1.0 / log.step)} Hz"),
        Badge(counted(log.rows, "row")),
        Badge(f"replayed through {drive.description.modelName}"),
    ]
    about = drive.description
    units = {v.name: v.unit or "" for v in about.modelVariables}
    starts = [
        Row(n, amount(v, units.get(n, ""), 4) if isinstance(v, float) else str(v))
        for n, v in replays[FREE_RUN].starts[0].items()
    ]
    steps = "as logged" if drive.variable_step else f"equal steps of {plain(log.step)} s, as the FMU demands"
    provenance = [
        Row("FMU", f"{about.modelName}\nguid {about.guid}", str(drive.fmu)),
        Row("Log", f"{log.rows} rows, t = {log.time[0]:.6g} … {log.time[-1]:.6g} s", str(log.path)),
        Row("Steps", steps),
        Row("cosim", __version__),
    ]
    if drive.free_inputs:
        provenance.append(Row("Not in the log", ", ".join(drive.free_inputs), "inputs at the start value of the FMU"))
    measured = [f"{n} ({percent(float(np.isfinite(v).mean()))})" for n, v in log.outputs.items()]
    provenance.append(Row("Measured", ", ".join(measured), "share of the rows"))
    words = [] if passing else ["--fmu", str(drive.fmu)]
    for name, value in drive.given.items():
        words += ["--start", f"{name}={str(value).lower() if isinstance(value, bool) else value}"]
    for column, name in log.called.items():
        words += ["--column", f"{column}={name}"]
    residuals = []
    for c in channels:
        unit, factor = display(c.unit)
        error = replays[c.measure].errors(log)[c.name] * factor
        width = np.full(error.size, 2.0 * factor * (c.noise if np.isfinite(c.noise) else 0.0))
        traces, band = [Trace("measured − model", error, "error")], Band("±2σ of its noise", -width, width)
        residuals.append(Panel(f"Residual of {c.name}", unit or "1", traces, band))
    return {
        "comparison": comparison,
        "log": log,
        "drive": drive,
        "channels": channels,
        "answer": (TONES[word], word, headline, details),
        "next": shlex.join(["cosim", "refine", str(path_from_here(study))]) if study.is_file() else "",
        "badges": badges,
        "bad": warnings,
        "measure": measure,
        "skipped": SKIPPED * log.slowness,
        "within": drawing.plots(_pair_panels(comparison, measure)) if measure in replays else [],
        "free": drawing.plots(_trusted(_pair_panels(comparison, FREE_RUN), comparison, validity)),
        "trust": validity_sentence("FMU", validity).partition(": ")[2],
        "residual": drawing.plots(residuals),
        "shown": sum(not c.is_explained for c in channels) or len(channels),
        "commands": drawing.plots(held_panels(log.inputs, log.units)),
        "autocorrelation": _autocorrelation(comparison, charts),
        "inputs": _input_correlation(comparison, charts),
        "horizons": [(horizon_name(h), *_scores(h)) for h in sorted(replays)],
        "starts": starts,
        "provenance": provenance,
        **{f.__name__: f for f in (horizon_name, isfinite, neighbours)},
        "repeat": shlex.join(["cosim", "replay", str(log.path), *words]),
        "data": charts.data(),  # after all drawings
        "version": __version__,
    }


def _scores(horizon: float) -> tuple[Cell, Cell]:
    """Return functions that show error and fit of a channel over a horizon."""

    def fit(c: ChannelSummary) -> str:
        share = c.scores[horizon].fit
        return f"{plain(share)}\u00a0%" if isfinite(share) else MISSING

    return lambda c: size(c.scores[horizon].rmse, c.unit), fit


# -- charts -----------------------------------------------------------------------------------


def _pair_panels(comparison: Comparison, horizon: float) -> list[Panel]:
    """Return measured and model outputs, a panel per channel."""
    log, outputs = comparison.log, comparison.replays[horizon].outputs
    label = "model, free run" if horizon == FREE_RUN else f"model, restarted every {horizon_name(horizon)}"
    panels = []
    for name, measured in log.outputs.items():
        unit = log.units[name]
        pairs = ("measured", measured, "estimate"), (label, outputs[name], "true")
        traces = [Trace(text, displayed(values, unit), style) for text, values, style in pairs]
        panels.append(Panel(name, shown_unit(unit) or "1", traces))
    return panels


def _trusted(panels: Sequence[Panel], comparison: Comparison, validity: Validity) -> list[Panel]:
    """Return the panels of the free run with error bands about the model, and the time outside the region of logs."""
    free, time = comparison.replays[FREE_RUN].outputs, comparison.log.time
    drawn = {p.title: p for p in output_panels("", validity, time, {p.title: free[p.title] for p in panels})}
    drawn = {title.removeprefix("."): panel for title, panel in drawn.items()}
    return [
        replace(p, band=drawn[p.title].band if p.title in drawn else None, outside=outside_of(validity)) for p in panels
    ]


def neighbours(test: Whiteness) -> str:
    """Return the autocorrelation of neighbouring rows as text."""
    return plain(float(test.rho[1]), 2) if test.rho.size > 1 else MISSING


def _autocorrelation(comparison: Comparison, charts: Charts) -> list[Plot]:
    """Draw autocorrelations; channels with equally many lags share cursor and zoom."""
    plots, drawings = [], dict[int, Drawing]()
    for c in worst_first(comparison.channels):
        size = c.whiteness.rho.size
        if size < 2:
            continue
        apart, step = max(1, size // STEMS), comparison.log.step
        rows = np.arange(1, size, apart)
        if size not in drawings:  # half a lag is free at both ends
            ends = float(step * (rows[0] - 0.5 * apart)), float(step * (rows[-1] + 0.5 * apart))
            drawings[size] = charts.over(step * rows.astype(np.float64), Abscissa(("lag", "s"), ends))
        width = np.full(rows.size, c.whiteness.band)
        stem = Trace("residual", c.whiteness.rho[rows], "error", stems=True)
        band = Band("95 % band if white", -width, width)
        plots += drawings[size].plots([Panel(f"Autocorrelation of {c.name}", "1", [stem], band)])
    return plots


def _input_correlation(comparison: Comparison, charts: Charts) -> list[Plot]:
    plots = []
    for c in (c for c in worst_first(comparison.channels) if c.inputs):
        chosen = c.inputs[:OTHERS_PER_PANEL]
        traces = [Trace(u.name, u.rho, f"s{i}") for i, u in enumerate(chosen)]
        width = np.full(chosen[0].rho.size, max(u.band for u in chosen))
        panel = Panel(f"Residual of {c.name} with the commands", "1", traces, Band("95 % band", -width, width))
        lag = comparison.log.step * chosen[0].lags.astype(np.float64)
        ends = float(lag.min()), float(lag.max())
        plots += charts.over(lag, Abscissa(("lag of the residual behind the command", "s"), ends)).plots([panel])
    return plots
