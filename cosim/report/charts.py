"""Charts of a page: specifications and rows, which the page's script draws and shows at the cursor."""

from __future__ import annotations

import base64
import json
import math
import sys
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.arrays import Array, Rows
from cosim.core.messages import printable_json
from cosim.report.panels import Panel, Trace, extent

MAX_PAGE_VALUES = 6_000_000  # values in a page; beyond, every n-th row
MAX_COUNT = 1e9  # held whole numbers below have no decimals
VALUE_DIGITS, SPAN_DIGITS = 5, 4  # significant digits of the largest value and of the span
MAX_CONSTANT_SPAN = 1e-12  # of the largest value: a signal with a smaller span is constant
MAX_EXACT = 1e15  # whole numbers up to here are exact in the script
MAX_DECIMALS = 300  # decimals; larger powers of ten overflow
BYTES_PER_DIFFERENCE = 7  # of a difference in a page
TIME_AXIS = ("time", "s")
NO_DATA: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Plot:
    """A chart for a template.

    Attributes:
        number: Index of the chart in the page.
        spec: Specification for the page's script.
        summary: Text in place of the picture.
    """

    number: int
    spec: Mapping[str, Any]
    summary: str


class Charts:
    """The charts of a page. Charts of one `Drawing` share cursor and zoom."""

    def __init__(self) -> None:
        self._charts: list[dict[str, Any]] = []
        self._groups: list[dict[str, Any]] = []
        self._columns: list[tuple[Array, int, bool]] = []  # values, decimals, True with one per x

    def over(
        self,
        x: Array,
        over: tuple[str, str] = TIME_AXIS,
        ends: tuple[float, float] | None = None,
        *,
        breaks: Sequence[int] = (),
        log: bool = False,
        points: bool = False,
    ) -> Drawing:
        """Start a drawing of panels with common x values.

        Args:
            over: Name and unit of the x axis.
            ends: Limits of the axis, by default its first and last value.
            breaks: Indices of rows after which traces with `anew` are interrupted.
            log: True for a logarithmic axis; all x must be positive.
            points: True if the cursor shows the values of the nearest point.
        """
        self._columns.append((x, decimals_of_time(x), True))
        group = {"over": over, "ends": ends, "breaks": list(breaks), "log": log, "points": points}
        self._groups.append({"x": len(self._columns) - 1, **group})
        return Drawing(self, len(self._groups) - 1, x)

    def alone(
        self, panel: Panel, ends: tuple[float, float], over: tuple[str, str], *, log: bool = False, **more: Any
    ) -> Plot:
        """Draw a chart whose traces and band have their own x values (`Trace.x`, `Band.x`).

        Args:
            ends: Limits of the x axis.
            more: Further settings for the script, such as `uprights`: values of x that are marked by a line.
        """
        places = [np.asarray(t.x) for t in panel.traces] + ([np.asarray(panel.band.x)] if panel.band else [])
        return self.over(np.unique(np.concatenate(places)), over, ends, log=log).plots([panel], **more)[0]

    def points(
        self, panel: Panel, ends: tuple[float, float], over: tuple[str, str], also: Mapping[str, Array], **more: Any
    ) -> Plot:
        """Draw the only trace of a panel as points; the cursor shows the values of the nearest point.

        Args:
            ends: Limits of the x axis.
            also: Label → further value of each point.
            more: Settings for the script: `reach`, limits of the y axis; `uprights`, values of x that are marked by a
                line.
        """
        (trace,) = panel.traces
        drawing = self.over(np.asarray(trace.x), over, ends, points=True)
        further = [[label, self.column(values)] for label, values in also.items()]
        return drawing.plots([replace(panel, traces=[replace(trace, x=None)])], also=further, **more)[0]

    def column(self, values: Array, *, held: bool = False, common: bool = True) -> int:
        """Add a column of values and return its index, by which the script reads it.

        Args:
            held: True if integers are stored without decimals.
            common: True if the column has one value per x of its drawing.
        """
        finite = values[np.isfinite(values)]
        is_whole = held and bool(np.all(np.abs(finite) < MAX_COUNT)) and np.array_equal(finite, np.rint(finite))
        self._columns.append((values, 0 if is_whole else decimals_of(values), common))
        return len(self._columns) - 1

    def add(self, group: int, panel: Panel, more: Mapping[str, Any]) -> Plot:
        """Add a chart to a group of charts; `more` contains further settings for the script."""

        def own(x: Array | None) -> int | None:
            return None if x is None else self.column(np.asarray(x), common=False)

        def entry(trace: Trace) -> dict[str, Any]:
            line = "held" if trace.held else "line"
            point = next((word for word in trace.style.split() if word in ("dots", "crosses")), "")
            return {
                "label": trace.label,
                "style": trace.style,
                "form": "bars" if trace.upper is not None else "stems" if trace.stems else point or line,
                "y": self.column(trace.values, held=trace.held, common=trace.x is None),
                "x": own(trace.x),
                "upper": None if trace.upper is None else self.column(trace.upper, common=trace.x is None),
                "anew": trace.anew,
                "items": {f"{value:.16g}": name for value, name in trace.items.items()},
            }

        words = []
        for trace in panel.traces:
            span = extent([trace.values] if trace.upper is None else [trace.values, trace.upper])
            words.append(f"{trace.label} {f'from {span[0]:.4g} to {span[1]:.4g}' if span else 'without values'}")
        chart = {"group": group, "title": panel.title, "unit": panel.unit, "traces": [*map(entry, panel.traces)]}
        chart |= {"levels": panel.limits, "limit": panel.limit_label, "outside": panel.outside, **more}
        if band := panel.band:
            edges = [self.column(edge, common=band.x is None) for edge in (band.lower, band.upper)]
            chart["band"] = {"label": band.label, "edges": edges, "x": own(band.x)}
        self._charts.append(chart)
        return Plot(len(self._charts) - 1, chart, "; ".join(words))

    def data(self, more: Mapping[str, Any] = NO_DATA) -> str:
        """Return charts, rows and further data as JSON for the page's script, safe inside a script element."""
        every = max(1, math.ceil(sum(values.size for values, *_ in self._columns) / MAX_PAGE_VALUES))
        chosen = [(v if not common else v[_rows(v.size, every)], decimals) for v, decimals, common in self._columns]
        groups = []
        for group in self._groups:
            size = self._columns[group["x"]][0].size
            breaks = np.searchsorted(_rows(size, every), group["breaks"], "right").tolist()
            groups.append({**group, "breaks": breaks, "every": every, "of": size})
        about = [[v.size, decimals, int(not np.isfinite(v).all())] for v, decimals in chosen]
        content = {"charts": self._charts, "groups": groups, "columns": about, "packed": pack(chosen), **more}
        text = printable_json(json.dumps(content, separators=(",", ":"), allow_nan=False))
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@dataclass(frozen=True)
class Drawing:
    """Charts with common x values. With a single row, a chart shows dots."""

    charts: Charts
    group: int
    x: Array

    def plots(self, panels: Sequence[Panel], **more: Any) -> list[Plot]:
        """Add panels and return their charts; `more` contains further settings for the script."""
        return [self.charts.add(self.group, panel, more) for panel in panels]


def _rows(count: int, every: int) -> Rows:
    """Return the indices of every n-th row and of the last row."""
    rows = np.arange(0, count, every)
    return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def sample_rows(count: int, limit: int) -> Rows:
    """Return the indices of about `limit` equidistant rows and of the last row."""
    return _rows(count, max(1, math.ceil(count / limit)))


def round_values(values: Array, digits: int) -> list[float | None]:
    """Return values rounded for JSON; a value that is not finite becomes null."""
    numbers = [round(value, digits) if math.isfinite(value) else None for value in values.tolist()]
    return [int(n) if n is not None and n == int(n) and abs(n) < MAX_EXACT else n for n in numbers]


# -- packing --------------------------------------------------------------------------------------


def decimals_of(values: Array) -> int:
    """Return the number of decimals with which a column is stored; negative for large numbers."""
    good = values[np.isfinite(values)]
    if not good.size or not np.any(good):
        return 0
    largest = float(np.max(np.abs(good)))
    span = min(float(np.max(good)) - float(np.min(good)), sys.float_info.max)
    digits = VALUE_DIGITS - 1 - math.floor(math.log10(largest))
    if span > MAX_CONSTANT_SPAN * largest:
        digits = max(digits, SPAN_DIGITS - 1 - math.floor(math.log10(span)))
    return min(digits, math.floor(math.log10(MAX_EXACT) - math.log10(largest)), MAX_DECIMALS)


def decimals_of_time(time: Array) -> int:
    """Return the number of decimals with which times are stored: enough for 1/1000 of the least step and for 1 µs."""
    steps = np.diff(time)
    steps = steps[steps > 0.0]
    digits = max(6, 3 - math.floor(math.log10(float(steps.min())))) if steps.size else 6
    largest = float(np.max(np.abs(time), initial=1.0))
    return min(digits, math.floor(math.log10(MAX_EXACT / max(largest, 1.0))))


def pack(columns: Sequence[tuple[Array, int]]) -> str:
    """Return columns, given as (values, decimals), as compressed base64 text.

    Values are rounded to integer multiples of 10^-decimals. A column contains their differences as zigzag numbers:
    first the lowest byte of all differences, then the next bytes. A column with gaps is followed by one byte per row.
    """
    parts = []
    for values, decimals in columns:
        good = np.isfinite(values)
        last = np.maximum.accumulate(np.where(good, np.arange(values.size), -1))
        filled = np.where(last >= 0, values[np.maximum(last, 0)], 0.0) if values.size else values
        scaled = filled * 10.0**decimals if decimals >= 0 else filled / 10.0**-decimals
        whole: NDArray[np.int64] = np.rint(scaled).astype(np.int64)
        steps = whole - np.append(np.int64(0), whole[:-1])
        zigzag = ((steps << 1) ^ (steps >> 63)).astype("<i8")
        parts.append(zigzag.view(np.uint8).reshape(-1, 8)[:, :BYTES_PER_DIFFERENCE].T.tobytes())
        parts.append(b"" if good.all() else good.astype(np.uint8).tobytes())
    return base64.b64encode(zlib.compress(b"".join(parts), 9)).decode("ascii")
