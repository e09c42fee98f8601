"""The page of an identification: numbers with both estimators, and the counterparts of the thesis' figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import MISSING, counted, joined, plain, written
from cosim.base.version import __version__
from cosim.report.drawing import Charts
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace
from cosim.report.svg import Plot, extent, log_axis, make_axis
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
    """One self-contained page."""
    protocol = outcome.protocol
    runs = sum(map(len, outcome.recordings.values()))
    known = [e for e in outcome.estimates.values() if not np.isnan(e.truth)]
    charts = Charts()
    badges = [Badge(counted(len(outcome.results), "test")), Badge(counted(runs, "recording"))]
    if known:
        held, tone = sum(e.holds for e in known), "good" if all(e.holds for e in known) else "plain"
        badges.append(Badge(f"{held} of {len(known)} intervals hold the true value", tone))
    return render(
        TEMPLATE,
        {
            "name": protocol.file.name,
            "description": "The five tests of a power-train on a testing bench. Beside each number of the thesis' "
            "estimator stands one without its bias; intervals come from scatter between repetitions and calibration.",
            "badges": badges,
            "rows": [_row(key, e) for key, e in outcome.estimates.items()],
            "known": bool(known),
            "calibration": [plot_of(_calibration(outcome, c), charts) for c in CHANNELS],
            "cells": [_cell(outcome, c) for c in CHANNELS],
            "tests": [
                {
                    "name": r.test,
                    "title": TITLES[r.test],
                    "notes": [*(f"Warning: {text}." for text in r.warnings), *r.notes],
                    "plots": [(plot_of(f, charts), f.x_label, f.counterpart) for f in r.figures],
                }
                for r in outcome.results
            ],
            "data": charts.data(),  # after all that is drawn
            "repeat": f"cosim identify {protocol.yaml.path}",
            "version": __version__,
        },
    )


def number(value: float, unit: str, like: float) -> str:
    """To as many digits as an interval of this half-width has a use for."""
    if not np.isfinite(value):
        return MISSING
    shown, scale = ("ms", 1000.0) if unit == "s" else ("mm", 1000.0) if unit == "m" else (written(unit), 1.0)
    size = abs(like) * scale
    digits = 4 if size == 0 else int(np.clip(np.floor(np.log10(max(abs(value * scale), 1e-12) / size)) + 3, 2, 6))
    return joined(plain(value * scale, digits), shown)


def _row(key: str, e: Estimate) -> Mapping[str, Any]:
    names = ("value", "low", "high", "thesis", "truth")
    shown = {name: number(getattr(e, name), e.unit, e.half_width) for name in names}
    return {
        **shown,
        "name": e.name,
        "test": TITLES[key.partition(".")[0]],
        "interval": f"{shown['low']} … {shown['high']}",
        "holds": e.holds,
        "scatter": number(e.scatter, e.unit, e.scatter),
        "calibration": number(e.calibration, e.unit, e.calibration),
        "origin": f"{e.origin}; {counted(e.repetitions, 'repetition')}",
    }


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
    rail = ", ".join(f"{f / unit:g}" for f in cell.left_out)
    return {
        "name": f"volts_{channel}",
        "points": counted(cell.loads.size, "point"),
        "error": joined(plain(cell.error / unit, 3), written(name)),
        "left": joined(plain(float(np.sqrt(np.mean(cell.left_one_out**2))) / unit, 3), written(name)),
        "rail": joined(rail, written(name)) if rail else MISSING,
    }


def plot_of(figure: Figure, charts: Charts) -> Plot:
    """A figure whose lines have an x of their own each."""
    traces = [_trace(label, over, values, style) for label, over, values, style in figure.lines]
    traces += [Trace("95 %", low, "bar", x=over, upper=high) for over, low, high in figure.bars]
    band = Band(figure.band[0], figure.band[2], figure.band[3], figure.band[1]) if figure.band else None
    name, _, unit = figure.x_label.partition(" [")
    low, high = extent([t.x for t in traces if t.x is not None]) or (0.0, 1.0)
    if figure.log:
        low, high = float(np.log10(low)), float(np.log10(high))
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 1.0
    axis = log_axis(low - margin, high + margin) if figure.log else make_axis(low - margin, high + margin, 6)
    panel = Panel(figure.title, figure.y_label, traces, band)
    return charts.alone(panel, axis, (name, unit.rstrip("]")), log=figure.log)


def _trace(label: str, over: Array, values: Array, style: str) -> Trace:
    """A line; points where it goes back and forth, as several tests over one another do."""
    good = np.isfinite(over)
    x, order = over[good], np.argsort(over[good], kind="stable")
    several = "dots" not in style and bool(np.any(np.diff(x) < 0.0))
    return Trace(label, values[good][order], f"{style} dots" if several else style, x=x[order])
