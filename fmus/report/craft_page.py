"""Sections about the craft on a run's page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.core.text import MISSING, plain
from cosim.report.charts import Drawing, Plot, round_values, sample_rows
from cosim.report.panels import Panel
from cosim.simulation.report.component_page import ComponentPage
from cosim.simulation.report.recorded import Run
from fmus.report import account
from fmus.report.craft import Craft, find_crafts
from fmus.report.lines import error_panels, shown_columns, state_panels, tilt_panels
from fmus.report.topview import Body, make_view

POSES = 1000  # of the moving picture
TEMPLATE = Path(__file__).with_name("templates") / "craft.html.j2"


def subject(run: Run, drawing: Drawing) -> ComponentPage:
    """Return the report sections for the crafts of a run."""
    crafts, rows = find_crafts(run), sample_rows(run.time.size, POSES)
    called = [craft.name if len(crafts) > 1 else "the craft" for craft in crafts]
    bodies = [body for craft in crafts if (body := Body.of(craft)) is not None]
    pages = [craft_page(*pair, drawing) for pair in zip(crafts, called, strict=True)] if run.time.size else []
    return ComponentPage(
        template=TEMPLATE,
        values={"pages": pages, "view": make_view(bodies, rows) if bodies else None},
        tiles=account.tiles(run, crafts),
        shown=frozenset(shown_columns(crafts)),
        data={
            "few": round_values(run.time[rows], 6),
            "crafts": [body.moving(rows, drawing.charts) for body in bodies],
        },
    )


def craft_page(craft: Craft, called: str, drawing: Drawing) -> Mapping[str, Any]:
    """Return the sections about one craft for the template."""
    panels = state_panels(craft)
    states = drawing.plots(panels)
    return {
        "name": craft.name,
        "estimator": craft.estimator or "",
        "motion": account.motion_sentence(craft, called),
        "states": states,
        "errors": drawing.plots(error_panels(craft)),
        "tilts": drawing.plots(tilt_panels(craft)),
        "belief": account.belief_sentence(craft),
        "integral": account.integral_sentence(craft),
        "band": account.band_sentence(craft),
        "tilt": account.tilt_sentence(craft),
        "readouts": [readout(panel, plot) for panel, plot in zip(panels, states, strict=True)],
        "responses": account.response_rows(craft),
        "grids": account.grids(craft),
    }


def readout(panel: Panel, plot: Plot) -> Mapping[str, Any]:
    """Return the last truth, estimate and reference of a state, as far as recorded: key of its series and text."""
    series = {
        trace.style: (spec["y"], float(trace.values[-1]) if trace.values.size else math.nan)
        for spec, trace in zip(plot.spec["traces"], panel.traces, strict=True)
    }
    shown = [series.get(style, (None, math.nan)) for style in ("true", "estimate", "reference")]
    cells = [(key, plain(value) if math.isfinite(value) else MISSING) for key, value in shown]
    return {"symbol": panel.symbol, "title": panel.title, "unit": panel.unit, "cells": cells}
