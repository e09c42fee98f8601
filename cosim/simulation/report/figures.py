"""PNG figures of a run, for reports and slides, with the same panels as the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core import registry
from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.text import showing
from cosim.files.results import Results
from cosim.report.figure import new_figure
from cosim.report.panels import Panel
from cosim.simulation.report.recorded import Run
from cosim.simulation.report.run_page import drawable_run, signal_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito's colours are distinct for all common kinds of colour vision; dashes work without colour. Curves below
# the thin dark truth are wide and pale, so that both stay visible.
LINES: dict[str, tuple[str, str, float]] = {
    "true": ("#1a1a1a", "-", 1.6),
    "estimate": ("#7fb8d8", "-", 3.2),
    "reference": ("#767676", "--", 1.2),
    "error": ("#0072b2", "-", 1.1),
    "warm": ("#eaae7f", "-", 2.6),
    "cool": ("#7fb8d8", "-", 2.6),
    "actual": ("#1a1a1a", "-", 1.1),
    "s0": ("#0072b2", "-", 1.1),
    "s1": ("#d55e00", "--", 1.1),
    "s2": ("#009e73", "-.", 1.1),
    "s3": ("#cc79a7", "-", 1.1),
    "s4": ("#8a6d00", "--", 1.1),
    "s5": ("#1a1a1a", ":", 1.1),
    "baseline": ("#1a1a1a", "-", 2.0),
}
for _number in range(15):  # the runs of a comparison
    LINES[f"run{_number}"] = LINES[f"s{_number % 5}"][0], ("-", "--", ":")[_number // 5], 1.1
PANELS_A_FIGURE = 8
LONGEST_LABEL = 48  # characters, so that titles and legends leave room for the curves
ANGLE_STEPS = [1, 1.5, 3, 4.5, 9, 10]  # of ticks


def write_figures(folder: Path, results: Results, manifest: Mapping[str, Any]) -> list[Path]:
    """Write PNG figures of a run and return their paths; a run without rows has none."""
    with showing(manifest):
        run = drawable_run(results, manifest)
        if run.time.size == 0:
            return []
        folder.mkdir(parents=True, exist_ok=True)
        page = registry.page_for(run.variables.values())
        drawn: list[Path] = registry.resolve(page.figures)(run, folder) if page and page.figures else []
        if drawn:
            return drawn
        panels = signal_panels(run)
        sheets = [panels[first : first + PANELS_A_FIGURE] for first in range(0, len(panels), PANELS_A_FIGURE)]
        names = ["signals.png"] if len(sheets) == 1 else [f"signals-{i + 1}.png" for i in range(len(sheets))]
        return [panels_figure(folder / name, run, sheet) for name, sheet in zip(names, sheets, strict=True)]


def panels_figure(path: Path, run: Run, panels: Sequence[Panel]) -> Path:
    """Draw panels over time into a file."""
    return save(sheet(run.time, panels), path)


def sheet(time: Array, panels: Sequence[Panel]) -> Figure:
    """Return a figure of panels over time [s], in two columns."""
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
    for k, (begin, end) in enumerate(panel.outside):
        label = "outside the logs of the model" if not k else None
        ax.axvspan(begin, end, color="#eaae7f", alpha=0.3, linewidth=0, label=label)
    for trace in panel.traces:
        colour, dash, width = LINES[trace.style]
        shape = "steps-post" if trace.held else "default"
        (line,) = ax.plot(time, trace.values, color=colour, linestyle=dash, linewidth=width)
        line.set(drawstyle=shape, marker="." if time.size == 1 else "", label=literal(trace.label))
    for i, limit in enumerate(panel.limits):
        ax.axhline(
            limit, color="#767676", linestyle=(0, (4, 3)), linewidth=0.9, label=panel.limit_label if i == 0 else None
        )
    ax.set_title(literal(panel.title), loc="left", fontsize=10)
    ax.margins(x=0.0, y=0.06)
    if panel.unit == "°":
        ax.locator_params(axis="y", steps=ANGLE_STEPS)
    ax.set_ylabel(f"[{literal(panel.unit)}]")
    tidy(ax, "time [s]")
    are_short = all(len(trace.label) <= LONGEST_LABEL // 2 for trace in panel.traces)
    ax.legend(fontsize=7.5, frameon=False, ncols=2 if are_short else 1, loc="best")


def tidy(ax: Axes, label: str) -> None:
    """Set grid and label, and remove the box."""
    ax.set_xlabel(label)
    ax.grid(color="#e4e4e4", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure completely or not at all."""
    with draft_of(path) as draft:
        figure.savefig(draft, format="png", dpi=150)
    return path


def literal(text: str) -> str:
    """Return text safe from matplotlib's TeX and hidden labels; a long one with its first and its last letters."""
    if len(text) > LONGEST_LABEL:
        text = f"{text[: LONGEST_LABEL // 2]}…{text[1 - LONGEST_LABEL // 2 :]}"
    return text.replace("$", r"\$").removeprefix("_")
