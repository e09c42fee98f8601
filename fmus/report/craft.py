"""Crafts on a run's page: picture from above, states with references and estimates, responses to steps.

Component names are chosen by the user, so variables define the roles: a craft has `x_world`, `y_world` and `psi`, an
estimator has `x_hat` and `x_sigma`. Figures use every row and SI units.

In the picture, world X points up, Y to the left; coordinates are whole millimetres: right = −Y, down = −X. Path and
craft have one scale. On a long path, the craft is magnified by a factor stated on the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import MISSING, amount, plain
from cosim.core.units import DEGREES
from cosim.report.charts import Charts, Drawing, Plot, round_values, sample_rows
from cosim.report.panels import Panel, extent, signal_panel
from cosim.simulation import criteria
from cosim.simulation.report.recorded import ComponentPage, Run, number
from plant.hovercraft import Hovercraft

TEMPLATE = Path(__file__).with_name("templates") / "craft.html.j2"
POSES = 1000  # of the moving picture
MAX_RESPONSES = 16
SETTLING_BAND = 0.02  # m and rad: 2 % of the unit steps in the thesis
MERGED_RAMP_S = 0.1  # s; changes of a reference closer than this are one ramp
STATES = {  # controlled and estimated: symbol, title
    "x": ("x", "Distance along the craft's axis"),
    "psi": ("ψ", "Heading, positive to the left"),
    "vx": ("v", "Forward speed"),
    "psi_dot": ("ψ̇", "Yaw rate, positive to the left"),
}
UNITS = {q.name: q.unit for q in Hovercraft.outputs}


@dataclass(frozen=True)
class Craft:
    """A craft with its estimator and controller; a signal that is not recorded is NaN."""

    run: Run
    name: str
    estimator: str | None

    def recorded(self, column: str) -> Array:
        """Return a column of the results."""
        results = self.run.results
        return results[column] if column in results else np.full(self.run.time.size, math.nan)

    def signal(self, variable: str) -> Array:
        """Return a variable of the craft."""
        return self.recorded(f"{self.name}.{variable}")

    def estimate(self, variable: str) -> Array:
        """Return a variable of the estimator."""
        return self.recorded(f"{self.estimator}.{variable}")

    def reference_column(self, variable: str) -> str | None:
        """Return the column of a reference: the source of the controller's input, else the input."""
        own = f"{self.estimator}.{variable}_ref"
        return next((c for c in (self.run.source(own), own) if c is not None and c in self.run.results), None)

    def reference(self, variable: str) -> Array:
        """Return the reference of a state, recorded or constant."""
        if column := self.reference_column(variable):
            return self.run.results[column]
        return np.full(self.run.time.size, number(self.run.start(self.estimator).get(f"{variable}_ref")))


def is_drawn(*lines: Array) -> bool:
    """Return True if each line has a finite value."""
    return all(np.isfinite(line).any() for line in lines)


def find_crafts(run: Run) -> list[Craft]:
    """Return every craft with the estimator that is connected to it; a single craft and estimator belong together."""
    names = [name for name, has in run.variables.items() if {"x_world", "y_world", "psi"} <= has]
    estimators = [name for name, has in run.variables.items() if {"x_hat", "x_sigma"} <= has]
    links = [(source.partition(".")[0], target.partition(".")[0]) for source, target in run.links]
    alone = estimators if len(names) == len(estimators) == 1 else []
    fed = {name: [target for source, target in links if source == name and target in estimators] for name in names}
    return [Craft(run, name, next(iter([*fed[name], *alone]), None)) for name in names]


def subject(run: Run, drawing: Drawing) -> ComponentPage:
    """Return the report sections for the crafts of a run."""
    crafts, rows = find_crafts(run), sample_rows(run.time.size, POSES)
    pages, shown = list[Mapping[str, Any]](), set[str]()
    for craft in crafts:
        panels = state_panels(craft)
        states = drawing.plots(panels) if run.time.size else []
        readouts = [readout(*pair) for pair in zip(panels, states, strict=True)] if states else []
        page = {"name": craft.name, "estimator": craft.estimator or "", "states": states, "readouts": readouts}
        pages.append(page | {"responses": response_rows(craft)})
        for name in STATES:
            columns = (f"{craft.estimator}.{name}_{end}" for end in ("hat", "sigma", "ref"))
            shown.update((f"{craft.name}.{name}", craft.reference_column(name) or "", *columns))
    view, bodies = make_view(crafts, rows, drawing.charts)
    values = {"pages": pages if run.time.size else [], "view": view if bodies else None}
    data = {"few": round_values(run.time[rows], 6), "crafts": bodies, "box": view["box"]}
    return ComponentPage(TEMPLATE, values, shown=frozenset(shown), data=data)


def state_panels(craft: Craft) -> list[Panel]:
    """Return panels of states with references, held between rows, and estimates ±2σ."""
    panels = []
    for name, (symbol, title) in STATES.items():
        true, estimate = craft.signal(name), craft.estimate(f"{name}_hat")
        if not is_drawn(true):
            continue
        lines = ("reference", craft.reference(name)), ("estimate", estimate), ("craft", true)
        drawn = [(label, line, "true" if label == "craft" else label) for label, line in lines if is_drawn(line)]
        low, high = (estimate + side * craft.estimate(f"{name}_sigma") for side in (-2, 2))
        band = ("estimate ±2σ", low, high) if is_drawn(low, high) else None
        panel = signal_panel(title, UNITS[name], drawn, band, symbol=symbol)
        panels.append(replace(panel, traces=[replace(t, held=t.label == "reference") for t in panel.traces]))
    return panels


def readout(panel: Panel, plot: Plot) -> Mapping[str, Any]:
    """Return the last truth, estimate and reference of a state, if recorded, as key of the series and text."""
    pairs = zip(plot.spec["traces"], panel.traces, strict=True)
    series = {trace.style: (spec["y"], float(trace.values[-1])) for spec, trace in pairs}
    shown = [series.get(style, (None, math.nan)) for style in ("true", "estimate", "reference")]
    cells = [(key, plain(value) if math.isfinite(value) else MISSING) for key, value in shown]
    return {"symbol": panel.symbol, "title": panel.title, "unit": panel.unit, "cells": cells}


# -- responses --------------------------------------------------------------------------------


class Response(NamedTuple):
    """Response of a signal to one change of its reference, in SI units."""

    variable: str
    time: float
    start: float
    target: float
    ramp: float
    settling: float
    overshoot: float
    rms: float
    final: float


def reference_steps(time: Array, reference: Array) -> list[tuple[int, int, int]]:
    """Return the rows of begin, arrival and end of each change of a reference.

    Row 0 counts as a change. Changes within MERGED_RAMP_S form one ramp; a change ends at the next one.
    """
    rows = np.flatnonzero(np.abs(np.diff(reference)) > 1e-12) + 1
    apart = (np.diff(rows) > 1) & (np.diff(time[rows]) > MERGED_RAMP_S)
    ramps = [ramp.tolist() for ramp in np.split(rows, np.flatnonzero(apart) + 1) if ramp.size]
    begins = [0, *(ramp[0] for ramp in ramps)]
    return list(zip(begins, [0, *(ramp[-1] for ramp in ramps)], [*begins[1:], reference.size], strict=True))


def responses(craft: Craft, variable: str) -> list[Response]:
    """Return the responses to each change of a reference."""
    both = np.array([craft.signal(variable), craft.reference(variable)])
    good = np.isfinite(both).all(axis=0)
    if not good.any():
        return []
    time, (signal, target) = craft.run.time[good], both[:, good]
    steps = reference_steps(time, target)
    # A start on target is a response only if the reference never changes.
    if len(steps) > 1 and abs(signal[0] - target[0]) <= SETTLING_BAND:
        steps = steps[1:]
    found = []
    for begin, arrived, end in steps:
        final, whole, wanted = float(target[end - 1]), signal[begin:end], target[begin:end]
        is_moving = end - arrived < 2  # an unfinished ramp, or a change in the last row
        after = time[arrived:end], signal[arrived:end]
        times = float(time[begin]), float(time[arrived] - time[begin])
        start = float(target[begin - 1] if begin else signal[0])
        settling = math.nan if is_moving else criteria.settling_time(*after, final, SETTLING_BAND)
        errors = (
            criteria.overshoot(whole, final),
            criteria.rms_error(whole, wanted),
            criteria.final_error(whole, wanted),
        )
        found.append(Response(variable, times[0], start, final, times[1], settling, *errors))
    return found


def response_rows(craft: Craft) -> list[dict[str, str]]:
    """Return the last responses of x and ψ as text."""
    answers = sorted((r for v in ("x", "psi") for r in responses(craft, v)), key=lambda r: (r.time, r.variable != "x"))
    rows = []
    for answer in answers[-MAX_RESPONSES:]:
        unit, settling = UNITS[answer.variable], amount(answer.settling, "s")
        if not math.isfinite(answer.settling):
            settling = MISSING if math.isnan(answer.settling) else f"not within ±{SETTLING_BAND:g}\xa0{unit}"
        ramp = f", ramp of {amount(answer.ramp, 's', 2)}" if answer.ramp else ""
        step = f"{amount(answer.start, unit)} → {amount(answer.target, unit)}{ramp}"
        row = {"symbol": STATES[answer.variable][0], "time": amount(answer.time, "s"), "step": step}
        errors = {name: amount(getattr(answer, name), unit, 2) for name in ("overshoot", "rms", "final")}
        rows.append(row | {"settling": settling} | errors)
    return rows


# -- picture ----------------------------------------------------------------------------------

BASE_CRAFT = Hovercraft()
PATH_MARGIN_M = 0.42  # m around the path: half a craft and a margin
MIN_RATIO, MAX_RATIO = 1.25, 1.9  # width / height of the picture
MIN_SIZE = 0.06  # of the picture's width; a smaller craft is magnified
ARROW = 250  # mm, about the length of the longest arrow
ON_TARGET = 0.02  # m; largest initial distance of the craft from a reference path


@dataclass(frozen=True)
class Track:
    """Track of a craft: world position [m] and heading [rad] in each row."""

    x: Array
    y: Array
    psi: Array

    def drawn(self, rows: Rows) -> list[list[float | None]]:
        """Return the positions to the right and down [mm], and the clockwise rotation [°] from nose up."""
        lines = (-1000 * self.y, 0), (-1000 * self.x, 0), (-DEGREES * self.psi, 1)
        return [round_values(line[rows], digits) for line, digits in lines]


def true_track(craft: Craft) -> Track:
    """Return the true track of a craft."""
    return Track(*map(craft.signal, ("x_world", "y_world", "psi")))


def reference_track(craft: Craft) -> Track | None:
    """Return the track of the references if the craft begins on it."""
    way, heading = craft.reference("x"), craft.reference("psi")
    begins_there = np.abs(way - craft.signal("x"))[:1] <= ON_TARGET
    return _dead_reckoning(craft, way, heading) if begins_there.any() else None


def _dead_reckoning(craft: Craft, distance: Array, heading: Array) -> Track | None:
    """Return the track by the distance along the axis and the heading, from the true start; None without values."""
    if not is_drawn(distance, heading):
        return None
    begin, x = true_track(craft), craft.signal("x")
    steps = np.diff(distance, prepend=x[0] if is_drawn(x) else distance[0])
    ahead, aside = np.cumsum(steps * np.cos(heading)), np.cumsum(steps * np.sin(heading))
    return Track(begin.x[0] + ahead, begin.y[0] + aside, heading)


def make_view(crafts: Sequence[Craft], rows: Rows, charts: Charts) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the picture of crafts with a drawable pose: box [mm] and sizes for the template, and data of the script.

    Data of a craft are poses of true, estimated and reference track, tilts [°], and horizontal forces [N] with their
    scale; the charts have every row of the tilts.
    """
    bodies, tracks = list[dict[str, Any]](), list[Track]()
    for craft in crafts:
        true = true_track(craft)
        if not is_drawn(true.x + true.y + true.psi):
            continue
        low, high = extent([true.x, true.y]) or (0.0, 0.0)
        reach, near = 2 * (high - low) + 2, {"true": true}
        estimated = _dead_reckoning(craft, craft.estimate("x_hat"), craft.estimate("psi_hat"))
        for name, track in (("estimate", estimated), ("reference", reference_track(craft))):
            span = extent([track.x, track.y]) if track is not None else None
            if track and span and low - reach < span[0] and span[1] < high + reach:  # not far from the craft's own
                near[name] = track
        tracks += near.values()
        bodies.append(_body(craft, rows, charts) | {name: track.drawn(rows) for name, track in near.items()})
    x, y = (extent([getattr(track, axis) for track in tracks]) or (0.0, 0.0) for axis in "xy")
    tall, wide = x[1] - x[0] + 2 * PATH_MARGIN_M, y[1] - y[0] + 2 * PATH_MARGIN_M
    wide, tall = max(wide, MIN_RATIO * tall), max(tall, wide / MAX_RATIO)
    left, top = (math.floor(1000 * middle) for middle in (-(y[0] + y[1]) / 2 - wide / 2, -(x[0] + x[1]) / 2 - tall / 2))
    box = left, top, math.ceil(1000 * wide), math.ceil(1000 * tall)
    size = 2000 * (BASE_CRAFT.arm + BASE_CRAFT.propeller_radius)
    return {"box": box, "magnified": max(1.0, MIN_SIZE * box[2] / size), "bodies": bodies}, bodies


def _body(craft: Craft, rows: Rows, charts: Charts) -> dict[str, Any]:
    body: dict[str, Any] = {"estimate": None, "reference": None}
    body |= {"arm": round(1000 * BASE_CRAFT.arm), "radius": round(1000 * BASE_CRAFT.propeller_radius)}
    forces = []
    for side in ("right", "left"):
        tilt = craft.signal(f"tilt_{side}_actual")
        forces.append(np.sin(tilt) * craft.signal(f"thrust_{side}"))
        if is_drawn(forces[-1]):
            body[f"force_{side}"] = round_values(forces[-1][rows], 4)
            body[f"tilt_{side}"] = round_values(tilt[rows] * DEGREES, 2)
            body[f"tilt_{side}_key"] = charts.column(tilt * DEGREES)
    largest = max(map(abs, extent(forces) or (0.0,)))
    return body | {"force": 100 * largest / ARROW if largest > 1e-9 else 1.0}  # of an arrow of 10 cm, to be rounded up
