"""The page of a replay."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.text import MISSING, amount, counted, display, percent, plain, size, split_sentence
from cosim.base.version import __version__
from cosim.logs.finding import Finding
from cosim.logs.log import Log
from cosim.report.charts import Abscissa, Charts, Drawing, Plot
from cosim.report.html_tables import Badge, Row
from cosim.report.panels import OTHERS_PER_PANEL, Band, Panel, Trace, by_unit
from cosim.residuals import replay_sentences as words
from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.drive import Drive
from cosim.residuals.lags import every_lag, lag_drawing, neighbours
from cosim.residuals.residual_statistics import FREE_RUN
from cosim.residuals.windows import SKIPPED

TEMPLATE = Path(__file__).with_name("templates") / "replay.html.j2"
STEMS = 100  # about, lags of an autocorrelation


# -- the page ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class TableRow:
    """One channel of the tables, as text."""

    name: str
    noise: str
    scores: tuple[tuple[str, str], ...]
    excess: str
    matched: bool
    neighbours: str
    p_value: str
    white: str
    follows: str


def _command(log: Log, drive: Drive, passing: bool) -> list[str]:
    """Return the command to repeat this replay."""
    options = [] if passing else ["--plant", str(drive.fmu)]
    for name, value in drive.given.items():
        options += ["--start", f"{name}={str(value).lower() if isinstance(value, bool) else value}"]
    for column, name in log.called.items():
        options += ["--column", f"{column}={name}"]
    return ["cosim", "replay", str(log.path), *options]


def context(comparison: Comparison, *, passing: bool = False) -> Mapping[str, Any]:
    """Return the values of the template.

    Args:
        passing: True if the FMU was built for this replay only.
    """
    log, drive = comparison.log, comparison.drive
    charts = Charts()
    drawing = charts.over(log.time)
    windowed, measure = comparison.measure in comparison.replays, comparison.measure
    skipped = SKIPPED * log.slowness
    horizons = sorted(comparison.replays)
    findings = comparison.findings
    headline, details = split_sentence(words.verdict(comparison))
    return {
        "name": log.path.name,
        "description": f"Replayed through {drive.description.modelName} ({drive.fmu.name}): the recorded commands "
        "drive the model; its outputs are compared with the measurements.",
        "headline": headline,
        "details": details,
        "tone": "good" if all(c.is_explained for c in comparison.channels) else "plain",
        "badges": _badges(comparison),
        "tiles": [_tile(c) for c in comparison.channels[:6]],
        "horizons": [words.horizon_name(h) for h in horizons],
        "measure": words.horizon_name(measure),
        "skipped": words.horizon_name(skipped),
        "least": words.horizon_name(skipped + measure),
        "basis": "the free run" if comparison.basis == FREE_RUN else words.horizon_name(comparison.basis),
        "within": drawing.plots(_pair_panels(comparison, measure)) if windowed else [],
        "free": drawing.plots(_pair_panels(comparison, FREE_RUN)),
        "residual": drawing.plots(_residual_panels(comparison)),
        "commands": drawing.plots(_command_panels(log)),
        "autocorrelation": _autocorrelation(comparison, charts),
        "inputs": _input_correlation(comparison, charts),
        "rows": [_row(c, horizons) for c in comparison.channels],
        "quality": words.quality(findings),
        "warnings": [f.whole for f in findings if f.severity != "note"],
        "notes": [Row(f.channel or "log", f.sentence) for f in findings if f.severity == "note"],
        "starts": [_start(drive, n, v) for n, v in comparison.replays[FREE_RUN].starts[0].items()],
        "provenance": _provenance(comparison),
        "repeat": shlex.join(_command(log, drive, passing)),
        "data": charts.data(),  # after all drawings
        "version": __version__,
    }


def _badges(comparison: Comparison) -> list[Badge]:
    log = comparison.log
    explained, warnings = sum(c.is_explained for c in comparison.channels), _warnings(comparison.findings)
    badges = [
        Badge(f"{explained} of {counted(len(comparison.channels), 'channel')} explained"),
        Badge(f"{plain(float(log.time[-1] - log.time[0]))} s at {plain(1.0 / log.step)} Hz"),
        Badge(counted(log.rows, "row")),
    ]
    return badges + ([Badge(counted(warnings, "warning"), "warn")] if warnings else [])


def _warnings(findings: Sequence[Finding]) -> int:
    return sum(f.severity == "warning" for f in findings)


def _tile(channel: ChannelSummary) -> Row:
    measure = channel.measure
    value = size(channel.scores[measure].rmse, channel.unit)
    over = "in a free run" if measure == FREE_RUN else f"rms over {words.horizon_name(measure)}"
    noise = f", {plain(channel.excess, 2)} × what noise explains" if np.isfinite(channel.excess) else ""
    return Row(channel.name, value, over + noise)


def _pair_panels(comparison: Comparison, horizon: float) -> list[Panel]:
    """Return measured and model outputs, a panel per channel."""
    log, outputs = comparison.log, comparison.replays[horizon].outputs
    label = "model, free run" if horizon == FREE_RUN else f"model, started anew every {words.horizon_name(horizon)}"
    panels = []
    for name, measured in log.outputs.items():
        unit, factor = display(log.units[name])
        traces = [Trace("measured", measured * factor, "estimate"), Trace(label, outputs[name] * factor, "true")]
        panels.append(Panel(name, unit or "1", traces))
    return panels


def _residual_panels(comparison: Comparison) -> list[Panel]:
    """Return the residuals, with ±2σ of the measurement noise."""
    panels = []
    for c in comparison.channels:
        unit, factor = display(c.unit)
        error = comparison.replays[c.measure].errors(comparison.log)[c.name] * factor
        width = np.full(error.size, 2.0 * factor * (c.noise if np.isfinite(c.noise) else 0.0))
        traces, band = [Trace("measured − model", error, "error")], Band("±2σ of its noise", -width, width)
        panels.append(Panel(f"Residual of {c.name}", unit or "1", traces, band))
    return panels


def _command_panels(log: Log) -> list[Panel]:
    panels = []
    for unit, names in by_unit(log.inputs, log.units.__getitem__, log.inputs.__getitem__):
        unit_text, factor = display(unit)
        traces = [Trace(n, log.inputs[n] * factor, f"s{i}", held=True) for i, n in enumerate(names)]
        panels.append(Panel(", ".join(names), unit_text or "1", traces))
    return panels


def _autocorrelation(comparison: Comparison, charts: Charts) -> list[Plot]:
    """Draw autocorrelations; channels with equally many lags share cursor and zoom."""
    plots, drawings = [], dict[int, Drawing]()
    for c in comparison.channels:
        size = c.whiteness.rho.size
        if size < 2:
            continue
        rows = every_lag(size - 1, STEMS)
        if size not in drawings:
            drawings[size] = lag_drawing(charts, rows, comparison.log.step)
        width = np.full(rows.size, c.whiteness.band)
        stem = Trace("residual", c.whiteness.rho[rows], "error", stems=True)
        band = Band("95 % band if white", -width, width)
        plots += drawings[size].plots([Panel(f"Autocorrelation of {c.name}", "1", [stem], band)])
    return plots


def _input_correlation(comparison: Comparison, charts: Charts) -> list[Plot]:
    plots = []
    for c in (c for c in comparison.channels if c.inputs):
        chosen = c.inputs[:OTHERS_PER_PANEL]
        traces = [Trace(u.name, u.rho, f"s{i}") for i, u in enumerate(chosen)]
        width = np.full(chosen[0].rho.size, max(u.band for u in chosen))
        panel = Panel(f"Residual of {c.name} with the commands", "1", traces, Band("95 % band", -width, width))
        lag = comparison.log.step * chosen[0].lags.astype(np.float64)
        ends = float(lag.min()), float(lag.max())
        plots += charts.over(lag, Abscissa(("lag of the residual behind the command", "s"), ends)).plots([panel])
    return plots


def _row(channel: ChannelSummary, horizons: Sequence[float]) -> TableRow:
    scores = tuple(
        (size(s.rmse, channel.unit), f"{plain(s.fit)}\u00a0%" if np.isfinite(s.fit) else MISSING)
        for s in (channel.scores[h] for h in horizons)
    )
    p = channel.whiteness.p_value
    return TableRow(
        name=channel.name,
        noise=size(channel.noise, channel.unit),
        scores=scores,
        excess=f"{plain(channel.excess, 2)} ×" if np.isfinite(channel.excess) else MISSING,
        matched=channel.is_matched,
        neighbours=neighbours(channel.whiteness),
        p_value="< 0.001" if p < 1e-3 else plain(p, 2),
        white=words.whiteness_words(channel),
        follows=words.input_words(channel),
    )


def _start(drive: Drive, name: str, value: Any) -> Row:
    unit = next((v.unit or "" for v in drive.description.modelVariables if v.name == name), "")
    return Row(name, amount(value, unit, 4) if isinstance(value, float) else str(value))


def _provenance(comparison: Comparison) -> list[Row]:
    drive, log = comparison.drive, comparison.log
    about = drive.description
    steps = "as logged" if drive.variable_step else f"equal steps of {plain(log.step)} s, as the FMU demands"
    rows = [
        Row("FMU", f"{about.modelName}\nguid {about.guid}", str(drive.fmu)),
        Row("Log", f"{log.rows} rows, t = {log.time[0]:.6g} … {log.time[-1]:.6g} s", str(log.path)),
        Row("Steps", steps),
        Row("cosim", __version__),
    ]
    if drive.free_inputs:
        rows.append(Row("Not in the log", ", ".join(drive.free_inputs), "inputs at the start value of the FMU"))
    measured = [(n, float(np.isfinite(v).mean())) for n, v in log.outputs.items()]
    return [*rows, Row("Measured", ", ".join(f"{n} ({percent(share)})" for n, share in measured), "share of the rows")]
