"""Panels drawn with one time axis and one budget of points."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.arrays import Array
from cosim.report.data import Series, sample_rows
from cosim.report.panels import Panel
from cosim.report.svg import Axis, Plot, make_plot, time_axis

POINTS = 1000  # a curve, and rows for the script
ALL_POINTS = 60_000  # of all curves together: keeps a page of a hundred signals small


class Drawing:
    """Draws panels with one time axis and one budget of points."""

    def __init__(self, time: Array, curves: int) -> None:
        self.time = time
        self.series = Series(sample_rows(time.size, POINTS))
        self.axis: Axis = time_axis(time)
        self.limit = max(50, min(POINTS, ALL_POINTS // max(1, curves)))

    def with_values(self, panels: Sequence[Panel]) -> list[Plot]:
        """Plots whose values can be read at the cursor."""
        return [make_plot(panel, self.time, self.axis, self.series.add(panel), POINTS) for panel in panels]

    def without_values(self, panels: Sequence[Panel]) -> list[Plot]:
        """Plots to look at only: coarser, and unknown to the script."""
        return [make_plot(panel, self.time, self.axis, (), self.limit // 2) for panel in panels]
