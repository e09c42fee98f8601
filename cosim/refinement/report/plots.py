"""Plots on the page of a refinement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import counted, display, finer
from cosim.logs.channel_noise import NORMAL_95
from cosim.logs.log import slowness
from cosim.refinement.proof.measure import Evidence
from cosim.refinement.record import Part
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.dependence import bins
from cosim.refinement.report.effect_plots import EffectComparison
from cosim.report.charts import Abscissa, Charts, Drawing, Plot
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.residuals.residual_statistics import rmse

DOTS, FINE = 24, 80  # points with an error bar, and points of the claimed curve
LEAST = 0.6  # [s] least duration of the rows of an error bar
MEMORIES = 0.3  # [s] between independent rows of an error bar: twice the smoother's memory
CLOSE_UP = 12.0  # [s] duration of a close-up
CHANNELS = 8  # at most, drawn of a log
TELLS = 1.1  # ratio of errors before and after; a larger one is worth a plot
MAX_FAST_SHARE = 0.5  # share of a missing quantity row by row; below it, means are compared
FAR = 1.5  # times the noise floor; a larger error is worth a plot
FLAT = 5.0  # ratio of errors before and after from which the smaller one is drawn on a scale of its own too


@dataclass(frozen=True)
class Pairs:
    """Plots of a channel on a log: measurement with model, and residual."""

    channel: str
    plots: tuple[Plot, ...]
    tells: bool


@dataclass(frozen=True)
class Run:
    """Plots of a log: title and channels."""

    title: str
    channels: tuple[Pairs, ...]
    quiet: tuple[Pairs, ...]  # folded channels: explained by noise, unchanged by the claim

    def without(self, pair: Pairs) -> Run:
        """Return the plots without a channel."""
        channels, quiet = (tuple(p for p in pairs if p is not pair) for pairs in (self.channels, self.quiet))
        return replace(self, channels=channels, quiet=quiet)


# -- measured and model -----------------------------------------------------------------------


def runs(r: Refinement, charts: Charts) -> list[Run]:
    """Return plots of the first estimation and sealed log."""
    pages = []
    words: dict[Part, str] = {"estimation": "used for the fits", "validation": "sealed"}
    for part, word in words.items():
        before, after = (r.evidence[v].get(part) for v in ("before", "after"))
        if before and after:
            log, old = before[0]
            curves = [("model", "true", after)]
            if r.verdict.claimed:
                curves = [("before", "s1", before), ("refined", "true", after)]
            elif r.verdict.nearest_hypothesis and (near := r.evidence.get("nearest", {}).get(part)):
                curves = [("model", "s1", before), ("nearest", "true", near)]
            floor, names = r.record["noise_floors"].get(part, {}), list(log.outputs)[:CHANNELS]
            drawing = charts.over(log.time, Abscissa(breaks=sorted(old.starts)))
            pairs = [_pair(drawing, curves, name, floor.get(name, 0.0)) for name in names]
            loud = tuple(p for p in pairs if p.tells) or tuple(pairs)
            pages.append(Run(f"{log.path.name}, {word}", loud, tuple(p for p in pairs if p not in loud)))
    return pages


def _pair(drawing: Drawing, curves: Sequence[tuple[str, str, Evidence]], name: str, floor: float) -> Pairs:
    """Draw a channel of a log.

    The model's output is the reading minus its error, and includes sensor errors in the model.

    Args:
        curves: Label, style and replays of each model.
    """
    log, old = curves[0][2][0]
    unit, factor = display(log.units.get(name, ""))
    fine, scale = finer(log.units.get(name, ""), max(rmse(e[0][1].errors(e[0][0])[name]) for *_, e in curves))
    reading = log.outputs[name]
    errors = [(label, style, e[0][1].errors(e[0][0])[name]) for label, style, e in curves]
    whole = [Trace("measured", reading * factor, "estimate")]
    whole += [Trace(label, (reading - e) * factor, style, anew=True) for label, style, e in errors]
    residuals = [Trace(label, e * scale, style, anew=True) for label, style, e in errors]
    sizes = [rmse(e) for _, _, e in errors]
    panels = [Panel(name, unit or "1", whole), Panel(f"{name}: measured − model", fine or "1", residuals)]
    if sizes[0] > FLAT * sizes[-1]:
        panels.append(Panel(f"{name}: measured − {curves[-1][0]}", fine or "1", residuals[-1:]))
    starts = log.time[np.array(sorted(old.starts), dtype=np.intp)]
    shaded = [replace(p, band=_windows(log.time, starts, old.horizon, p)) for p in panels]
    tells = sizes[0] > TELLS * sizes[-1] or sizes[-1] > TELLS * sizes[0] or sizes[-1] > FAR * floor > 0
    return Pairs(name, tuple(drawing.plots(shaded)), tells)


def _windows(time: Array, starts: Array, horizon: float, panel: Panel) -> Band | None:
    """Return a band over every other replay."""
    span = extent([trace.values for trace in panel.traces])
    if span is None or starts.size < 2:
        return None
    inside = np.zeros(time.size, dtype=bool)
    for begin in starts[::2]:
        inside |= (time >= begin) & (time <= begin + horizon)
    low, high = (np.where(inside, value, np.nan) for value in span)
    return Band("every other replay", low, high)


# -- what is missing --------------------------------------------------------------------------


def against_signal(s: EffectComparison, charts: Charts) -> Plot:
    """Draw the means of the missing quantity over a signal, and the claimed term."""
    unit, factor = display(s.unit)
    x = s.against.values * display(s.against.unit)[1]
    low, high = extent([x]) or (0.0, 1.0)
    least = max(1, min(round(LEAST * slowness(s.step) / s.step), x.size // DOTS))
    groups = bins(x, DOTS, least)
    at = np.array([x[rows].mean() for rows in groups])
    mean = np.array([s.estimated[rows].mean() for rows in groups])
    around = NORMAL_95 * np.array([_standard_error(s, rows) for rows in groups])
    traces = [
        Trace("data, with 95 %", (mean - around) * factor, "warm", x=at, upper=(mean + around) * factor),
        Trace("mean", mean * factor, "s1 dots", x=at),
    ]
    if s.term is not None:
        groups = bins(x, FINE, max(1, least // 5))
        places, term = (np.array([v[g].mean() for g in groups]) for v in (x, s.term))
        traces.append(Trace(s.effect or "unnamed term", term * factor, "true", x=places))
    title = f"{_heading(s)} against {s.against.name}"
    over = s.against.name, " · ".join(display(u)[0] or u for u in s.against.unit.split(" · ")) or "1"
    return charts.alone(Panel(title, unit or "1", traces), (low, high), over)


def over_time(s: EffectComparison, charts: Charts) -> Plot:
    """Draw a part of the first log over time, at the largest variation."""
    unit, factor = display(s.unit)
    count = max(2, min(s.first, round(CLOSE_UP * slowness(s.step) / s.step)))
    signal = s.estimated if s.term is None else s.term
    power = np.convolve((signal[: s.first] - signal[: s.first].mean()) ** 2, np.ones(count), "valid")
    first = int(np.argmax(power)) if power.size else 0
    rows = slice(first, first + count)
    estimated, width = s.estimated[rows] * factor, 2.0 * s.sigma[rows] * factor
    band: Band | None = Band("±2σ", estimated - width, estimated + width)
    traces = [Trace("data", estimated, "estimate")]
    average = min(round(s.horizon / s.step), count // 10)
    if s.share < MAX_FAST_SHARE and average > 1:
        smooth = np.convolve(s.estimated[: s.first], np.ones(average) / average, "same")[rows]
        traces, band = [Trace(f"data, mean over {average * s.step:.3g}\u00a0s", smooth * factor, "estimate")], None
    if s.term is not None:
        traces.append(Trace(s.effect or "unnamed term", s.term[rows] * factor, "true"))
    panel = Panel(f"{_heading(s)} over time", unit or "1", traces, band)
    return charts.over(s.time[rows]).plots([panel])[0]


def _heading(s: EffectComparison) -> str:
    return f"{s.quantity[0].upper()}{s.quantity[1:]}"


def _standard_error(s: EffectComparison, rows: Rows) -> float:
    """Return a mean's standard error over correlated rows.

    A linear trend in the rows does not count as scatter.
    """
    alike = 1.0 if s.kind == "sensor" else max(1.0, MEMORIES * slowness(s.step) / s.step)
    count = max(1.0, rows.size / alike)
    x, y = s.against.values[rows], s.estimated[rows]
    spread = float(x.var())
    scatter = float(y.var()) - (float(np.mean((x - x.mean()) * (y - y.mean()))) ** 2 / spread if spread else 0.0)
    return float(np.sqrt((np.mean(s.sigma[rows] ** 2) + max(0.0, scatter)) / count))


def rows_shown(s: EffectComparison) -> str:
    """Return the number of compared rows as text."""
    return f"{counted(s.estimated.size, 'row')} of the estimation logs"
