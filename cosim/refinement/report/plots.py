"""The plots of the page about a refine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.arrays import Array, Rows
from cosim.logs.log import slowness
from cosim.logs.noise import NORMAL_95
from cosim.refinement.measure import Evidence
from cosim.refinement.record import Part
from cosim.refinement.refinement import Refinement
from cosim.refinement.report.dependence import bins
from cosim.refinement.report.terms import Shown
from cosim.report.panels import Band, Panel, Trace
from cosim.report.svg import Plot, extent, make_axis, make_plot, time_axis
from cosim.residuals.statistics import rmse
from cosim.text import counted, display, finer

POINTS = 700  # a curve
DOTS, FINE = 24, 80  # places with an error bar, and of the claimed curve
LEAST = 0.6  # [s] of rows behind an error bar
MEMORIES = 0.3  # [s] of rows that count as one in an error bar: twice the memory of what is smoothed
CLOSE_UP = 12.0  # [s]
CHANNELS = 8  # of a log, drawn: no more than a reader wants
TELLS = 1.1  # times the error after, from which the one before is worth a look
FAR = 1.5  # times the noise floor, likewise


@dataclass(frozen=True)
class Pairs:
    """Measured and model, and the residual, of one channel on one log."""

    channel: str
    plots: tuple[Plot, ...]
    tells: bool


@dataclass(frozen=True)
class Run:
    """One log: what it is, and its channels."""

    title: str
    channels: tuple[Pairs, ...]
    quiet: tuple[Pairs, ...]  # channels that the claim does not change and noise explains, folded away


# -- measured and model -----------------------------------------------------------------------


def runs(r: Refinement) -> list[Run]:
    """The first estimation and the first sealed log."""
    drawn = []
    words: dict[Part, str] = {"estimation": "learnt from", "validation": "sealed"}
    for part, word in words.items():
        before, after = (r.evidence[v].get(part) for v in ("before", "after"))
        if before and after:
            log = before[0][0]
            floor = r.record["noise_floors"].get(part, {})
            pairs = [_pair(r, before, after, name, floor.get(name, 0.0)) for name in list(log.outputs)[:CHANNELS]]
            loud = tuple(p for p in pairs if p.tells) or tuple(pairs)
            drawn.append(Run(f"{log.path.name}, {word}", loud, tuple(p for p in pairs if p not in loud)))
    return drawn


def _pair(r: Refinement, before: Evidence, after: Evidence, name: str, floor: float) -> Pairs:
    """The model's reading is the log's less its error: sensors that are known to be wrong are in it."""
    log, old = before[0]
    unit, factor = display(log.units.get(name, ""))
    fine, scale = finer(log.units.get(name, ""), max(rmse(e[0][1].errors(e[0][0])[name]) for e in (before, after)))
    starts = np.array(sorted(old.starts), dtype=np.intp)
    time = _broken(log.time, starts, log.time[starts])
    reading = log.outputs[name]
    curves = [("before", "s1", before), ("refined", "true", after)] if r.verdict.claimed else [("model", "true", after)]
    errors = [(label, style, e[0][1].errors(e[0][0])[name]) for label, style, e in curves]
    whole = [Trace("measured", _broken(reading, starts, reading[starts]) * factor, "estimate")]
    whole += [Trace(label, _broken(reading - e, starts, np.nan) * factor, style) for label, style, e in errors]
    left = [Trace(label, _broken(e, starts, np.nan) * scale, style) for label, style, e in errors]
    panels = (Panel(name, unit or "1", whole), Panel(f"{name}: measured − model", fine or "1", left))
    shaded = [replace(p, band=_windows(time, log.time[starts], old.horizon, p)) for p in panels]
    sizes = [rmse(e) for _, _, e in errors]
    tells = sizes[0] > TELLS * sizes[-1] or sizes[-1] > TELLS * sizes[0] or sizes[-1] > FAR * floor > 0
    x = time_axis(log.time)
    return Pairs(name, tuple(make_plot(p, time, x, limit=POINTS) for p in shaded), tells)


def _broken(values: Array, starts: Rows, between: Array | float) -> Array:
    """A value more right after each start, so that a curve can end there and begin anew."""
    return np.insert(values, starts + 1, between)


def _windows(time: Array, starts: Array, horizon: float, panel: Panel) -> Band | None:
    """Every other replay as a shade over the whole height, so that each restart shows."""
    span = extent([trace.values for trace in panel.traces])
    if span is None or starts.size < 2:
        return None
    inside = np.zeros(time.size, dtype=bool)
    for begin in starts[::2]:
        inside |= (time >= begin) & (time <= begin + horizon)
    low, high = (np.where(inside, value, np.nan) for value in span)
    return Band("every other replay", low, high)


# -- what is missing --------------------------------------------------------------------------


def against_signal(s: Shown) -> Plot:
    """Means of what the data say, with 95 % bars, and the claimed term."""
    unit, factor = _fitting(s)
    shown, scale = display(s.against.unit)
    x, pieces = s.against.values * scale, []
    bars, caps = [], []
    low, high = extent([x]) or (0.0, 1.0)
    wing, least = 0.004 * (high - low), max(1, min(round(LEAST * slowness(s.step) / s.step), x.size // DOTS))
    for rows in bins(x, DOTS, least):
        mean, around = float(s.estimated[rows].mean()), NORMAL_95 * _standard_error(s, rows)
        at = float(x[rows].mean())
        bars.append((np.full(3, at), np.array([mean - around, mean + around, np.nan])))
        caps.append((np.array([at - wing, at + wing, at]), np.array([mean, mean, np.nan])))
    pieces.append(tuple(np.concatenate([b[k] for b in bars]) for k in (0, 1)))
    pieces.append(tuple(np.concatenate([b[k] for b in caps]) for k in (0, 1)))
    if s.term is not None:
        groups = bins(x, FINE, max(1, least // 5))
        pieces.append((np.array([x[g].mean() for g in groups]), np.array([s.term[g].mean() for g in groups])))
    places, columns = side_by_side([(a, b) for a, b in pieces])
    traces = [
        Trace("data, with 95 %", columns[0] * factor, "warm"),
        Trace("mean", columns[1] * factor, "s1 solid wide"),
    ]
    if s.term is not None:
        traces.append(Trace(s.effect or "term without a name", columns[2] * factor, "true"))
    title = f"{_what(s)} against {s.against.name}"
    over = f"{s.against.name} in {shown or s.against.unit}"
    axis = make_axis(low, high, 6)
    return make_plot(Panel(title, unit or "1", traces), places, axis, limit=2 * len(places), over=over)


def over_time(s: Shown) -> Plot:
    """A close-up of the first log, where the claim moves most."""
    unit, factor = _fitting(s)
    count = max(2, min(s.first, round(CLOSE_UP * slowness(s.step) / s.step)))
    signal = s.estimated if s.term is None else s.term
    power = np.convolve((signal[: s.first] - signal[: s.first].mean()) ** 2, np.ones(count), "valid")
    first = int(np.argmax(power)) if power.size else 0
    rows = slice(first, first + count)
    estimated, width = s.estimated[rows] * factor, 2.0 * s.sigma[rows] * factor
    traces = [Trace("data", estimated, "estimate")]
    if s.term is not None:
        traces.append(Trace(s.effect or "term without a name", s.term[rows] * factor, "true"))
    panel = Panel(f"{_what(s)} over time", unit or "1", traces, Band("±2σ", estimated - width, estimated + width))
    return make_plot(panel, s.time[rows], time_axis(s.time[rows]), limit=POINTS)


def axis_label(s: Shown) -> str:
    """What stands under the first of the two plots."""
    shown = " · ".join(display(u)[0] or u for u in s.against.unit.split(" · "))
    return f"{s.against.name} [{shown or '1'}]"


def _what(s: Shown) -> str:
    return f"{s.what[0].upper()}{s.what[1:]}"


def _fitting(s: Shown) -> tuple[str, float]:
    return display(s.unit)


def _standard_error(s: Shown, rows: Rows) -> float:
    """Of a mean over rows that are alike within the memory of the smoother; a slope within them is no error."""
    alike = 1.0 if s.kind == "sensor" else max(1.0, MEMORIES * slowness(s.step) / s.step)
    count = max(1.0, rows.size / alike)
    x, y = s.against.values[rows], s.estimated[rows]
    spread = float(x.var())
    scatter = float(y.var()) - (float(np.mean((x - x.mean()) * (y - y.mean()))) ** 2 / spread if spread else 0.0)
    return float(np.sqrt((np.mean(s.sigma[rows] ** 2) + max(0.0, scatter)) / count))


def rows_shown(s: Shown) -> str:
    """How much data stands behind a picture."""
    return f"{counted(s.estimated.size, 'row')} of the estimation logs"


# -- shared ------------------------------------------------------------------------------------


def side_by_side(pieces: Sequence[tuple[Array, Array]]) -> tuple[Array, list[Array]]:
    """Curves with places of their own on one axis: each is NaN where the others are."""
    x = np.concatenate([p[0] for p in pieces])
    columns, first = [], 0
    for at, values in pieces:
        column = np.full(x.size, np.nan)
        column[first : first + at.size] = values
        columns.append(column)
        first += at.size
    return x, columns
