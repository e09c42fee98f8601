"""Panels as SVG paths and ticks, legible without a script.

Curves have whole-number coordinates in a box of WIDTH × HEIGHT, stretched by the browser to any size. Lines keep their
width and labels are HTML beside the box, so the text is as legible at 400 px as at 1400 px.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array, Rows
from cosim.base.text import MINUS, MISSING
from cosim.report.panels import BARS, CROSSES, DOTS, STEMS, Panel, Trace

WIDTH, HEIGHT = 4000, 1000
TICKS_ACROSS, TICKS_UP = 6, 5  # about
CAP = 18  # half the width of a bar's ends
LONE, RISE = 28, 17  # half the width and height of the cross for a sample between two gaps
RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
Integers = NDArray[np.int64]
WIDEST_BAND = 1e6  # times the height of the curves: the band of a diverged filter must not hide them


@dataclass(frozen=True)
class Tick:
    """A label at a position along the axis [%]."""

    at: float
    label: str


@dataclass(frozen=True)
class Axis:
    """A range of values with ticks.

    Attributes:
        factor: Power of ten that multiplies the labels.
    """

    low: float
    high: float
    ticks: tuple[Tick, ...]
    factor: str = ""

    def scale(self, values: Array, size: int) -> Integers:
        """Scale values to whole numbers, 0 … size along the axis."""
        share = (values - self.low) / (self.high - self.low)
        return np.rint(np.clip(share, -9, 10) * size).astype(np.int64)


@dataclass(frozen=True)
class Curve:
    """A drawn line.

    Attributes:
        value: Text of the value of a line with a single row.
    """

    label: str
    style: str
    path: str
    key: str
    value: str = ""


@dataclass(frozen=True)
class CursorValue:
    """A value shown at the cursor but not drawn: its label and the key of its series."""

    label: str
    key: str


@dataclass(frozen=True)
class Keys:
    """Keys of the series of a panel's traces and of its band's edges."""

    traces: tuple[str, ...] = ()
    band: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plot:
    """A panel ready for a template: curves, band and limits in the drawing's box, ticks in percent.

    Attributes:
        levels: Limits in the panel's unit.
        keys: Keys of the panel's data series in the page.
        also: Values shown by the cursor but not drawn.
        uprights: Values of x with a vertical line.
        reach: Ends of the y axis, if the page's script needs them.
    """

    title: str
    unit: str
    curves: tuple[Curve, ...]
    band: str
    band_label: str
    limits: tuple[int, ...]
    limit_label: str
    x: Axis
    y: Axis
    zero: int | None
    summary: str
    levels: tuple[float, ...] = ()
    keys: Keys = field(default_factory=Keys)
    also: tuple[CursorValue, ...] = ()
    uprights: tuple[float, ...] = ()
    reach: tuple[float, float] | None = None


NO_KEYS = Keys()
MAX_END = 1e300  # largest end of an axis: its span and margins must not overflow


def extent(signals: Sequence[Array]) -> tuple[float, float] | None:
    """Return the least and largest finite value."""
    finite = np.concatenate([np.zeros(0), *(values[np.isfinite(values)] for values in signals)])
    return (float(finite.min()), float(finite.max())) if finite.size else None


def make_axis(low: float, high: float, count: int, angle: bool = False) -> Axis:
    """Return an axis with about `count` round ticks.

    Huge and tiny ticks share a power of ten.
    """
    low, high = (min(max(end, -MAX_END), MAX_END) for end in (low, high))
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        room = 0.1 * abs(low) or 1.0
        low, high = low - room, high + room
    step = round_step((high - low) / count, angle)
    power = power_of_ten(max(abs(low), abs(high)))
    unit = step / 10.0**power
    decimals = max(0, -math.floor(math.log10(unit) + 1e-9))
    decimals += 0 if abs(unit * 10**decimals - round(unit * 10**decimals)) < 1e-6 else 1
    places = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ticks = (Tick(100 * (i * step - low) / (high - low), tick_label(i * unit, decimals)) for i in places)
    return Axis(low, high, tuple(ticks), f"×10{str(power).translate(RAISED)}" if power else "")


def power_of_ten(largest: float) -> int:
    """Return the exponent of an axis' labels, a multiple of three.

    Labels from 0.001 to 10⁶ have no exponent.
    """
    return 0 if 1e-3 <= largest < 1e6 else 3 * math.floor(math.log10(largest) / 3 + 1e-9)


def round_step(step: float, angle: bool = False) -> float:
    """Return a step rounded up to 1, 2, 2.5 or 5 × 10^n; an angle [deg] to a fraction of a turn."""
    if angle and 10 < step <= 360:
        return next(float(part) for part in (15, 30, 45, 90, 180, 360) if part >= step)
    power = 10.0 ** math.floor(math.log10(step))
    return next((m * power for m in (1, 2, 2.5, 5) if m * power >= step * (1 - 1e-9)), 10 * power)


def tick_label(value: float, decimals: int) -> str:
    """Return the text of a tick."""
    return f"{value:.{decimals}f}".replace("-", MINUS)


def log_axis(low: float, high: float) -> Axis:
    """Return an axis over 10^low … 10^high.

    Ticks are decades. With fewer than three decades, ticks between decades are added, or linear ticks replace them.
    """
    every = max(1, math.ceil((high - low) / 8))
    decades = [d for d in range(math.floor(low), math.ceil(high) + 1) if d % every == 0]

    def at(value: float) -> float:
        return 100 * (math.log10(value) - low) / (high - low)

    for parts in ((1,), (1, 2, 5), range(1, 10)):
        values = [m * 10.0**d for d in decades for m in parts]
        ticks = tuple(Tick(at(v), _short_text(v)) for v in values if -1e-7 < at(v) < 100 + 1e-7)
        if len(ticks) >= 3:
            return Axis(low, high, ticks)
    linear = make_axis(10.0**low, 10.0**high, 6)
    span = linear.high - linear.low
    return Axis(
        low, high, tuple(Tick(at(linear.low + t.at / 100 * span), t.label) for t in linear.ticks), linear.factor
    )


def _short_text(value: float) -> str:
    return f"{value:g}".replace("e-0", "e-").replace("e+0", "e").replace("e+", "e").replace("-", MINUS)


def lone_axis(value: float) -> Axis:
    """Return an axis with a single tick at a value."""
    return Axis(value - 0.5, value + 0.5, (Tick(50.0, f"{value:g}".replace("-", MINUS)),))


def thin(values: Array, limit: int) -> Rows:
    """Return about `limit` row numbers of a signal that keep every peak and gap.

    Each bucket keeps its least and largest value, and its first gap.
    """
    count = values.size
    if count <= limit:
        return np.arange(count)
    chosen = {0, count - 1}
    good = np.isfinite(values)
    for rows in np.array_split(np.arange(count), max(1, limit // 2)):
        some = rows[good[rows]]
        if some.size:
            chosen.update((int(some[np.argmin(values[some])]), int(some[np.argmax(values[some])])))
        if some.size < rows.size:
            chosen.add(int(rows[~good[rows]][0]))
    return np.array(sorted(chosen), dtype=np.intp)


def runs(good: NDArray[np.bool_]) -> list[slice]:
    """Return the ranges of consecutive drawable rows."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    return [slice(int(first), int(last)) for first, last in zip(edges[::2], edges[1::2], strict=True)]


def polyline(u: Integers, v: Integers, held: bool = False) -> str:
    """Return a line, or steps if `held`, in relative coordinates."""
    if u.size == 1:
        return f"M{u[0] - LONE} {v[0]}h{2 * LONE}m{-LONE} {-RISE}v{2 * RISE}"  # a lone sample: a visible cross
    path = [f"M{u[0]} {v[0]}"]
    flat = 0  # length of the current level stretch
    for du, dv in zip(np.diff(u).tolist(), np.diff(v).tolist(), strict=True):
        if dv == 0:
            flat += du
        elif held:
            path.append((f"h{flat + du}" if flat + du else "") + f"v{dv}")
            flat = 0
        else:
            path.append((f"h{flat}" if flat else "") + (f"l{du}{dv}" if dv < 0 else f"l{du} {dv}"))
            flat = 0
    if flat:
        path.append(f"h{flat}")
    return "".join(path)


def curve_path(x: Axis, y: Axis, time: Array, trace: Trace, limit: int) -> str:
    """Return the SVG path of a trace: a line that is broken at gaps, or marks."""
    time = time if trace.x is None else trace.x
    if trace.form in (DOTS, STEMS, BARS, CROSSES):
        return _marks(x, y, time + trace.shift, trace)
    rows = thin(trace.values, limit)
    values = trace.values[rows]
    u = x.scale(time[rows], WIDTH)
    v = HEIGHT - y.scale(np.where(np.isfinite(values), values, y.low), HEIGHT)
    return "".join(polyline(u[part], v[part], trace.held) for part in runs(np.isfinite(values)))


def _marks(x: Axis, y: Axis, places: Array, trace: Trace) -> str:
    """Return dots, crosses, stems from zero, or bars with caps."""
    good = np.isfinite(places) & np.isfinite(trace.values)
    u, v = x.scale(places[good], WIDTH).tolist(), (HEIGHT - y.scale(trace.values[good], HEIGHT)).tolist()
    points = list(zip(u, v, strict=True))
    if trace.form == DOTS:
        return "".join(f"M{a} {b}h0" for a, b in dict.fromkeys(points))
    if trace.form == CROSSES:
        w, h = 2 * CAP, 22
        return "".join(f"M{a - w} {b - h}l{2 * w} {2 * h}m{-2 * w} 0l{2 * w}{-2 * h}" for a, b in points)
    if trace.form == STEMS:
        zero = HEIGHT - int(y.scale(np.zeros(1), HEIGHT)[0])
        return "".join(f"M{a} {zero}V{b}" for a, b in points)
    top = (HEIGHT - y.scale(np.asarray(trace.upper)[good], HEIGHT)).tolist()
    bars = zip(u, v, top, strict=True)
    return "".join(f"M{a - CAP} {b}h{2 * CAP}m{-CAP} 0V{c}m{-CAP} 0h{2 * CAP}" for a, b, c in bars)


def band_path(x: Axis, y: Axis, time: Array, lower: Array, upper: Array, limit: int) -> str:
    """Return the region between two lines as closed paths."""
    rows = np.unique(np.linspace(0, time.size - 1, min(limit, time.size)).astype(np.intp))
    low, high = lower[rows], upper[rows]
    good = np.isfinite(low) & np.isfinite(high)
    u = x.scale(time[rows], WIDTH)
    a, b = (HEIGHT - y.scale(np.where(good, line, y.low), HEIGHT) for line in (low, high))
    outlines = ((np.concatenate((u[p], u[p][::-1])), np.concatenate((b[p], a[p][::-1]))) for p in runs(good))
    return "".join(polyline(us, vs) + "z" for us, vs in outlines)


def value_axis(panel: Panel) -> Axis:
    """Return a y axis that contains the curves, limits and band of a panel.

    An extremely wide band is cut off. Without values the axis has no ticks.
    """
    span = extent([values for trace in panel.traces for values in trace.reach])
    if span is None and not panel.limits:
        return Axis(0.0, 1.0, ())
    low, high = span or (min(panel.limits), max(panel.limits))
    if panel.band is not None and (edges := extent([panel.band.lower, panel.band.upper])):
        room = WIDEST_BAND * (high - low or 1.0)
        low, high = max(min(low, edges[0]), low - room), min(max(high, edges[1]), high + room)
    low, high = min((low, *panel.limits)), max((high, *panel.limits))
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
    return make_axis(low - margin, high + margin, TICKS_UP, panel.unit == "°")


def time_axis(time: Array) -> Axis:
    """Return the time axis that all plots of a run share."""
    low, high = extent([time]) or (0.0, 1.0)
    return make_axis(low, high if high > low else low + 1.0, TICKS_ACROSS)


def make_plot(
    panel: Panel,
    time: Array,
    x: Axis,
    keys: Keys = NO_KEYS,
    *,
    limit: int = 1000,
    over: str = "time in s",
    y: Axis | None = None,
) -> Plot:
    """Draw a panel.

    Args:
        keys: Keys of the panel's data series in the page, one for each curve.
        over: Name and unit of x.
    """
    y = y or value_axis(panel)
    names = list(keys.traces) + [""] * (len(panel.traces) - len(keys.traces))
    curves = tuple(
        Curve(trace.label, trace.style, curve_path(x, y, time, trace, limit), key, _single_value_text(trace))
        for trace, key in zip(panel.traces, names, strict=True)
    )
    band = panel.band
    places = time if band is None or band.x is None else band.x
    shade = band_path(x, y, places, band.lower, band.upper, limit // 2) if band else ""
    levels = HEIGHT - y.scale(np.array(panel.limits), HEIGHT)
    zero = HEIGHT - int(y.scale(np.zeros(1), HEIGHT)[0]) if y.low < 0 < y.high else None
    return Plot(
        title=panel.title,
        unit=panel.unit,
        curves=curves,
        band=shade,
        band_label=band.label if band else "",
        limits=tuple(levels.tolist()),
        limit_label=panel.limit_label,
        x=x,
        y=y,
        zero=zero,
        summary=_summary(panel, over),
        levels=tuple(panel.limits),
        keys=keys,
    )


def _single_value_text(trace: Trace) -> str:
    """Return the text of a trace with one row."""
    if trace.values.size != 1:
        return ""
    value = float(trace.values[0])
    return trace.items.get(value) or (f"{value:.6g}".replace("-", MINUS) if math.isfinite(value) else MISSING)


def _summary(panel: Panel, over: str) -> str:
    """Describe a panel for screen readers."""
    parts = []
    for trace in panel.traces:
        span = extent([trace.values] if trace.upper is None else trace.reach)
        parts.append(f"{trace.label} from {span[0]:.4g} to {span[1]:.4g}" if span else f"{trace.label} without values")
    return f"{panel.title} in {panel.unit} over {over}: {'; '.join(parts)}."
