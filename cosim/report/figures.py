"""PNG figures of a run, for reports and slides; the same panels as on the page."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.report.panels import Panel, error_panels, other_panels, state_panels, tilt_panels
from cosim.report.roles import Craft, Run, find_crafts
from cosim.report.topview import Track, estimated_track, reference_track, true_track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, told apart by all common kinds of sight; dashes carry the same message without colour.
# What lies under the thin dark truth is wide and pale, so that neither hides the other.
LINES: dict[str, tuple[str, str, float]] = {
    "true": ("#1a1a1a", "-", 1.6),
    "estimate": ("#7fb8d8", "-", 3.2),
    "reference": ("#767676", "--", 1.2),
    "error": ("#0072b2", "-", 1.1),
    "right": ("#eaae7f", "-", 2.6),
    "left": ("#7fb8d8", "-", 2.6),
    "actual": ("#1a1a1a", "-", 1.1),
    "s0": ("#0072b2", "-", 1.1),
    "s1": ("#d55e00", "--", 1.1),
    "s2": ("#009e73", "-.", 1.1),
    "s3": ("#cc79a7", "-", 1.1),
    "s4": ("#8a6d00", "--", 1.1),
    "s5": ("#1a1a1a", ":", 1.1),
}
PANELS_A_FIGURE = 8


def draw(folder: Path, run: Run) -> list[Path]:
    """All figures of a run, none of a run without rows; several crafts get files of their own."""
    if run.time.size == 0:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    crafts = find_crafts(run)
    paths = []
    for craft in crafts:
        stem = f"{_safe(craft.name)}-" if len(crafts) > 1 else ""
        sheets = {"states": state_panels(craft), "estimation-error": error_panels(craft), "tilt": tilt_panels(craft)}
        paths += [_panels(folder / f"{stem}{name}.png", run, panels) for name, panels in sheets.items() if panels]
        paths.append(_path(folder / f"{stem}path.png", craft))
    return paths if crafts else _signals(folder, run)


def _signals(folder: Path, run: Run) -> list[Path]:
    """Every signal of a run without a craft, by unit."""
    panels = other_panels(run, lambda column: False)
    sheets = [panels[first : first + PANELS_A_FIGURE] for first in range(0, len(panels), PANELS_A_FIGURE)]
    names = ["signals.png"] if len(sheets) == 1 else [f"signals-{i + 1}.png" for i in range(len(sheets))]
    return [_panels(folder / name, run, sheet) for name, sheet in zip(names, sheets, strict=True)]


def _panels(path: Path, run: Run, panels: Sequence[Panel]) -> Path:
    from matplotlib.figure import Figure

    columns = 1 if len(panels) == 1 else 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5.6 * columns, 2.6 * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, panel in zip(axes, panels, strict=False):
        _panel(ax, run, panel)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    return _save(figure, path)


def _panel(ax: Axes, run: Run, panel: Panel) -> None:
    if panel.band is not None:
        band = panel.band
        ax.fill_between(run.time, band.lower, band.upper, color="#0072b2", alpha=0.16, linewidth=0, label=band.label)
    for trace in panel.traces:
        colour, dash, width = LINES[trace.style]
        shape = "steps-post" if trace.held else "default"
        marker = "." if run.time.size == 1 else ""
        ax.plot(run.time, trace.values, color=colour, linestyle=dash, linewidth=width, drawstyle=shape, marker=marker,
                label=_literal(trace.label))  # fmt: skip
    for i, limit in enumerate(panel.limits):
        ax.axhline(
            limit, color="#767676", linestyle=(0, (4, 3)), linewidth=0.9, label=panel.limit_label if i == 0 else None
        )
    ax.set_title(_literal(panel.title), loc="left", fontsize=10)
    ax.margins(x=0, y=0.14)  # room for the legend
    ax.set_ylabel(f"[{_literal(panel.unit)}]")
    _tidy(ax, "time [s]")
    ax.legend(fontsize=7.5, frameon=False, ncols=2, loc="best")


def _path(path: Path, craft: Craft) -> Path:
    """The path from above, X forward up and Y left to the left, to scale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 5.0), layout="constrained")
    ax = figure.subplots()
    tracks: list[tuple[str, Track | None, str]] = [("reference", reference_track(craft), "reference")]
    tracks += [("estimate", estimated_track(craft), "estimate"), ("craft", true_track(craft), "true")]
    for label, track, style in tracks:
        if track is not None:
            colour, dash, width = LINES[style]
            marker = "." if track.x.size == 1 else ""
            ax.plot(track.y, track.x, color=colour, linestyle=dash, linewidth=width, label=label, marker=marker)
    ax.set_aspect("equal", adjustable="datalim")
    ax.xaxis.set_inverted(True)
    ax.set_ylabel("X, forward [m]")
    _tidy(ax, "Y, left [m]")
    ax.set_title(f"Path of {_literal(craft.name)} from above", loc="left", fontsize=10)
    ax.legend(fontsize=8, frameon=False)
    return _save(figure, path)


def _tidy(ax: Axes, label: str) -> None:
    ax.set_xlabel(label)
    ax.grid(color="#e4e4e4", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def _save(figure: Figure, path: Path) -> Path:
    """Write whole or not at all, as every file of a run."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        figure.savefig(draft, format="png", dpi=150)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return path


def _literal(text: str) -> str:
    """User's text, not mathematics: matplotlib reads `$…$` as TeX and hides labels that begin with `_`."""
    return text.replace("$", r"\$").removeprefix("_")


def _safe(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name) or "craft"
