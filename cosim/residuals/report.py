"""The page of a replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import isfinite
from pathlib import Path

import numpy as np

from cosim.core.text import MISSING, amount, counted, display, percent, plain, size, split_sentence
from cosim.credibility.validity import Validity, output_panels, outside_of, validity_sentence
from cosim.files.files import path_from_here
from cosim.report.charts import Charts, Plot
from cosim.report.panels import OTHERS_PER_PANEL, Band, Panel, Trace, held_panels, signal_panel
from cosim.report.template import Row, assignments, command, render
from cosim.residuals.compare import ChannelSummary, Comparison, horizon_name, sentence, verdict, worst_first
from cosim.residuals.residual_statistics import FREE_RUN, Whiteness
from cosim.residuals.windows import SKIPPED, horizons

TEMPLATE = Path(__file__).with_name("templates") / "replay.html.j2"
STEMS = 100  # about, lags of an autocorrelation
ANSWER_TONES: Mapping[str, str] = {"explained": "good", "unexplained": "bad", "undecided": "warn"}


def page(comparison: Comparison, study: Path, validity: Validity, *, passing: bool = False) -> str:
    """Return the self-contained HTML page of a replay.

    Args:
        study: Path of the study that was written for `cosim fit` or `refine`, if any.
        validity: Validity of the free run in the region of the FMU's logs; empty without a record of credibility.
        passing: True if the FMU was built for this replay and is not kept.
    """
    log, drive, replays = comparison.log, comparison.drive, comparison.replays
    channels, measure, about = worst_first(comparison.channels), horizons(log)[-1], drive.description
    charts, word = Charts(), verdict(comparison)
    drawing = charts.over(log.time)
    headline, *details = filter(None, split_sentence(sentence(comparison)))
    units = {v.name: v.unit or "" for v in about.modelVariables}
    measured = [f"{n} ({percent(float(np.isfinite(v).mean()))})" for n, v in log.outputs.items()]
    steps = "as logged" if drive.variable_step else f"equal steps of {plain(log.step)} s, as the FMU requires"
    provenance = [
        Row("FMU", f"{about.modelName}\nguid {about.guid}", str(drive.fmu)),
        Row("Log", f"{log.rows} rows, t = {log.time[0]:.6g} … {log.time[-1]:.6g} s", str(log.path)),
        Row("Steps", steps),
        Row("Measured", ", ".join(measured), "share of rows with a reading"),
    ]
    if drive.free_inputs:
        provenance.append(Row("Not in the log", ", ".join(drive.free_inputs), "inputs at the start value of the FMU"))
    options = {"--fmu": [] if passing else [str(drive.fmu)], "--start": assignments(drive.given)}
    options["--column"] = assignments(log.called)

    def pairs(horizon: float) -> list[Panel]:
        """Return a panel of measured and model output for each channel."""
        label = "model, free run" if horizon == FREE_RUN else f"model, restarted every {horizon_name(horizon)}"
        outputs = replays[horizon].outputs
        lines = {n: (("measured", y, "estimate"), (label, outputs[n], "true")) for n, y in log.outputs.items()}
        return [signal_panel(name, log.units[name], both) for name, both in lines.items()]

    trusted = output_panels("", validity, log.time, replays[FREE_RUN].outputs)
    bands = {panel.title.removeprefix("."): panel.band for panel in trusted}
    free = [replace(p, band=bands.get(p.title), outside=outside_of(validity)) for p in pairs(FREE_RUN)]
    values = {
        "comparison": comparison,
        "log": log,
        "drive": drive,
        "channels": channels,
        "answer": (ANSWER_TONES[word], word, headline, details),
        "next": command("cosim", "refine", str(path_from_here(study))) if study.is_file() else "",
        "badges": [
            f"{plain(float(log.time[-1] - log.time[0]))} s at {plain(1.0 / log.step)} Hz",
            counted(log.rows, "row"),
            f"replayed through {about.modelName}",
        ],
        "bad": sum(f.severity == "warning" for f in comparison.findings),
        "measure": measure,
        "skipped": SKIPPED * log.slowness,
        "within": drawing.plots(pairs(measure)) if measure in replays else [],
        "free": drawing.plots(free),
        "trust": validity_sentence("FMU", validity).partition(": ")[2],
        "residual": drawing.plots([_residual_panel(comparison, c) for c in channels]),
        "shown": sum(not c.is_explained for c in channels) or len(channels),
        "commands": drawing.plots(held_panels(log.inputs, log.units)),
        "autocorrelation": _autocorrelation(comparison, charts),
        "inputs": _input_correlation(comparison, charts),
        "horizons": [(horizon_name(h), *_scores(h)) for h in sorted(replays)],
        "starts": [
            Row(n, amount(v, units.get(n, ""), 4) if isinstance(v, float) else str(v))
            for n, v in replays[FREE_RUN].starts[0].items()
        ],
        "provenance": provenance,
        **{f.__name__: f for f in (horizon_name, isfinite, neighbours)},
        "repeat": command("cosim", "replay", str(log.path), options=options),
    }
    return render(TEMPLATE, values, charts)


def _scores(horizon: float) -> tuple[Callable[[ChannelSummary], str], Callable[[ChannelSummary], str]]:
    """Return two functions of a channel that give the texts of its error and its fit over a horizon."""

    def fit(c: ChannelSummary) -> str:
        share = c.scores[horizon].fit
        return f"{plain(share)}\u00a0%" if isfinite(share) else MISSING

    return lambda c: size(c.scores[horizon].rmse, c.unit), fit


def neighbours(test: Whiteness) -> str:
    """Return the autocorrelation at lag 1 as text."""
    return plain(float(test.rho[1]), 2) if test.rho.size > 1 else MISSING


def _residual_panel(comparison: Comparison, c: ChannelSummary) -> Panel:
    unit, factor = display(c.unit)
    error = comparison.replays[c.measure].errors(comparison.log)[c.name] * factor
    width = np.full(error.size, 2.0 * factor * (c.noise if np.isfinite(c.noise) else 0.0))
    trace, band = Trace("measured − model", error, "error"), Band("±2σ of its noise", -width, width)
    return Panel(f"Residual of {c.name}", unit or "1", [trace], band)


def _autocorrelation(comparison: Comparison, charts: Charts) -> list[Plot]:
    """Draw the autocorrelations of all channels, with the same number of lags."""
    channels = worst_first(comparison.channels)
    size = channels[0].whiteness.rho.size
    apart, panels = max(1, size // STEMS), []
    rows = np.arange(1, size, apart)
    for c in channels if size > 1 else ():
        stem, width = (
            Trace("residual", c.whiteness.rho[rows], "error", stems=True),
            np.full(rows.size, c.whiteness.band),
        )
        panels.append(Panel(f"Autocorrelation of {c.name}", "1", [stem], Band("95 % band if white", -width, width)))
    lags = comparison.log.step * np.array([1.0 - 0.5 * apart, *rows, rows[-1:].sum() + 0.5 * apart])
    return charts.over(lags[1:-1], ("lag", "s"), (lags[0], lags[-1])).plots(panels) if panels else []


def _input_correlation(comparison: Comparison, charts: Charts) -> list[Plot]:
    plots = []
    for c in (c for c in worst_first(comparison.channels) if c.inputs):
        chosen = c.inputs[:OTHERS_PER_PANEL]
        traces = [Trace(u.name, u.rho, f"s{i}") for i, u in enumerate(chosen)]
        width = np.full(chosen[0].rho.size, max(u.band for u in chosen))
        panel = Panel(f"Residual of {c.name} with the commands", "1", traces, Band("95 % band", -width, width))
        lag = comparison.log.step * chosen[0].lags.astype(np.float64)
        plots += charts.over(lag, ("lag of the residual behind the command", "s")).plots([panel])
    return plots
