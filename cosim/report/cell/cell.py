"""Charts for a notebook's cell: interactive, of limited size for runs of any length, or drawn by matplotlib."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.scratch import process_folder
from cosim.core.text import counted
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Panel
from cosim.report.template import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = Path(__file__).with_name("templates") / "cell.html.j2"
MAX_VALUES = 100_000  # in a cell: some 300 kB of the notebook
MAX_CELL_CURVES = 24  # in a cell; callers choose them
MIN_POINTS, MAX_POINTS = 50, 2000  # of each curve that keep its peaks
ROW_HEIGHT, MAX_HEIGHT = 330, 700  # of two charts side by side, and of the frame [px]


def rows_to_show(curves: Sequence[Array]) -> Rows:
    """Return the indices of the rows to draw: all rows, or a selection with each peak and gap of each curve.

    The rows are divided into equal buckets. Selected are the least value, the largest value and the first gap of each
    curve in each bucket.
    """
    # each curve selects rows, and all curves have values in all selected rows
    limit = max(MIN_POINTS, min(MAX_POINTS, MAX_VALUES // max(1, len(curves)) ** 2))
    count = curves[0].size if curves else 0
    if count <= limit:
        return np.arange(count)
    chosen = {0, count - 1}
    for values in curves:
        good = np.isfinite(values)
        for rows in np.array_split(np.arange(count), max(1, limit // 2)):
            some = rows[good[rows]]
            if some.size:
                chosen.update((int(some[np.argmin(values[some])]), int(some[np.argmax(values[some])])))
            if some.size < rows.size:
                chosen.add(int(rows[~good[rows]][0]))
    return np.array(sorted(chosen), dtype=np.intp)


def cell_of(time: Array, panels: Sequence[Panel], title: str, *, rows: int, omitted: int = 0) -> str:
    """Return HTML with a frame of interactive charts, or "" if there are no rows or panels.

    A notebook that is not trusted does not show the frame.

    Args:
        time: Times of the rows to show.
        rows: Number of all rows.
        omitted: Number of signals that are not in the panels.
    """
    if not (time.size and panels):
        return ""
    charts = Charts()
    frame = frame_of(charts, charts.over(time).plots(panels), title)
    parts = [f"{time.size:,} of {rows:,} rows, which keep each peak"] if time.size < rows else []
    parts += [f"{counted(omitted, 'more signal')} not drawn"] if omitted else []
    note = f"<p><small>{'; '.join(parts)}.</small></p>" if parts else ""
    return frame + note


def frame_of(charts: Charts, plots: Sequence[Plot], title: str) -> str:
    """Return HTML with a frame of charts, which can neither read nor change the notebook (no allow-same-origin)."""
    page = render(PAGE, {"plots": plots, "title": title}, charts)
    height = min(MAX_HEIGHT, ROW_HEIGHT * -(-len(plots) // 2))
    style = f"width:100%;height:{height}px;border:0;resize:vertical"
    frame = f'<iframe title="{escape(title)}" sandbox="allow-scripts allow-downloads" style="{style}"'
    return f'{frame} srcdoc="{escape(page)}"></iframe>'


def new_figure(width: float = 0.0, height: float = 0.0) -> Figure:
    """Return an empty figure of this width and height [inch], by default those of matplotlib."""
    if not os.access(os.path.expanduser("~"), os.W_OK):  # without a home folder, matplotlib would make one and warn
        os.environ.setdefault("MPLCONFIGDIR", str(process_folder()))
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height) if width else None, layout="constrained")

    def png() -> bytes:
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=110)
        return picture.getvalue()

    figure._repr_png_ = png  # type: ignore[attr-defined]  # for notebooks without %matplotlib
    return figure
