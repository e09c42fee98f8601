"""Panels on a common x axis with a budget of points, and charts with different axes on a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np

from cosim.base.arrays import Array
from cosim.report.chart_data import OVER_TIME, Abscissa, Series, sample_rows, to_json
from cosim.report.panels import Band, Panel
from cosim.report.svg import (
    TICKS_ACROSS,
    Axis,
    CursorValue,
    Keys,
    Plot,
    log_axis,
    lone_axis,
    make_axis,
    make_plot,
    time_axis,
)

NOTHING: Mapping[str, Array] = MappingProxyType({})
POINTS = 1000  # per curve of the first picture
ALL_POINTS = 60_000  # of all curves: limits the size of a page of a hundred signals


class Drawing:
    """Panels on a common x axis; the page's script has every row.

    A logarithmic axis requires x > 0. A single row is drawn as dots over an axis with a single tick.

    Attributes:
        few: Rows selected for an animated picture.
    """

    def __init__(self, time: Array, curves: int, abscissa: Abscissa = OVER_TIME, *, name: str = "") -> None:
        time = np.log10(time) if abscissa.log else time
        self.series = Series(time, curves, abscissa, name=name)
        self.few = sample_rows(time.size, POINTS)
        self.lone = time.size == 1
        self.axis: Axis = make_axis(*abscissa.ends, TICKS_ACROSS) if abscissa.ends else time_axis(time)
        if self.lone:
            self.axis = lone_axis(float(time[0]))
        elif abscissa.log:
            self.axis = log_axis(float(time[0]), float(time[-1]))
        self.limit = max(50, min(POINTS, ALL_POINTS // max(1, curves)))
        self.over = abscissa.label
        self.breaks = np.asarray(abscissa.breaks, dtype=np.intp)

    def plots(self, panels: Sequence[Panel]) -> list[Plot]:
        """Draw panels with values readable at the cursor."""
        time = self._insert_breaks(self.series.time)
        draw = partial(make_plot, limit=self.limit, over=self.over)
        return [draw(self._split_at_breaks(p), time, self.axis, self._keys(p)) for p in panels]

    def _keys(self, panel: Panel) -> Keys:
        return Keys(tuple(self.series.add(panel)), self.series.band(panel))

    def _split_at_breaks(self, panel: Panel) -> Panel:
        """Return a panel with rows at breaks of curves.

        A drawing of a single row shows dots instead of lines.
        """
        if self.lone:
            return replace(panel, traces=[replace(t, style=f"{t.style} dots", held=False) for t in panel.traces])
        if not self.breaks.size:
            return panel
        traces = [replace(t, values=self._insert_breaks(t.values, np.nan if t.anew else None)) for t in panel.traces]
        edges = panel.band and Band(
            panel.band.label, self._insert_breaks(panel.band.lower), self._insert_breaks(panel.band.upper)
        )
        return replace(panel, traces=traces, band=edges)

    def _insert_breaks(self, values: Array, between: float | None = None) -> Array:
        if not self.breaks.size:
            return values
        return np.insert(values, self.breaks + 1, values[self.breaks] if between is None else between)


class Charts:
    """The charts of a page. The charts of one drawing have a common cursor and zoom."""

    def __init__(self) -> None:
        self.blocks: list[Series] = []

    def over(self, x: Array, curves: int, abscissa: Abscissa = OVER_TIME) -> Drawing:
        """Start a drawing of panels over common values x."""
        drawing = Drawing(x, curves, abscissa, name=self._name())
        self.blocks.append(drawing.series)
        return drawing

    def alone(self, panel: Panel, axis: Axis, over: tuple[str, str], *, log: bool = False) -> Plot:
        """Draw a chart whose traces have their own x, in `Trace.x` and `Band.x`.

        Args:
            log: True for a logarithmic axis (`log_axis`).
        """
        panel = _logarithmic(panel) if log else panel
        places = [np.asarray(t.x) for t in panel.traces]
        if panel.band is not None and panel.band.x is not None:
            places.append(panel.band.x)
        # curves share a row at equal x; points of one curve at equal x have separate rows
        times = [np.arange(p.size) - np.searchsorted(p, p) for p in places]
        pairs = np.column_stack((np.concatenate(places), np.concatenate(times)))
        rows, at = np.unique(pairs, axis=0, return_inverse=True)
        x, at = rows[:, 0], at.ravel()
        over_x = Abscissa(over, (axis.low, axis.high), sparse=True, log=log)
        series = Series(x, x.size, over_x, name=self._name())
        self.blocks.append(series)
        begins = np.concatenate(([0], np.cumsum([p.size for p in places])))

        def spread(values: Array, number: int) -> Array:
            """Return the values of curve `number` in their rows among the rows of all curves."""
            column = np.full(x.size, np.nan)
            column[at[begins[number] : begins[number + 1]]] = values
            return column

        keys = [
            series.trace(t, spread(t.values, k), None if t.upper is None else spread(t.upper, k))
            for k, t in enumerate(panel.traces)
        ]
        band, last = panel.band, len(places) - 1
        edges = (series.column(spread(band.lower, last)), series.column(spread(band.upper, last))) if band else ()
        limit = max([2, *(p.size for p in places)])
        return make_plot(panel, x, axis, Keys(tuple(keys), edges), limit=min(limit, POINTS), over=over_x.label)

    def points(
        self, panel: Panel, axes: tuple[Axis, Axis], over: tuple[str, str], also: Mapping[str, Array] = NOTHING
    ) -> Plot:
        """Draw the only trace of a panel as points; the cursor reads the nearest point.

        axes: of x and y; also: further values of each point by label
        """
        (trace,), (across, up) = panel.traces, axes
        x = np.asarray(trace.x)
        over_x = Abscissa(over, (across.low, across.high), sparse=True, points=True)
        series = Series(x, 1, over_x, name=self._name())
        self.blocks.append(series)
        keys = Keys((series.trace(trace, trace.values),))
        plot = make_plot(panel, x, across, keys, over=over_x.label, y=up)
        extra = tuple(CursorValue(label, series.column(values)) for label, values in also.items())
        return replace(plot, also=extra, reach=(up.low, up.high))

    def data(self) -> str:
        """Return all rows as JSON for the page's script."""
        first, *further = self.blocks or [Series(np.zeros(0), 1)]
        return to_json(first, further=further)

    def _name(self) -> str:
        return f"d{len(self.blocks)}"


def _logarithmic(panel: Panel) -> Panel:
    """Return a panel with logarithmic x."""
    traces = [replace(t, x=np.log10(np.asarray(t.x))) for t in panel.traces]
    band = panel.band
    return replace(panel, traces=traces, band=band and replace(band, x=np.log10(np.asarray(band.x))))
