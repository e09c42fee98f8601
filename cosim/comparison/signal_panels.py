"""One signal of two runs as panels: both over each other, and how far they are apart."""

from __future__ import annotations

from cosim.base.arrays import Array
from cosim.base.text import display
from cosim.report.panels import Panel, Trace


def panels_of(name: str, unit: str, runs: tuple[str, str], values: tuple[Array, Array]) -> list[Panel]:
    """Panels of a signal in its unit [unit], of two runs by name, with their values at the same times."""
    shown, factor = display(unit)
    first, second = (v * factor for v in values)
    both = [Trace(f"a: {runs[0]}", first, "s0"), Trace(f"b: {runs[1]}", second, "s1")]
    return [
        Panel(name, shown or unit or "no unit", both),
        Panel(f"{name}, b − a", shown or unit or "no unit", [Trace("b − a", second - first, "error")]),
    ]
