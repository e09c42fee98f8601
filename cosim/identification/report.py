"""The page of an identification: numbers with both estimators, and the counterparts of the thesis' figures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arrays import Array
from cosim.identification.cells import Cell
from cosim.identification.estimates import Estimate, Figure
from cosim.identification.outcome import Outcome
from cosim.identification.protocol import CHANNELS
from cosim.identification.recordings import load_in_si
from cosim.report.panels import Trace
from cosim.report.svg import HEIGHT, WIDTH, Axis, Curve, Plot, band_path, curve_path, extent, make_axis
from cosim.report.tables import Badge
from cosim.report.template import render
from cosim.text import MISSING, counted, joined, plain, written
from cosim.version import __version__

TEMPLATE = Path(__file__).with_name("templates") / "identify.html.j2"
POINTS = 1500  # a curve
TITLES = {
    "thrust_line": "Test 1: thrust line", "ground_effect": "Test 2: ground effect", "projection": "Test 3: projections",
    "step": "Test 4: a step of the tilt", "frequency": "Test 4: sines of the tilt",
    "thrust_step": "A step of the duty", "moment": "Test 5: moment",
}  # fmt: skip


def page(outcome: Outcome) -> str:
    """One self-contained page."""
    protocol = outcome.protocol
    runs = sum(map(len, outcome.recordings.values()))
    known = [e for e in outcome.estimates.values() if not np.isnan(e.truth)]
    badges = [Badge(counted(len(outcome.results), "test")), Badge(counted(runs, "recording"))]
    if known:
        held = sum(e.holds for e in known)
        badges.append(
            Badge(f"{held} of {len(known)} intervals hold the true value", "good" if held == len(known) else "plain")
        )
    return render(
        TEMPLATE,
        {
            "name": protocol.file.name,
            "description": "The five tests of a power-train on a testing bench. Beside each number of the thesis' "
            "estimator stands one without its bias; intervals come from scatter between repetitions and calibration.",
            "badges": badges,
            "rows": [_row(key, e) for key, e in outcome.estimates.items()],
            "known": bool(known),
            "calibration": [plot_of(_calibration(outcome, c)) for c in CHANNELS],
            "cells": [_cell(outcome, c) for c in CHANNELS],
            "tests": [
                {"name": r.test, "title": TITLES[r.test], "notes": r.notes,
                 "plots": [(plot_of(f), f.x_label, f.counterpart) for f in r.figures]}
                for r in outcome.results
            ],
            "repeat": f"cosim identify {protocol.yaml.path}",
            "version": __version__,
        },
    )  # fmt: skip


def number(value: float, unit: str, like: float) -> str:
    """To as many digits as an interval of this half-width has a use for."""
    if not np.isfinite(value):
        return MISSING
    shown, scale = ("ms", 1000.0) if unit == "s" else ("mm", 1000.0) if unit == "m" else (written(unit), 1.0)
    size = abs(like) * scale
    digits = 4 if size == 0 else int(np.clip(np.floor(np.log10(max(abs(value * scale), 1e-12) / size)) + 3, 2, 6))
    return joined(plain(value * scale, digits), shown)


def _row(key: str, e: Estimate) -> Mapping[str, Any]:
    half = 0.5 * (e.high - e.low)
    return {
        "name": e.name, "test": TITLES[key.partition(".")[0]], "value": number(e.value, e.unit, half),
        "interval": f"{number(e.low, e.unit, half)} … {number(e.high, e.unit, half)}",
        "thesis": number(e.thesis, e.unit, half), "truth": number(e.truth, e.unit, half), "holds": e.holds,
        "scatter": number(e.scatter, e.unit, e.scatter), "calibration": number(e.calibration, e.unit, e.calibration),
        "origin": f"{e.origin}; {counted(e.repetitions, 'repetition')}",
    }  # fmt: skip


def _calibration(outcome: Outcome, channel: str) -> Figure:
    cell, unit = outcome.cells[channel], load_in_si(outcome.protocol, channel)
    grid = np.linspace(cell.volts[0], cell.volts[-1], 200)
    where = {"z": "Vertical cell", "x": "Horizontal cell", "m": "Cell of the torquemeter"}[channel]
    names = outcome.protocol.file.cells[channel].unit
    return Figure(f"{where}: load over voltage", "V", written(names), [
        ("curve", grid, cell.force(grid) / unit, "true"), ("points", cell.volts, cell.loads / unit, "dots"),
    ], counterpart="Fig 3.18")  # fmt: skip


def _cell(outcome: Outcome, channel: str) -> Mapping[str, str]:
    cell: Cell = outcome.cells[channel]
    unit, name = load_in_si(outcome.protocol, channel), outcome.protocol.file.cells[channel].unit
    rail = ", ".join(f"{f / unit:g}" for f in cell.left_out)
    return {
        "name": f"volts_{channel}", "points": counted(cell.loads.size, "point"),
        "error": joined(plain(cell.error / unit, 3), written(name)),
        "left": joined(plain(float(np.sqrt(np.mean(cell.left_one_out**2))) / unit, 3), written(name)),
        "rail": joined(rail, written(name)) if rail else MISSING,
    }  # fmt: skip


def plot_of(figure: Figure) -> Plot:
    """A figure whose lines have an x of their own each."""
    xs = [x for _, x, _, _ in figure.lines] + [b[0] for b in figure.bars]
    ys = [y for _, _, y, _ in figure.lines] + [v for b in figure.bars for v in b[1:]]
    if figure.band:
        ys += [figure.band[2], figure.band[3]]
    x, y = _axis(xs, 6), _axis(ys, 5)
    curves = [Curve(label, style, _path(x, y, over, values, style), "") for label, over, values, style in figure.lines]
    curves += [Curve("95 %", "bar", _bars(x, y, *bar), "") for bar in figure.bars]
    band = ""
    if figure.band:
        band = band_path(x, y, figure.band[1], figure.band[2], figure.band[3], POINTS)
    zero = HEIGHT - int(y.whole(np.zeros(1), HEIGHT)[0]) if y.low < 0 < y.high else None
    summary = (
        f"{figure.title} in {figure.y_label} over {figure.x_label}: {', '.join(line[0] for line in figure.lines)}."
    )
    label = figure.band[0] if figure.band else ""
    return Plot(figure.title, figure.y_label, tuple(curves), band, label, (), "", x, y, zero, summary)


def _axis(values: list[Array], count: int) -> Axis:
    low, high = extent(values) or (0.0, 1.0)
    margin = 0.04 * (high - low) or 0.1 * abs(high) or 1.0
    return make_axis(low - margin, high + margin, count)


def _path(x: Axis, y: Axis, over: Array, values: Array, style: str) -> str:
    if not style.startswith("dots"):
        return curve_path(x, y, np.where(np.isfinite(over), over, x.low), Trace("", values, style), 4 * POINTS)
    good = np.isfinite(over) & np.isfinite(values)
    u, v = x.whole(over[good], WIDTH), HEIGHT - y.whole(values[good], HEIGHT)
    return "".join(f"M{a} {b}h0" for a, b in dict.fromkeys(zip(u.tolist(), v.tolist(), strict=True)))


def _bars(x: Axis, y: Axis, over: Array, low: Array, high: Array) -> str:
    u = x.whole(over, WIDTH).tolist()
    a, b = (HEIGHT - y.whole(v, HEIGHT) for v in (low, high))
    return "".join(f"M{c - 25} {d}h50m-25 0V{e}m-25 0h50" for c, d, e in zip(u, a.tolist(), b.tolist(), strict=True))
