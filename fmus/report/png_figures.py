"""PNG figures of a craft: states, errors of the estimate, tilts, path from above."""

from __future__ import annotations

import re
from pathlib import Path

from cosim.report.figure import new_figure
from cosim.simulation.report.figures import LINES, literal, panels_figure, save, tidy
from cosim.simulation.report.recorded import Run
from fmus.report.craft import Craft, find_crafts
from fmus.report.craft_page import error_panels, state_panels, tilt_panels
from fmus.report.topview import Track, estimated_track, reference_track, true_track


def figures(run: Run, folder: Path) -> list[Path]:
    """Draw all figures of a run's crafts."""
    crafts = find_crafts(run)
    paths = []
    for craft in crafts:
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", craft.name) or "craft"
        stem = f"{name}-" if len(crafts) > 1 else ""
        sheets = {"states": state_panels(craft), "estimation-error": error_panels(craft), "tilt": tilt_panels(craft)}
        paths += [panels_figure(folder / f"{stem}{name}.png", run, panels) for name, panels in sheets.items() if panels]
        paths.append(_path(folder / f"{stem}path.png", craft))
    return paths


def _path(path: Path, craft: Craft) -> Path:
    """Draw the path from above, to scale."""
    figure = new_figure(7.2, 5.0)
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
    tidy(ax, "Y, left [m]")
    ax.set_title(f"Path of {literal(craft.name)} from above", loc="left", fontsize=10)
    ax.legend(fontsize=8, frameon=False)
    return save(figure, path)
