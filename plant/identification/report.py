"""The page of an identification: estimates with intervals, and figures of each test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import MISSING, append_unit, counted, plain, written
from cosim.base.version import __version__
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.report.template import render
from plant.identification.cells import Cell
from plant.identification.estimates import Estimate, Figure
from plant.identification.identified import Outcome
from plant.identification.protocol import CHANNELS
from plant.identification.recordings import load_in_si

TEMPLATE = Path(__file__).with_name("templates") / "identify.html.j2"
TITLES = {
    "thrust_line": "Test 1: thrust line",
    "ground_effect": "Test 2: ground effect",
    "projection": "Test 3: projections",
    "step": "Test 4: a step of the tilt",
    "frequency": "Test 4: sines of the tilt",
    "thrust_step": "A step of the duty",
    "moment": "Test 5: moment",
}


def page(outcome: Outcome) -> str:
    """Return a self-contained page."""
    protocol = outcome.protocol
    runs = sum(map(len, outcome.recordings.values()))
    testable = [e for e in outcome.estimates.values() if not np.isnan(e.truth)]
    charts = Charts()
    badges = [Badge(counted(len(outcome.results), "test")), Badge(counted(runs, "recording"))]
    return render(
        TEMPLATE,
        {
            "name": protocol.file.name,
            "headline": _headline(outcome, testable),
            "tone": "good" if testable and all(e.covers_truth for e in testable) else "plain",
            "description": "Tests of a power-train on a testing bench. Each number has an unbiased estimate with a "
            "95 % interval, from the scatter of repetitions and the calibration, beside the thesis' estimate.",
            "badges": badges,
            "rows": [_row(key, e) for key, e in outcome.estimates.items()],
            "known": bool(testable),
            "calibration": [plot_of(_calibration(outcome, c), charts) for c in CHANNELS],
            "cells": [_cell(outcome, c) for c in CHANNELS],
            "tests": [
                {
                    "name": r.test,
                    "title": TITLES[r.test],
                    "notes": [*(f"Warning: {text}." for text in r.warnings), *r.notes],
                    "plots": [(plot_of(f, charts), f.counterpart) for f in r.figures],
                }
                for r in outcome.results
            ],
            "data": charts.data(),  # after all drawings
            "repeat": f"cosim identify {protocol.yaml.path}",
            "version": __version__,
        },
    )


def _headline(outcome: Outcome, testable: Sequence[Estimate]) -> str:
    """Count correct intervals, or return the least certain estimate.

    An interval is correct if the true value is inside. Without true values, the widest relative interval is named.
    """
    every = list(outcome.estimates.values())
    if testable:
        return f"{sum(e.covers_truth for e in testable)} of {len(testable)} intervals of 95 % contain the true value."
    widths = {e.name: e.half_width / abs(e.value) for e in every if e.value and np.isfinite(e.half_width)}
    opening = f"{counted(len(every), 'number')} identified from {counted(len(outcome.results), 'test')}"
    if not widths:
        return f"{opening}."
    least = max(widths, key=lambda name: widths[name])
    return f"{opening}; least certain is {least}, known to ±{plain(100 * widths[least], 2)}\u00a0%."


def number(value: float, unit: str, like: float) -> str:
    """Format a value with as many digits as `like`, the half-width of its interval, justifies."""
    if not np.isfinite(value):
        return MISSING
    shown, scale = ("ms", 1000.0) if unit == "s" else ("mm", 1000.0) if unit == "m" else (written(unit), 1.0)
    size = abs(like) * scale
    digits = 4 if size == 0 else int(np.clip(np.floor(np.log10(max(abs(value * scale), 1e-12) / size)) + 3, 2, 6))
    return append_unit(plain(value * scale, digits), shown)


def _row(key: str, e: Estimate) -> Mapping[str, Any]:
    names = ("value", "low", "high", "thesis", "truth")
    shown = {name: number(getattr(e, name), e.unit, e.half_width) for name in names}
    return {
        **shown,
        "name": e.name,
        "test": TITLES[key.partition(".")[0]],
        "interval": f"{shown['low']} … {shown['high']}",
        "holds": e.covers_truth,
        "places": _places(e),
        "scatter": number(e.scatter, e.unit, e.scatter),
        "calibration": number(e.calibration, e.unit, e.calibration),
        "origin": f"{e.origin}; {counted(e.repetitions, 'repetition')}",
    }


def _places(e: Estimate) -> Mapping[str, float]:
    """Return the positions [%] of value, interval, thesis and truth on a common scale; empty with too few values."""
    values = {"low": e.low, "high": e.high, "value": e.value, "thesis": e.thesis, "truth": e.truth}
    finite = [v for v in values.values() if np.isfinite(v)]
    if len(finite) < 3 or max(finite) == min(finite):
        return {}
    low, span = min(finite), max(finite) - min(finite)
    return {name: round(4.0 + 92.0 * (v - low) / span, 1) for name, v in values.items() if np.isfinite(v)}


def _calibration(outcome: Outcome, channel: str) -> Figure:
    cell, unit = outcome.cells[channel], load_in_si(outcome.protocol, channel)
    grid = np.linspace(cell.volts[0], cell.volts[-1], 200)
    where = {"z": "Vertical cell", "x": "Horizontal cell", "m": "Cell of the torquemeter"}[channel]
    names = outcome.protocol.file.cells[channel].unit
    lines = [("curve", grid, cell.force(grid) / unit, "true"), ("points", cell.volts, cell.loads / unit, "dots")]
    return Figure(f"{where}: load over voltage", "voltage [V]", written(names), lines, counterpart="Fig 3.18")


def _cell(outcome: Outcome, channel: str) -> Mapping[str, str]:
    cell: Cell = outcome.cells[channel]
    unit, name = load_in_si(outcome.protocol, channel), outcome.protocol.file.cells[channel].unit
    rail = ", ".join(f"{f / unit:g}" for f in cell.saturated_loads)
    return {
        "name": f"volts_{channel}",
        "points": counted(cell.loads.size, "point"),
        "error": append_unit(plain(cell.error / unit, 3), written(name)),
        "left": append_unit(plain(float(np.sqrt(np.mean(cell.cross_validation_errors**2))) / unit, 3), written(name)),
        "rail": append_unit(rail, written(name)) if rail else MISSING,
    }


def plot_of(figure: Figure, charts: Charts) -> Plot:
    """Draw a figure whose lines have separate x values."""
    traces = [_trace(label, over, values, style) for label, over, values, style in figure.lines]
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


def _trace(label: str, over: Array, values: Array, style: str) -> Trace:
    """Return a trace of lines; points instead if x decreases somewhere, as for several tests in sequence."""
    good = np.isfinite(over)
    x, order = over[good], np.argsort(over[good], kind="stable")
    several = "dots" not in style and bool(np.any(np.diff(x) < 0.0))
    return Trace(label, values[good][order], f"{style} dots" if several else style, x=x[order])
