"""Sections about the craft on a run's page: motion, errors, effort, responses to steps, picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import MISSING, amount, displayed, length, percent, plain
from cosim.report.charts import Drawing, Plot, round_values, sample_rows
from cosim.report.html_tables import Grid, Row
from cosim.report.panels import Band, Panel, Trace, axis_unit
from cosim.simulation import criteria
from cosim.simulation.report.component_page import ComponentPage
from cosim.simulation.report.recorded import Run, mappings, number
from fmus.report.craft import (
    BAND,
    COLOURS,
    MAX_SETTLED_DISTANCE,
    SIDES,
    Craft,
    error_rms,
    find_crafts,
    finite,
    inside_band,
    is_drawn,
    reference_steps,
    responses,
    saturation,
)
from fmus.report.topview import Body, make_view
from plant.hovercraft import Hovercraft

POSES = 1000  # of the moving picture
TEMPLATE = Path(__file__).with_name("templates") / "craft.html.j2"
MAX_RESPONSES = 16
SETTLING = "settling_time"  # kind of criterion
UNITS = {q.name: q.unit for q in Hovercraft.outputs}
TITLES = {  # of the controlled and estimated states
    "x": "Distance along the craft's axis",
    "psi": "Heading, positive to the left",
    "vx": "Forward speed",
    "psi_dot": "Yaw rate, positive to the left",
}
SYMBOLS = {"x": "x", "psi": "ψ", "vx": "v", "psi_dot": "ψ̇"}


def subject(run: Run, drawing: Drawing) -> ComponentPage:
    """Return the report sections for the crafts of a run."""
    crafts, rows = find_crafts(run), sample_rows(run.time.size, POSES)
    called = [craft.name if len(crafts) > 1 else "the craft" for craft in crafts]
    bodies = [body for craft in crafts if (body := Body.of(craft)) is not None]
    pages = [craft_page(*pair, drawing) for pair in zip(crafts, called, strict=True)] if run.time.size else []
    return ComponentPage(
        template=TEMPLATE,
        values={"pages": pages, "view": make_view(bodies, rows) if bodies else None},
        tiles=tiles(run, crafts),
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
        "motion": motion_sentence(craft, called),
        "states": states,
        "errors": drawing.plots(error_panels(craft)),
        "tilts": drawing.plots(tilt_panels(craft)),
        "belief": belief_sentence(craft),
        "integral": integral_sentence(craft),
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


def belief_sentence(craft: Craft) -> str | None:
    """Return a warning if the estimate has settled but the craft has not.

    Distances are medians over the last second or the last tenth of the run, whichever is longer, but after the last
    step.
    """
    good, x, x_hat, target = finite(craft.signal("x"), craft.estimate("x_hat"), craft.reference("x"))
    time = craft.run.time[good]
    if time.size < 3:
        return None
    _, arrived, _ = reference_steps(time, target)[-1]
    begin = max(float(time[arrived]), float(time[-1]) - max(1.0, 0.1 * float(time[-1] - time[0])))
    true, estimated, apart = (
        float(np.median(np.abs(one - other)[time >= begin]))
        for one, other in ((x, target), (x_hat, target), (x, x_hat))
    )
    # By the rule of the settling time, a craft with its last sample inside the band has settled.
    true = min(true, float(np.abs(x - target)[-1]))
    if not true > max(MAX_SETTLED_DISTANCE, 2 * estimated):
        return None
    sentences = [
        "The estimate has settled, but the craft has not.",
        f"At the end of the run, x̂ is {length(estimated)} from its target, the craft {length(true)}.",
    ]
    if not is_drawn(craft.estimate("x")):
        sentences.append(
            "Heading, yaw rate and acceleration carry no information about the position: x is unobservable, and its"
            " error is not corrected."
        )
    if (double := 2 * float(craft.estimate("x_sigma")[good][-1])) > 0:
        verdict = "outside" if apart > double else "within"
        sentences.append(f"This is {verdict} the ±2σ band of the estimator, ±{length(double)} at that time.")
    return " ".join(sentences)


def integral_sentence(craft: Craft) -> str | None:
    """Return the effect of integral control on the position."""
    good, x, target = finite(craft.signal("x"), craft.reference("x"))
    if not (is_drawn(craft.estimate("x_integral")) and good.any()):
        return None
    last = craft.run.time[good] >= craft.run.time[-1] - 1.0
    off = length(abs(float(np.mean((x - target)[last]))))
    error = f"Over the last second, the craft's mean error was {off}."
    if craft.run.source(f"{craft.estimator}.fix") is not None:
        return f"The controller integrates the error of the measured position, so no error remains. {error}"
    return (
        "The controller integrates the error of x, but x is not measured, so it integrates the error of its own "
        "estimate."
        " An accelerometer does not measure gravity on a tilted table, so this error remains."
        f" {error} Position fixes on x_meas and fix remove it."
    )


def band_sentence(craft: Craft) -> str | None:
    """Return the shares of rows within the estimator's ±2σ band."""
    parts = []
    for variable in ("x", "psi"):
        share = inside_band(craft, variable)
        if math.isfinite(share):
            parts.append(f"{SYMBOLS[variable]} is within ±2σ of its estimate in {percent(share)} of the rows")
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
        f"In {amount(seconds, 's')} {called} travelled {length(way)} and ended "
        f"{length(gap)} from where it began, turned {amount(abs(turn), 'rad', 2)} to the {side}."
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
    for variable in ("x", "psi"):
        answers = responses(crafts[0], variable) if crafts and not run.has_failed else []
        if not answers:
            continue
        unit, column = UNITS[variable], f"{crafts[0].name}.{variable}"
        time, band = _settling(answers[-1].settling, unit), f"last step, ±{BAND:g} {unit}"
        for criterion in mappings(run.manifest.get("criteria")):
            if (criterion.get("kind"), criterion.get("of")) == (SETTLING, column):
                value, within = criterion.get("value"), amount(number(criterion.get("band")), unit, None)
                time = amount(number(value), "s") if value is not None else f"not within ±{within}"
                band = f"last criterion, ±{within}"
        rows.append(Row(f"Settling of {SYMBOLS[variable]}", time, band))
    if rows and (answers := responses(crafts[0], "x")):
        error = length(answers[-1].final).replace("less than", "<")
        rows.append(Row("Final error of x", error, "craft against reference"))
    shares = [saturation(craft, side) for craft in crafts[:1] for side in SIDES]
    if shares and all(map(math.isfinite, shares)):
        rows.append(Row("Tilt at its limit", percent(max(shares)), "of the time, busier side"))
    return rows


def _settling(value: float, unit: str) -> str:
    """Return a settling time as text."""
    if math.isnan(value):
        return MISSING
    return amount(value, "s") if math.isfinite(value) else f"not within ±{BAND:g}\xa0{unit}"


def response_rows(craft: Craft) -> list[dict[str, str]]:
    """Return the last responses of x and ψ as text."""
    answers = sorted((r for v in ("x", "psi") for r in responses(craft, v)), key=lambda r: (r.time, r.variable != "x"))
    rows = []
    for answer in answers[-MAX_RESPONSES:]:
        unit = UNITS[answer.variable]
        ramp = f", ramp of {amount(answer.ramp, 's', 2)}" if answer.ramp else ""
        step = f"{amount(answer.start, unit)} → {amount(answer.target, unit)}{ramp}"
        row = {"symbol": SYMBOLS[answer.variable], "time": amount(answer.time, "s"), "step": step}
        row |= {name: _settling(getattr(answer, name), unit) for name in ("settling", "believed")}
        rows.append(row | {name: amount(getattr(answer, name), unit, 2) for name in ("overshoot", "rms", "final")})
    return rows


def grids(craft: Craft) -> list[Grid]:
    """Return the RMS errors of control and estimation, and effort and saturation of the tilts, as far as recorded."""
    errors, efforts = [], []
    for name, symbol in SYMBOLS.items():
        true, unit = craft.signal(name), UNITS[name]
        tracking = error_rms(true, craft.reference(name))
        estimation = error_rms(craft.estimate(f"{name}_hat"), true)
        if math.isfinite(tracking) or math.isfinite(estimation):
            errors.append((symbol, amount(tracking, unit), amount(estimation, unit)))
    for side in SIDES:
        good, command = finite(craft.command(f"tilt_{side}"))
        if command.size:
            used = amount(criteria.effort(craft.run.time[good], command), "rad.s")
            efforts.append((side, used, amount(float(np.abs(command).max()), "rad"), percent(saturation(craft, side))))
    found = (
        Grid("RMS errors", ("craft − reference", "estimate − craft"), tuple(errors)),
        Grid("Tilt commands", ("effort ∫|α| dt", "largest", "at its limit"), tuple(efforts)),
    )
    return [grid for grid in found if grid.rows]


# -- panels -----------------------------------------------------------------------------------


def state_panels(craft: Craft) -> list[Panel]:
    """Return panels of states with references and estimates ±2σ."""
    panels = []
    for name, title in TITLES.items():
        true, estimate, unit = craft.signal(name), craft.estimate(f"{name}_hat"), UNITS[name]
        lines = [("reference", craft.reference(name), "reference", True), ("estimate", estimate, "estimate", False)]
        if is_drawn(true):
            traces = _traces([*lines, ("craft", true, "true", False)], unit)
            band = _band(craft, name, estimate, "estimate ±2σ")
            panels.append(Panel(title, axis_unit(unit), traces, band, symbol=SYMBOLS[name]))
    return panels


def error_panels(craft: Craft) -> list[Panel]:
    """Return panels of estimation errors, with the estimator's ±2σ about zero."""
    panels = []
    for name, symbol in SYMBOLS.items():
        true, estimate, unit = craft.signal(name), craft.estimate(f"{name}_hat"), UNITS[name]
        if is_drawn(true, estimate):
            band = _band(craft, name, np.zeros(true.size), "±2σ claimed")
            traces = _traces([("estimate − craft", estimate - true, "error", False)], unit)
            panels.append(Panel(f"Error of {symbol}", axis_unit(unit), traces, band))
    return panels


def tilt_panels(craft: Craft) -> list[Panel]:
    """Return panels of commanded and actual tilts."""
    panels, limit = [], craft.tilt_limit
    limits = () if limit is None else (displayed(-limit, "rad"), displayed(limit, "rad"))
    label = "" if limit is None else f"limit ±{amount(limit, 'rad', None)}"
    for side in SIDES:
        command, actual = craft.command(f"tilt_{side}"), craft.signal(f"tilt_{side}_actual")
        lines = [("command", command, COLOURS[side], True), ("actual", actual, "actual", False)]
        if traces := _traces(lines, "rad"):
            panels.append(Panel(f"Tilt, {side} propeller", axis_unit("rad"), traces, None, limits, label))
    return panels


def _traces(lines: Sequence[tuple[str, Array, str, bool]], unit: str) -> list[Trace]:
    """Return the traces of recorded lines: label, values, style, and whether values are held."""
    return [Trace(label, displayed(line, unit), style, held) for label, line, style, held in lines if is_drawn(line)]


def _band(craft: Craft, name: str, centre: Array, label: str) -> Band | None:
    """Return the band of ±2σ, None without a recorded σ."""
    ends = [displayed(centre + side * craft.estimate(f"{name}_sigma"), UNITS[name]) for side in (-2, 2)]
    return Band(label, *ends) if is_drawn(*ends) else None


def shown_columns(crafts: Sequence[Craft]) -> set[str]:
    """Return the result columns in the crafts' sections."""
    columns: set[str] = set()
    for craft in crafts:
        for name in TITLES:
            columns.add(f"{craft.name}.{name}")
            columns.update(f"{craft.estimator}.{name}_{end}" for end in ("hat", "sigma", "ref"))
            columns.add(craft.reference_column(name) or "")
        for side in SIDES:
            columns.update((f"{craft.name}.tilt_{side}", f"{craft.name}.tilt_{side}_actual"))
            columns.add(f"{craft.estimator}.tilt_{side}")
    return columns
