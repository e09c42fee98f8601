"""Panels drawn with one time axis and one budget of points."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.arrays import Array
from cosim.report.data import Series, sample_rows
from cosim.report.panels import Panel
from cosim.report.svg import Axis, Keys, Plot, make_plot, time_axis

POINTS = 1000  # a curve of the first picture
ALL_POINTS = 60_000  # of all curves together: keeps a page of a hundred signals small


class Drawing:
    """Draws panels with one time axis; the script knows every row of them.

    few: rows for a picture that moves between them
    """

    def __init__(self, time: Array, curves: int) -> None:
        self.series = Series(time, curves)
        self.few = sample_rows(time.size, POINTS)
        self.axis: Axis = time_axis(time)
        self.limit = max(50, min(POINTS, ALL_POINTS // max(1, curves)))

    def plots(self, panels: Sequence[Panel]) -> list[Plot]:
        """Plots whose values can be read at the cursor."""
        return [make_plot(p, self.series.time, self.axis, self._keys(p), self.limit) for p in panels]

    def _keys(self, panel: Panel) -> Keys:
        return Keys(tuple(self.series.add(panel)), self.series.band(panel))
