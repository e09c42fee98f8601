"""Panels of the craft: states, errors of the estimate, tilts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import amount, displayed
from cosim.report.panels import Band, Panel, Trace, axis_unit
from fmus.report.craft import COLOURS, SIDES, Craft
from plant.hovercraft import Hovercraft

UNITS = {q.name: q.unit for q in Hovercraft.outputs}
TITLES = {  # of the controlled and estimated states
    "x": "Distance along the craft's axis",
    "psi": "Heading, positive to the left",
    "vx": "Forward speed",
    "psi_dot": "Yaw rate, positive to the left",
}
SYMBOLS = {"x": "x", "psi": "ψ", "vx": "v", "psi_dot": "ψ̇"}


def state_panels(craft: Craft) -> list[Panel]:
    """Return panels of states with references and estimates ±2σ."""
    panels = []
    for name, title in TITLES.items():
        true, estimate, unit = craft.signal(name), craft.estimate(f"{name}_hat"), UNITS[name]
        if true is None:
            continue
        lines = [("reference", craft.reference(name), "reference", True), ("estimate", estimate, "estimate", False)]
        lines.append(("craft", true, "true", False))
        drawn = [(label, displayed(line, unit), style, held) for label, line, style, held in lines if line is not None]
        traces = [Trace(*line) for line in drawn]
        band = _band(craft, name, estimate, "estimate ±2σ")
        panels.append(Panel(title, axis_unit(unit), traces, band, symbol=SYMBOLS[name]))
    return panels


def error_panels(craft: Craft) -> list[Panel]:
    """Return panels of estimation errors, with the estimator's ±2σ about zero."""
    panels = []
    for name, symbol in SYMBOLS.items():
        true, estimate, unit = craft.signal(name), craft.estimate(f"{name}_hat"), UNITS[name]
        if true is not None and estimate is not None:
            band = _band(craft, name, np.zeros(true.size), "±2σ claimed")
            trace = Trace("estimate − craft", displayed(estimate - true, unit), "error")
            panels.append(Panel(f"Error of {symbol}", axis_unit(unit), [trace], band))
    return panels


def _band(craft: Craft, name: str, centre: Array | None, label: str) -> Band | None:
    sigma, unit = craft.estimate(f"{name}_sigma"), UNITS[name]
    if centre is None or sigma is None:
        return None
    return Band(label, displayed(centre - 2 * sigma, unit), displayed(centre + 2 * sigma, unit))


def tilt_panels(craft: Craft) -> list[Panel]:
    """Return panels of commanded and actual tilts."""
    panels = []
    for side in SIDES:
        command, actual = craft.command(f"tilt_{side}"), craft.signal(f"tilt_{side}_actual")
        lines = [("command", command, COLOURS[side], True), ("actual", actual, "actual", False)]
        traces = [
            Trace(name, displayed(line, "rad"), style, held) for name, line, style, held in lines if line is not None
        ]
        limit = craft.tilt_limit
        limits = () if limit is None else (displayed(-limit, "rad"), displayed(limit, "rad"))
        label = "" if limit is None else f"limit ±{amount(limit, 'rad', None)}"
        if traces:
            panels.append(Panel(f"Tilt, {side} propeller", axis_unit("rad"), traces, None, limits, label))
    return panels


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
