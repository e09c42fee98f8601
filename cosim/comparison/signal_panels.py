"""Panels of a signal in two or more runs: the curves of all runs, and their differences from the baseline."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.base.arrays import Array
from cosim.base.text import display
from cosim.report.panels import NO_UNIT_TEXT, Panel, Trace

BASELINE, STYLES = "baseline", 15  # styles of lines: `run0` … `run14` for the others


def panels_of(name: str, unit: str, runs: tuple[str, str], values: tuple[Array, Array]) -> list[Panel]:
    """Return the panels of a signal in two named runs at the same times."""
    label, factor = _display(unit)
    first, second = (v * factor for v in values)
    both = [Trace(f"a: {runs[0]}", first, "s0"), Trace(f"b: {runs[1]}", second, "s1")]
    return [
        Panel(name, label, both),
        Panel(f"{name}, b − a", label, [Trace("b − a", second - first, "error")]),
    ]


def styles_of(count: int, baseline: int) -> list[str]:
    """Return a style of line for each run; that of the baseline is different from all others."""
    return [BASELINE if k == baseline else f"run{(k - (k > baseline)) % STYLES}" for k in range(count)]


def overlay(name: str, unit: str, runs: Sequence[str], values: Sequence[Array], baseline: int = 0) -> Panel:
    """Return the panel of a signal in several named runs at the same times."""
    label, factor = _display(unit)
    styles = styles_of(len(runs), baseline)
    return Panel(name, label, [Trace(r, v * factor, s) for r, v, s in zip(runs, values, styles, strict=True)])


def equal_panel(name: str, unit: str, values: Array, runs: str = "all runs") -> Panel:
    """Return the panel of a signal that is equal in all runs: one curve."""
    label, factor = _display(unit)
    return Panel(name, label, [Trace(runs, values * factor, BASELINE)])


def differences(
    name: str, unit: str, runs: Sequence[str], values: Sequence[Array], baseline: int = 0, short: str = ""
) -> Panel:
    """Return the panel of the differences of a signal from the baseline; `short` is its name in the title."""
    label, factor = _display(unit)
    styles, first = styles_of(len(runs), baseline), values[baseline]
    traces = [Trace(runs[k], (values[k] - first) * factor, styles[k]) for k in range(len(runs)) if k != baseline]
    return Panel(f"{name}, minus {short or runs[baseline]}", label, traces)


def _display(unit: str) -> tuple[str, float]:
    """Return the label of an axis, and the factor to its values."""
    shown, factor = display(unit)
    return shown or unit or NO_UNIT_TEXT, factor
