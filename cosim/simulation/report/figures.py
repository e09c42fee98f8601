"""Matplotlib figures of panels, with the same panels as the page of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cosim.core.arrays import Array
from cosim.report.cell.cell import new_figure
from cosim.report.panels import Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito's colours are distinct for all common kinds of colour vision; dashes work without colour.
DASHES = {"again": "--", "third": ":"}  # of further runs with the colours of a comparison
LINE_STYLES: dict[str, tuple[str, str, float]] = {
    "s0": ("#0072b2", "-", 1.1),
    "s1": ("#d55e00", "--", 1.1),
    "s2": ("#009e73", "-.", 1.1),
    "s3": ("#cc79a7", "-", 1.1),
    "s4": ("#8a6d00", "--", 1.1),
    "s5": ("#1a1a1a", ":", 1.1),
    "baseline": ("#1a1a1a", "-", 2.0),
}
LONGEST_LABEL = 48  # characters of a label, so that titles and legends leave room for curves


def sheet(time: Array, panels: Sequence[Panel]) -> Figure:
    """Return a matplotlib figure of panels over time [s], in two columns."""
    columns = 1 if len(panels) == 1 else 2
    rows = -(-len(panels) // columns)
    figure = new_figure(5.6 * columns, 2.6 * rows + 0.3)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, panel in zip(axes, panels, strict=False):
        _panel(ax, time, panel)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    return figure


def _panel(ax: Axes, time: Array, panel: Panel) -> None:
    if panel.band is not None:
        band = panel.band
        ax.fill_between(time, band.lower, band.upper, color="#0072b2", alpha=0.16, linewidth=0, label=band.label)
    for trace in panel.traces:
        name, _, kind = trace.style.partition(" ")
        colour, dash, width = LINE_STYLES[name]
        (line,) = ax.plot(time, trace.values, label=literal(trace.label), color=colour, linewidth=width)
        line.set(linestyle=DASHES.get(kind, dash), drawstyle="steps-post" if trace.held else "default")
        line.set_marker("." if time.size == 1 else "")
    ax.set_title(literal(panel.title), loc="left", fontsize=10)
    ax.margins(x=0.0, y=0.06)
    ax.set_ylabel(f"[{literal(panel.unit)}]")
    ax.set_xlabel("time [s]")
    ax.grid(color="#e4e4e4", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    are_short = all(len(trace.label) <= LONGEST_LABEL // 2 for trace in panel.traces)
    ax.legend(fontsize=7.5, frameon=False, ncols=2 if are_short else 1, loc="best")


def literal(text: str) -> str:
    """Return text that matplotlib shows literally (no TeX, no hidden label), shortened in the middle if it is long."""
    if len(text) > LONGEST_LABEL:
        text = f"{text[: LONGEST_LABEL // 2]}…{text[1 - LONGEST_LABEL // 2 :]}"
    return text.replace("$", r"\$").removeprefix("_")
