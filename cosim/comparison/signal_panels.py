"""Panels of a signal in two runs: both curves, and their difference."""

from __future__ import annotations

from cosim.base.arrays import Array
from cosim.base.text import display
from cosim.report.panels import NO_UNIT_TEXT, Panel, Trace


def panels_of(name: str, unit: str, runs: tuple[str, str], values: tuple[Array, Array]) -> list[Panel]:
    """Return the panels of a signal in two named runs at the same times."""
    display_unit, factor = display(unit)
    label = display_unit or unit or NO_UNIT_TEXT
    first, second = (v * factor for v in values)
    both = [Trace(f"a: {runs[0]}", first, "s0"), Trace(f"b: {runs[1]}", second, "s1")]
    return [
        Panel(name, label, both),
        Panel(f"{name}, b − a", label, [Trace("b − a", second - first, "error")]),
    ]
