"""Sections about the craft on a run's page: motion, errors, effort, responses to steps, picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.settings import SIDES
from cosim.core.arrays import Array
from cosim.core.text import MISSING, amount, displayed, length, percent, plain
from cosim.report.charts import Drawing, Plot, round_values, sample_rows
from cosim.report.panels import Panel, signal_panel
from cosim.report.template import Row
from cosim.simulation import criteria
from cosim.simulation.report.recorded import ComponentPage, Run, mappings, number
from fmus.report.craft import (
    SETTLING_BAND,
    SIDE_COLOURS,
    Craft,
    error_rms,
    find_crafts,
    finite,
    inside_band,
    is_drawn,
    make_view,
    responses,
    saturation,
)
from plant.hovercraft import Hovercraft

POSES = 1000  # of the moving picture
TEMPLATE = Path(__file__).with_name("templates") / "craft.html.j2"
MAX_RESPONSES = 16
HELD_LINES = ("reference", "command")  # lines that are held between rows
OUTPUT_UNITS = {q.name: q.unit for q in Hovercraft.outputs}
STATE_TITLES = {  # of the controlled and estimated states
    "x": "Distance along the craft's axis",
    "psi": "Heading, positive to the left",
    "vx": "Forward speed",
    "psi_dot": "Yaw rate, positive to the left",
}
STATE_SYMBOLS = {"x": "x", "psi": "ψ", "vx": "v", "psi_dot": "ψ̇"}


def subject(run: Run, drawing: Drawing) -> ComponentPage:
    """Return the report sections for the crafts of a run."""
    crafts, rows = find_crafts(run), sample_rows(run.time.size, POSES)
    called = [craft.name if len(crafts) > 1 else "the craft" for craft in crafts]
    pages = [craft_page(*pair, drawing) for pair in zip(crafts, called, strict=True)] if run.time.size else []
    view, bodies = make_view(crafts, rows, drawing.charts)
    return ComponentPage(
        template=TEMPLATE,
        values={"pages": pages, "view": view if bodies else None},
        tiles=tiles(run, crafts),
        shown=frozenset(shown_columns(crafts)),
        data={"few": round_values(run.time[rows], 6), "crafts": bodies, "box": view["box"]},
    )


def craft_page(craft: Craft, called: str, drawing: Drawing) -> Mapping[str, Any]:
    """Return the sections about one craft for the template."""
    panels = state_panels(craft)
    states = drawing.plots(panels)
    return {
        "name": craft.name,
        "estimator": craft.estimator or "",
        "motion": motion_sentence(craft, called),
        "states": states,
        "errors": drawing.plots(error_panels(craft)),
        "tilts": drawing.plots(tilt_panels(craft)),
        "band": band_sentence(craft),
        "tilt": tilt_sentence(craft),
        "readouts": [readout(panel, plot) for panel, plot in zip(panels, states, strict=True)],
        "responses": response_rows(craft),
        "grids": grids(craft),
    }


def readout(panel: Panel, plot: Plot) -> Mapping[str, Any]:
    """Return the last truth, estimate and reference of a state, if recorded, as key of the series and text."""
    series = {
        trace.style: (spec["y"], float(trace.values[-1]) if trace.values.size else math.nan)
        for spec, trace in zip(plot.spec["traces"], panel.traces, strict=True)
    }
    shown = [series.get(style, (None, math.nan)) for style in ("true", "estimate", "reference")]
    cells = [(key, plain(value) if math.isfinite(value) else MISSING) for key, value in shown]
    return {"symbol": panel.symbol, "title": panel.title, "unit": panel.unit, "cells": cells}


def band_sentence(craft: Craft) -> str | None:
    """Return the shares of rows within the estimator's ±2σ band."""
    parts = []
    for variable in ("x", "psi"):
        if math.isfinite(share := inside_band(craft, variable)):
            parts.append(f"{STATE_SYMBOLS[variable]} is within ±2σ of its estimate in {percent(share)} of the rows")
    return f"{', '.join(parts)}; about 95 % is expected for a consistent filter." if parts else None


def motion_sentence(craft: Craft, called: str) -> str:
    """Return the distance travelled, the displacement and the turn."""
    good, x, y, psi = finite(*map(craft.signal, ("x_world", "y_world", "psi")))
    if good.sum() < 2:
        return "Too few finite rows to describe a motion."
    way, gap = float(np.hypot(np.diff(x), np.diff(y)).sum()), math.hypot(x[-1] - x[0], y[-1] - y[0])
    turn = float(psi[-1] - psi[0])
    side = "left" if turn > 0 else "right"
    seconds = float(craft.run.time[good][-1] - craft.run.time[good][0])
    return (
        f"In {amount(seconds, 's')} {called} travelled {length(way)}, ended "
        f"{length(gap)} from where it began, and turned {amount(abs(turn), 'rad', 2)} to the {side}."
    )


def tilt_sentence(craft: Craft) -> str | None:
    """Return the saturation of the tilts."""
    limit, shares = craft.tilt_limit, [saturation(craft, side) for side in SIDES]
    if limit is None or not all(map(math.isfinite, shares)):
        return None
    at = f"±{amount(limit, 'rad')}"
    if max(shares) == 0:
        return f"No tilt command reached its limit of {at}."
    return (
        f"Tilt commands are at their limit of {at} for {percent(shares[0])} of the time on the right, "
        f"{percent(shares[1])} on the left."
    )


def tiles(run: Run, crafts: Sequence[Craft]) -> list[Row]:
    """Return the key figures of the first craft."""
    rows: list[Row] = []
    for variable in ("x", "psi") if crafts and not run.has_failed else ():
        if answers := responses(crafts[0], variable):
            unit, last = OUTPUT_UNITS[variable], answers[-1]
            time, note = _settling(last.settling, unit), f"last step, ±{SETTLING_BAND:g} {unit}"
            for criterion in mappings(run.manifest.get("criteria")):
                if (criterion.get("kind"), criterion.get("of")) == ("settling_time", f"{crafts[0].name}.{variable}"):
                    within = amount(number(criterion.get("band")), unit, None)
                    time, note = amount(number(criterion.get("value")), "s"), f"last criterion, ±{within}"
            rows.append(Row(f"Settling of {STATE_SYMBOLS[variable]}", time, note))
            if variable == "x":
                error = length(last.final).replace("less than", "<")
                rows.append(Row("Final error of x", error, "craft against reference"))
    shares = [saturation(craft, side) for craft in crafts[:1] for side in SIDES]
    if shares and all(map(math.isfinite, shares)):
        rows.append(Row("Tilt at its limit", percent(max(shares)), "of the time, busier side"))
    return rows


def _settling(value: float, unit: str) -> str:
    """Return a settling time as text."""
    if math.isnan(value):
        return MISSING
    return amount(value, "s") if math.isfinite(value) else f"not within ±{SETTLING_BAND:g}\xa0{unit}"


def response_rows(craft: Craft) -> list[dict[str, str]]:
    """Return the last responses of x and ψ as text."""
    answers = sorted((r for v in ("x", "psi") for r in responses(craft, v)), key=lambda r: (r.time, r.variable != "x"))
    rows = []
    for answer in answers[-MAX_RESPONSES:]:
        unit = OUTPUT_UNITS[answer.variable]
        ramp = f", ramp of {amount(answer.ramp, 's', 2)}" if answer.ramp else ""
        step = f"{amount(answer.start, unit)} → {amount(answer.target, unit)}{ramp}"
        row = {"symbol": STATE_SYMBOLS[answer.variable], "time": amount(answer.time, "s"), "step": step}
        row |= {name: _settling(getattr(answer, name), unit) for name in ("settling", "believed")}
        rows.append(row | {name: amount(getattr(answer, name), unit, 2) for name in ("overshoot", "rms", "final")})
    return rows


def grids(craft: Craft) -> list[Mapping[str, Any]]:
    """Return the RMS errors of control and estimation, and effort and saturation of the tilts, as far as recorded."""
    errors, efforts = [], []
    for name, symbol in STATE_SYMBOLS.items():
        true, unit = craft.signal(name), OUTPUT_UNITS[name]
        sizes = error_rms(true, craft.reference(name)), error_rms(craft.estimate(f"{name}_hat"), true)
        if any(map(math.isfinite, sizes)):
            errors.append((symbol, [amount(size, unit) for size in sizes]))
    for side in SIDES:
        good, command = finite(craft.command(f"tilt_{side}"))
        if command.size:
            effort, largest = criteria.effort(craft.run.time[good], command), float(np.abs(command).max())
            shown = [amount(effort, "rad.s"), amount(largest, "rad"), percent(saturation(craft, side))]
            efforts.append((side, shown))
    found = (
        {"title": "RMS errors", "columns": ("craft − reference", "estimate − craft"), "rows": errors},
        {"title": "Tilt commands", "columns": ("effort ∫|α| dt", "largest", "at its limit"), "rows": efforts},
    )
    return [grid for grid in found if grid["rows"]]


# -- panels -----------------------------------------------------------------------------------


def state_panels(craft: Craft) -> list[Panel]:
    """Return panels of states with references and estimates ±2σ."""
    panels = []
    for name, title in STATE_TITLES.items():
        true, estimate, unit = craft.signal(name), craft.estimate(f"{name}_hat"), OUTPUT_UNITS[name]
        if is_drawn(true):
            lines = ("reference", craft.reference(name), "reference"), ("estimate", estimate, "estimate")
            band = _band(craft, name, estimate, "estimate ±2σ")
            panels.append(_panel(title, unit, [*lines, ("craft", true, "true")], band, symbol=STATE_SYMBOLS[name]))
    return panels


def error_panels(craft: Craft) -> list[Panel]:
    """Return panels of estimation errors, with the estimator's ±2σ about zero."""
    panels = []
    for name, symbol in STATE_SYMBOLS.items():
        true, estimate = craft.signal(name), craft.estimate(f"{name}_hat")
        if is_drawn(true, estimate):
            lines = [("estimate − craft", estimate - true, "error")]
            band = _band(craft, name, np.zeros(true.size), "±2σ claimed")
            panels.append(_panel(f"Error of {symbol}", OUTPUT_UNITS[name], lines, band))
    return panels


def tilt_panels(craft: Craft) -> list[Panel]:
    """Return panels of commanded and actual tilts."""
    limit, more, panels = craft.tilt_limit, dict[str, Any](), []
    if limit is not None:
        edges = displayed(-limit, "rad"), displayed(limit, "rad")
        more = {"limits": edges, "limit_label": f"limit ±{amount(limit, 'rad', None)}"}
    for side in SIDES:
        lines = [("command", craft.command(f"tilt_{side}"), SIDE_COLOURS[side])]
        lines.append(("actual", craft.signal(f"tilt_{side}_actual"), "actual"))
        panels.append(_panel(f"Tilt, {side} propeller", "rad", lines, **more))
    return [panel for panel in panels if panel.traces]


def _panel(title: str, unit: str, lines: Sequence[tuple[str, Array, str]], band: Any = None, **more: Any) -> Panel:
    """Return a panel of the recorded ones of lines; references and commands are held between rows."""
    panel = signal_panel(title, unit, [line for line in lines if is_drawn(line[1])], band, **more)
    return replace(panel, traces=[replace(t, held=t.label in HELD_LINES) for t in panel.traces])


def _band(craft: Craft, name: str, centre: Array, label: str) -> tuple[str, Array, Array] | None:
    """Return the band of ±2σ, None without a recorded σ."""
    low, high = (centre + side * craft.estimate(f"{name}_sigma") for side in (-2, 2))
    return (label, low, high) if is_drawn(low, high) else None


def shown_columns(crafts: Sequence[Craft]) -> set[str]:
    """Return the result columns in the crafts' sections."""
    columns: set[str] = set()
    for craft in crafts:
        for name in STATE_TITLES:
            columns.add(f"{craft.name}.{name}")
            columns.update(f"{craft.estimator}.{name}_{end}" for end in ("hat", "sigma", "ref"))
            columns.add(craft.reference_column(name) or "")
        for side in SIDES:
            columns.update((f"{craft.name}.tilt_{side}", f"{craft.name}.tilt_{side}_actual"))
            columns.add(f"{craft.estimator}.tilt_{side}")
    return columns
