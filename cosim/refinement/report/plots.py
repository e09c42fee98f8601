"""Plots of logs and innovations on the page of a refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.core.text import MISSING, display, finer, plain
from cosim.estimation.data import count_unscored
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.proof.measure import ReplayedLogs
from cosim.refinement.record import Part
from cosim.refinement.refinement import Refinement
from cosim.report.charts import Abscissa, Charts, Drawing
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.residuals.report import neighbours
from cosim.residuals.residual_statistics import COUNTS_FROM, lags_of, rmse, whiteness


def runs(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return title and channels of the first estimation and sealed log.

    Channels whose error is near the noise floor are under `quiet`, unless all are.
    """
    pages = []
    words: dict[Part, str] = {"estimation": "used for the fits", "validation": "sealed"}
    for part, word in words.items():
        before, after = (r.evidence[v].get(part) for v in ("before", "after"))
        if not before or not after:
            continue
        log, old = before[0]
        curves = [("model", "true", after)]
        if r.verdict.claimed:
            curves = [("before", "s1", before), ("refined", "true", after)]
        elif r.verdict.nearest and (near := r.evidence.get("nearest", {}).get(part)):
            curves = [("model", "s1", before), ("nearest", "true", near)]
        floor = r.record["noise_floors"].get(part, {})
        drawing = charts.over(log.time, Abscissa(breaks=sorted(old.starts)))
        channels = [_channel(drawing, curves, name, floor.get(name, 0.0)) for name in log.outputs]
        loud, quiet = ([c for c in channels if c["tells"] == tells] for tells in (True, False))
        title = f"{log.path.name}, {word}"
        pages.append({"title": title, "channels": loud or quiet, "quiet": quiet if loud else []})
    return pages


def _channel(
    drawing: Drawing, curves: Sequence[tuple[str, str, ReplayedLogs]], name: str, floor: float
) -> dict[str, Any]:
    """Draw a channel of a log: measurement with model, and residual.

    The model's output is the reading minus its error, and includes sensor errors in the model.

    Args:
        curves: Label, style and replays of each model.
    """
    log, old = curves[0][2][0]
    errors = [(label, style, e[0][1].errors(e[0][0])[name]) for label, style, e in curves]
    sizes, reading = [rmse(e) for _, _, e in errors], log.outputs[name]
    (unit, factor), (fine, scale) = display(log.units.get(name, "")), finer(log.units.get(name, ""), max(sizes))
    whole = [Trace("measured", reading * factor, "estimate")]
    whole += [Trace(label, (reading - e) * factor, style, anew=True) for label, style, e in errors]
    residuals = [Trace(label, e * scale, style, anew=True) for label, style, e in errors]
    panels = [Panel(name, unit or "1", whole), Panel(f"{name}: measured − model", fine or "1", residuals)]
    starts, inside, shaded = sorted(old.starts), np.zeros(log.time.size, dtype=bool), []
    for k in starts[::2]:
        inside |= (log.time >= log.time[k]) & (log.time <= log.time[k] + old.horizon)
    for panel in panels:
        span = extent([trace.values for trace in panel.traces])
        if span is not None and len(starts) > 1:
            panel = replace(panel, band=Band("every other replay", *(np.where(inside, end, np.nan) for end in span)))
        shaded.append(panel)
    return {"channel": name, "plots": drawing.plots(shaded), "tells": max(sizes) > COUNTS_FROM * floor}


def innovations(r: Refinement, charts: Charts) -> list[dict[str, Any]]:
    """Return statistics and plots of the normalised innovations of each channel.

    Without a claim, the filter of the fit is compared with a filter that trusts its equations.
    """
    after, problem = r.variants["after"], r.problem
    pairs = [(after, replace(after.noise, power=problem.noise.smallest)), (after, after.noise)]
    if r.verdict.claimed:
        pairs[0] = (r.variants["before"], after.noise)
    both = []
    for variant, noise in pairs:
        parts = []
        for k, data in enumerate(problem.logs):
            run = problem.run({**problem.values, **variant.values}, noise, k)
            first = min(count_unscored(data), max(0, len(run.errors) - 2))
            scaled = (run.errors / np.sqrt(run.variances))[first:]
            parts.append(np.where(np.isfinite(scaled), scaled, np.nan))
        both.append(parts)
    names, styles, step = modes(r), ("s1", "true"), problem.logs[0].step
    drawing = charts.over(problem.logs[0].times[-len(both[0][0]) :])
    lags = lags_of(min(len(part) for part in both[0]), step)
    over_lags = charts.over(step * np.arange(1.0, lags + 1.0), Abscissa(("lag", "s")))
    gap = np.full(lags + 1, np.nan)  # beyond any lag, between logs
    found = []
    for channel in dict.fromkeys(n for log in r.study.logs for n in log.outputs if n in problem.layout.outputs):
        column = problem.layout.outputs.index(channel)
        series = [[part[:, column] for part in parts] for parts in both]
        tests = [whiteness(np.concatenate([piece for part in s for piece in (part, gap)]), lags) for s in series]
        traces = [Trace(n, s[0], style) for n, s, style in zip(names, series, styles, strict=True)]
        edge = np.full(series[0][0].size, NORMAL_95)
        panel = Panel(f"Innovation of {channel}", "σ", traces, Band("95 % of what is expected", -edge, edge))
        rho = [Trace(name, test.rho[1:], style) for name, test, style in zip(names, tests, styles, strict=True)]
        width = np.full(lags, np.nan_to_num(tests[1].band))
        beside = Panel(f"Autocorrelation of {channel}", "1", rho, Band("95 % band if white", -width, width))
        row = {
            "channel": channel,
            "size": [plain(rmse(np.concatenate(s)), 2) for s in series],
            "neighbours": [neighbours(t) for t in tests],
            "white": [MISSING if np.isnan(t.p_value) else "yes" if t.white else "no" for t in tests],
            "tells": not all(t.white for t in tests),
            "plots": [drawing.plots([panel])[0], over_lags.plots([beside])[0]],
        }
        found.append(row)
    return found


def modes(r: Refinement) -> tuple[str, str]:
    """Return the labels of the compared models, or of the compared filters without a claim."""
    return ("before", "refined") if r.verdict.claimed else ("equations trusted", "disturbance estimated")
