"""What stands on the page, in order: header, motion, states, estimation, actuators, figures, provenance."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.report import sentences, tables
from cosim.report.data import Series, sample_rows, to_json
from cosim.report.panels import Panel, error_panels, other_panels, shown_columns, state_panels, tilt_panels
from cosim.report.roles import Craft, Run, Signal, find_crafts, texts
from cosim.report.svg import Axis, Plot, make_plot, time_axis
from cosim.report.text import MISSING, plain
from cosim.report.topview import View, last_row, make_view, true_track

POINTS = 1000  # a curve, and rows for the script
ALL_POINTS = 60_000  # of all curves together: keeps a page of a hundred signals small


@dataclass(frozen=True)
class Readout:
    """One state beside the picture: keys of its series and its values at the end of the run."""

    symbol: str
    title: str
    unit: str
    cells: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class CraftPage:
    """The sections about one craft."""

    name: str
    estimator: str
    motion: str
    states: list[Plot]
    errors: list[Plot]
    tilts: list[Plot]
    belief: str | None
    band: str | None
    tilt: str | None
    readouts: list[Readout]
    responses: list[tables.ResponseRow]
    grids: list[tables.Grid]


class Drawing:
    """Draws panels with one time axis and one budget of points."""

    def __init__(self, run: Run) -> None:
        count = run.time.size
        self.time: Signal = run.time
        self.series = Series(sample_rows(count, POINTS))
        self.axis: Axis = time_axis(run.time)
        self.limit = max(50, min(POINTS, ALL_POINTS // max(1, len(run.results.columns))))

    def with_values(self, panels: Sequence[Panel]) -> list[Plot]:
        """Plots whose values can be read at the cursor."""
        return [make_plot(panel, self.time, self.axis, self.series.add(panel), POINTS) for panel in panels]

    def without_values(self, panels: Sequence[Panel]) -> list[Plot]:
        """Plots to look at only: coarser, and unknown to the script."""
        return [make_plot(panel, self.time, self.axis, (), self.limit // 2) for panel in panels]


def context(run: Run) -> Mapping[str, Any]:
    """Everything the template names."""
    crafts, judged = find_crafts(run), sentences.criteria(run)
    drawing = Drawing(run)
    pages = (
        [craft_page(craft, drawing, craft.name if len(crafts) > 1 else "the craft") for craft in crafts]
        if run.time.size
        else []
    )
    shown = shown_columns(crafts)
    others = drawing.without_values(other_panels(run, shown.__contains__)) if run.time.size else []
    view: View | None = make_view(crafts, drawing.series.rows) if run.time.size else None
    drawn = [craft for craft in crafts if view and last_row(true_track(craft)) is not None]
    return {
        "name": str(run.scenario.get("name") or "Run"),
        "description": str(run.scenario.get("description") or ""),
        "outcome": sentences.outcome(run, judged),
        "tone": "bad" if sentences.failed(run) or not all(c.met for c in judged) else "good" if judged else "plain",
        "badges": tables.badges(run, judged),
        "tiles": tables.tiles(run, crafts),
        "pages": pages,
        "view": view,
        "others": others,
        "criteria": judged,
        "rows": run.time.size,
        "end": run.time[-1] if run.time.size else 0.0,
        "data": to_json(run.time, drawing.series, drawn),
        "provenance": tables.provenance(run),
        "connections": tables.connections(run),
        "starts": tables.starts(run),
        "warnings": texts(run.manifest.get("warnings")),
        "repeat": shlex.join(["cosim", "run", "manifest.json"]),
        "version": str(run.manifest.get("cosim_version") or ""),
    }


def craft_page(craft: Craft, drawing: Drawing, called: str) -> CraftPage:
    """The sections about `craft`, drawn."""
    panels = state_panels(craft)
    states = drawing.with_values(panels)
    return CraftPage(
        name=craft.name,
        estimator=craft.estimator or "",
        motion=sentences.motion_sentence(craft, called),
        states=states,
        errors=drawing.with_values(error_panels(craft)),
        tilts=drawing.with_values(tilt_panels(craft)),
        belief=sentences.belief_sentence(craft),
        band=sentences.band_sentence(craft),
        tilt=sentences.tilt_sentence(craft),
        readouts=[readout(panel, plot) for panel, plot in zip(panels, states, strict=True)],
        responses=tables.response_rows(craft),
        grids=[grid for grid in (tables.error_grid(craft), tables.tilt_grid(craft)) if grid],
    )


def readout(panel: Panel, plot: Plot) -> Readout:
    """Truth, estimate and reference of a state, as far as they exist."""
    cells = []
    for style in ("true", "estimate", "reference"):
        found = [
            (curve.key, trace) for curve, trace in zip(plot.curves, panel.traces, strict=True) if curve.style == style
        ]
        finite = [float(v) for _, trace in found for v in trace.values[-1:] if np.isfinite(v)]
        cells.append(
            (found[0][0] if found else "", plain(finite[0]) if finite and not math.isnan(finite[0]) else MISSING)
        )
    return Readout(panel.symbol, panel.title, panel.unit, tuple(cells))
