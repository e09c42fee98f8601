"""The page of an identification: estimates with intervals, and figures of each test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.text import MISSING, append_unit, counted, plain, written
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.report.template import places, render
from plant.identification.estimates import Estimate, Figure, Result
from plant.identification.recordings import Cell

TEMPLATE = Path(__file__).with_name("templates") / "identify.html.j2"
TEST_TITLES = {
    "thrust_line": "Test 1: thrust line",
    "ground_effect": "Test 2: ground effect",
    "projection": "Test 3: projections",
    "step": "Test 4: a step of the tilt",
    "frequency": "Test 4: sines of the tilt",
    "thrust_step": "A step of the duty",
    "moment": "Test 5: moment",
    "rest": "Noise at rest, eqs 5.44\u20135.46",
    "distance": "Distance covered, §5.5",
}
CELLS = {"z": "Vertical cell", "x": "Horizontal cell", "m": "Cell of the torquemeter"}


def page(
    name: str,
    path: Path,
    results: Sequence[Result],
    recordings: str,
    calibrated: Sequence[tuple[str, Cell, float, str]] = (),
) -> str:
    """Return the self-contained page of an identification.

    Args:
        path: Path of the protocol.
        recordings: Description of the data, such as `3 logs`.
        calibrated: Channel, cell, load unit in N or N m, and name of the unit.
    """
    charts, every = Charts(), [e for r in results for e in r.estimates]
    testable = [e for e in every if not np.isnan(e.truth)]
    held = sum(e.covers_truth for e in testable)
    headline = f"{counted(len(every), 'number')} identified from {counted(len(results), 'test')}"
    if testable:
        headline = f"{held} of {len(testable)} intervals of 95 % contain the true value."
    elif widths := {e.name: e.half_width / abs(e.value) for e in every if e.value and np.isfinite(e.half_width)}:
        least = max(widths, key=lambda name: widths[name])
        headline += f"; the least accurate is {least}, ±{plain(100 * widths[least], 2)}\u00a0%."
    cells, plots = [], []
    for c, cell, unit, unit_name in calibrated:
        shown, grid = written(unit_name), np.linspace(cell.volts[0], cell.volts[-1], 200)
        lines = [("curve", grid, cell.force(grid) / unit, "true"), ("points", cell.volts, cell.loads / unit, "dots")]
        plots.append(
            (plot_of(Figure(f"{CELLS[c]}: load over voltage", "voltage [V]", shown, lines), charts), ("3.18",))
        )
        left_out = float(np.sqrt(np.mean(cell.cross_validation_errors**2)))
        errors = (append_unit(plain(error / unit, 3), shown) for error in (cell.error, left_out))
        rail = ", ".join(f"{f / unit:g}" for f in cell.saturated_loads)
        cells.append((f"volts_{c}", counted(cell.loads.size, "point"), *errors, append_unit(rail or MISSING, shown)))
    tests = [
        {
            "name": r.test,
            "title": TEST_TITLES[r.test],
            "notes": [*(f"Warning: {text}." for text in r.warnings), *r.notes],
            "plots": [(plot_of(f, charts), f.counterparts) for f in r.figures],
        }
        for r in results
    ]
    values = {
        "name": name,
        "headline": headline,
        "tone": "good" if testable and held == len(testable) else "plain",
        "badges": [counted(len(results), "test"), recordings],
        "rows": [_shown(e) for e in every],
        "known": bool(testable),
        "cells": cells,
        "cell_plots": plots,
        "tests": tests,
        "repeat": f"cosim identify {path}",
    }
    return render(TEMPLATE, values, charts)


def _shown(e: Estimate) -> dict[str, Any]:
    """Return the numbers of an estimate as text; the half-width of the interval determines the digits."""
    unit, scale = {"s": ("ms", 1000.0), "m": ("mm", 1000.0)}.get(e.unit, (written(e.unit), 1.0))

    def number(value: float) -> str:
        if not np.isfinite(value):
            return MISSING
        ratio = max(abs(value), 1e-12) / (e.half_width or abs(value) or 1.0)
        return append_unit(plain(value * scale, int(np.clip(np.floor(np.log10(ratio)) + 3, 2, 6))), unit)

    shown = {name: number(getattr(e, name)) for name in ("value", "low", "high", "thesis", "truth")}
    marks = places(low=e.low, high=e.high, neutral=e.truth, thesis=e.thesis, dot=e.value)
    return shown | {
        "name": e.name,
        "origin": f"{e.origin}; {counted(e.repetitions, 'repetition')}",
        "interval": f"{shown['low']} … {shown['high']}",
        "holds": e.covers_truth,
        "places": marks if len(marks) >= 3 and len({*marks.values()}) > 1 else {},
    }


def plot_of(figure: Figure, charts: Charts) -> Plot:
    """Draw a figure whose lines have separate x values; a line becomes points if its x decreases somewhere."""
    traces = []
    for label, over, values, style in figure.lines:
        good = np.isfinite(over)
        x, order = over[good], np.argsort(over[good], kind="stable")
        several = "dots" not in style and bool(np.any(np.diff(x) < 0.0))  # as for several tests in sequence
        traces.append(Trace(label, values[good][order], f"{style} dots" if several else style, x=x[order]))
    traces += [Trace("95 %", low, "bar", x=over, upper=high) for over, low, high in figure.bars]
    band = Band(figure.band[0], figure.band[2], figure.band[3], figure.band[1]) if figure.band else None
    name, _, unit = figure.x_label.partition(" [")
    low, high = extent([t.x for t in traces if t.x is not None]) or (0.0, 1.0)
    if figure.log:
        low, high = float(np.log10(low)), float(np.log10(high))
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 1.0
    ends = (10.0 ** (low - margin), 10.0 ** (high + margin)) if figure.log else (low - margin, high + margin)
    panel = Panel(figure.title, figure.y_label, traces, band)
    return charts.alone(panel, ends, (name, unit.rstrip("]")), log=figure.log)
