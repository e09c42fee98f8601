"""Panels of the craft: states, errors of the estimate, tilts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import DEGREES
from cosim.report.panels import Band, Panel, Trace
from fmus.report.craft import COLOURS, SIDES, Craft


@dataclass(frozen=True)
class PlottedQuantity:
    """A controlled and estimated state, with its displayed unit."""

    name: str
    title: str
    symbol: str
    unit: str
    factor: float = 1.0


QUANTITIES = (
    PlottedQuantity("x", "Distance along the craft's axis", "x", "m"),
    PlottedQuantity("psi", "Heading, positive to the left", "ψ", "°", DEGREES),
    PlottedQuantity("vx", "Forward speed", "v", "m/s"),
    PlottedQuantity("psi_dot", "Yaw rate, positive to the left", "ψ̇", "°/s", DEGREES),
)


def state_panels(craft: Craft) -> list[Panel]:
    """Return panels of states with references and estimates ±2σ."""
    panels = []
    for quantity in QUANTITIES:
        true, estimate = craft.signal(quantity.name), craft.estimate(f"{quantity.name}_hat")
        if true is None:
            continue
        reference = craft.reference(quantity.name)
        lines = [("reference", reference, "reference", True), ("estimate", estimate, "estimate", False)]
        lines.append(("craft", true, "true", False))
        traces = [
            Trace(label, line * quantity.factor, style, held) for label, line, style, held in lines if line is not None
        ]
        band = _band(craft, quantity, estimate, "estimate ±2σ")
        panels.append(Panel(quantity.title, quantity.unit, traces, band, symbol=quantity.symbol))
    return panels


def error_panels(craft: Craft) -> list[Panel]:
    """Return panels of estimation errors, with the estimator's ±2σ about zero."""
    panels = []
    for quantity in QUANTITIES:
        true, estimate = craft.signal(quantity.name), craft.estimate(f"{quantity.name}_hat")
        if true is None or estimate is None:
            continue
        band = _band(craft, quantity, np.zeros(true.size), "±2σ claimed")
        trace = Trace("estimate − craft", (estimate - true) * quantity.factor, "error")
        panels.append(Panel(f"Error of {quantity.symbol}", quantity.unit, [trace], band))
    return panels


def _band(craft: Craft, quantity: PlottedQuantity, centre: Array | None, label: str) -> Band | None:
    sigma = craft.estimate(f"{quantity.name}_sigma")
    if centre is None or sigma is None:
        return None
    return Band(label, (centre - 2 * sigma) * quantity.factor, (centre + 2 * sigma) * quantity.factor)


def tilt_panels(craft: Craft) -> list[Panel]:
    """Return panels of commanded and actual tilts."""
    panels = []
    for side in SIDES:
        command, actual = craft.command(f"tilt_{side}"), craft.signal(f"tilt_{side}_actual")
        lines = [("command", command, COLOURS[side], True), ("actual", actual, "actual", False)]
        traces = [Trace(name, line * DEGREES, style, held) for name, line, style, held in lines if line is not None]
        limit = craft.tilt_limit
        limits = () if limit is None else (-limit * DEGREES, limit * DEGREES)
        label = "" if limit is None else f"limit ±{limit * DEGREES:.4g}°"
        if traces:
            panels.append(Panel(f"Tilt, {side} propeller", "°", traces, None, limits, label))
    return panels


def shown_columns(crafts: Sequence[Craft]) -> set[str]:
    """Return the result columns in the crafts' sections."""
    columns: set[str] = set()
    for craft in crafts:
        for quantity in QUANTITIES:
            columns.add(f"{craft.name}.{quantity.name}")
            columns.update(f"{craft.estimator}.{quantity.name}_{end}" for end in ("hat", "sigma", "ref"))
            columns.add(craft.reference_column(quantity.name) or "")
        for side in SIDES:
            columns.update((f"{craft.name}.tilt_{side}", f"{craft.name}.tilt_{side}_actual"))
            columns.add(f"{craft.estimator}.tilt_{side}")
    return columns
