"""Innovations and their autocorrelation, before and after a refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import MISSING, plain
from cosim.estimation.data import count_unscored
from cosim.estimation.noise_model import Noise
from cosim.logs.channel_noise import NORMAL_95
from cosim.refinement.refinement import Refinement
from cosim.report.charts import Charts, Drawing, Plot
from cosim.report.panels import Band, Panel, Trace
from cosim.residuals.report import every_lag, lag_drawing, neighbours
from cosim.residuals.residual_statistics import Whiteness, lags_of, rmse, whiteness

STEMS = 50  # about, lags of an autocorrelation
STYLES = ("s1", "true")


@dataclass(frozen=True)
class WhitenessRow:
    """Statistics and plots of a channel's innovations, before and after."""

    channel: str
    size: tuple[str, str]
    neighbours: tuple[str, str]
    white: tuple[str, str]
    tells: bool
    plots: tuple[Plot, ...]


def modes(r: Refinement) -> tuple[str, str]:
    """Return the labels of the compared models, or of the compared filters without a claim."""
    return ("before", "refined") if r.verdict.claimed else ("equations trusted", "disturbance estimated")


def innovations(r: Refinement, charts: Charts) -> list[WhitenessRow]:
    """Return the normalised innovations of each channel.

    Without a claim, the filter of the fit is compared with a filter that trusts its equations.
    """
    after, logs = r.variants["after"], range(len(r.problem.logs))
    pair = [(after, replace(after.noise, power=r.problem.noise.smallest)), (after, after.noise)]
    if r.verdict.claimed:
        pair[0] = (r.variants["before"], after.noise)
    both = [[_innovations(r, dict(v.values), noise, k) for k in logs] for v, noise in pair]
    outputs = r.problem.layout.outputs
    ordered = [n for n in dict.fromkeys(n for log in r.study.logs for n in log.outputs) if n in outputs]
    first = r.problem.logs[0]
    time = first.times[-len(both[0][0]) :]
    drawing, lags = charts.over(time), lags_of(min(len(part) for part in both[0]), first.step)
    over = lag_drawing(charts, every_lag(lags, STEMS), first.step)
    return [
        _channel(r, name, [[p[:, outputs.index(name)] for p in parts] for parts in both], drawing, over, lags)
        for name in ordered
    ]


def _channel(
    r: Refinement, channel: str, both: Sequence[Sequence[Array]], drawing: Drawing, over: Drawing, lags: int
) -> WhitenessRow:
    names = modes(r)
    tests = [whiteness(_join_with_gaps(parts, lags), lags) for parts in both]
    traces = [Trace(n, parts[0], s) for n, parts, s in zip(names, both, STYLES, strict=True)]
    edge = np.full(both[0][0].size, NORMAL_95)
    panel = Panel(f"Innovation of {channel}", "σ", traces, Band("95 % of what is expected", -edge, edge))
    plots = drawing.plots([panel])[0], over.plots([_autocorrelation(channel, tests, names, over)])[0]
    size = [plain(rmse(np.concatenate(parts)), 2) for parts in both]
    rho = [neighbours(t) for t in tests]
    white = [MISSING if np.isnan(t.p_value) else "yes" if t.white else "no" for t in tests]
    tells = not all(t.white for t in tests)
    return WhitenessRow(channel, (size[0], size[1]), (rho[0], rho[1]), (white[0], white[1]), tells, plots)


def _innovations(r: Refinement, values: dict[str, float], noise: Noise, index: int) -> Array:
    run = r.problem.run({**r.problem.values, **values}, noise, index)
    first = min(count_unscored(r.problem.logs[index]), max(0, len(run.errors) - 2))
    scaled: Array = (run.errors / np.sqrt(run.variances))[first:]
    return np.where(np.abs(scaled) < 1e6, scaled, np.nan)


def _join_with_gaps(parts: Sequence[Array], lags: int) -> Array:
    """Join innovations of logs with gaps beyond any lag."""
    gap = np.full(lags + 1, np.nan)
    return np.concatenate([piece for part in parts for piece in (part, gap)])


def _autocorrelation(channel: str, tests: Sequence[Whiteness], names: Sequence[str], over: Drawing) -> Panel:
    """Return a panel with two autocorrelations side by side, drawn as stems."""
    rows, lag = every_lag(tests[0].rho.size - 1, STEMS), over.x
    offset = 0.16 * (lag[1] - lag[0] if lag.size > 1 else lag[0])
    traces = [
        Trace(name, test.rho[rows], style, stems=True, shift=shift)
        for name, test, style, shift in zip(names, tests, ("s1 solid", "true"), (-offset, offset), strict=True)
    ]
    width = np.full(rows.size, tests[1].band if np.isfinite(tests[1].band) else 0.0)
    return Panel(f"Autocorrelation of {channel}", "1", traces, Band("95 % band if white", -width, width))
