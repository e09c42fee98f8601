"""Panels of signals in display units, for pages and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import displayed, shown_unit

OTHERS_PER_PANEL = 6
WIDEST_RANGES = 20.0  # axis' range over the range of a signal without a unit; smaller signals would look constant
MAX_CONSTANT_RANGE = 1e-9  # range of a constant signal, relative to its size
NO_UNIT_TEXT = "no unit declared"  # in place of a unit on an axis; the script of a page reads it, too


@dataclass(frozen=True)
class Trace:
    """One line of a panel.

    The word `dots` or `crosses` in `style` draws points.

    Attributes:
        values: Values in the panel's unit.
        held: True if each value is held until the next sample, as commands are.
        anew: True if each break of the drawing interrupts the line.
        x: Increasing x values; None means the x values of the drawing.
        stems: True for lines from zero to each value.
        upper: Upper ends of bars that begin at the values.
        items: Value → text that is shown instead of the value.
    """

    label: str
    values: Array
    style: str
    held: bool = False
    anew: bool = False
    x: Array | None = None
    stems: bool = False
    upper: Array | None = None
    items: Mapping[float, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Band:
    """A shaded region between two lines.

    Attributes:
        x: Increasing x values; None means the x values of the drawing.
    """

    label: str
    lower: Array
    upper: Array
    x: Array | None = None


@dataclass(frozen=True)
class Panel:
    """One set of axes with traces, band and limits.

    Attributes:
        outside: Intervals of time [s] in which the model is outside the region covered by its logs.
    """

    title: str
    unit: str
    traces: Sequence[Trace]
    band: Band | None = None
    limits: tuple[float, ...] = ()
    limit_label: str = ""
    symbol: str = ""
    outside: Sequence[tuple[float, float]] = ()


def axis_unit(unit: str) -> str:
    """Return the label of an axis that shows values of a unit."""
    return shown_unit(unit) or unit or NO_UNIT_TEXT


def signal_panel(
    title: str,
    unit: str,
    lines: Iterable[tuple[str, Array, str]],
    band: tuple[str, Array, Array] | None = None,
    *,
    held: bool = False,
    **more: Any,
) -> Panel:
    """Return a panel that shows signals of one unit in its display unit.

    Args:
        lines: (label, values in the unit, style) of each line.
        band: (label, lower edge, upper edge), edges in the unit.
        more: Further attributes of the panel.
    """
    traces = [Trace(label, displayed(values, unit), style, held) for label, values, style in lines]
    shaded = band and Band(band[0], displayed(band[1], unit), displayed(band[2], unit))
    return Panel(title, axis_unit(unit), traces, shaded, **more)


def extent(signals: Sequence[Array]) -> tuple[float, float] | None:
    """Return the least and the largest finite value of all signals; None if there is none."""
    finite = np.concatenate([np.zeros(0), *(values[np.isfinite(values)] for values in signals)])
    return (float(finite.min()), float(finite.max())) if finite.size else None


def by_unit(
    names: Iterable[str], unit: Callable[[str], str], values: Callable[[str], Array]
) -> list[tuple[str, list[str]]]:
    """Return (unit, names of its signals) for each panel.

    Signals without a unit share a panel only if the range of each is large enough to be visible on the common axis.
    """
    groups: list[tuple[str, list[str]]] = []
    spans: dict[str, tuple[float, float]] = {}

    def are_visible(chosen: Sequence[str]) -> bool:
        ends = [spans[name] for name in chosen]
        ranges = [high - low for low, high in ends if high - low > MAX_CONSTANT_RANGE * max(abs(low), abs(high))]
        whole = max(high for _, high in ends) - min(low for low, _ in ends)
        return whole <= WIDEST_RANGES * min(ranges, default=math.inf)

    for name in names:
        spans[name] = extent([values(name)]) or (math.inf, -math.inf)
        for shared, chosen in groups:
            is_free = shared == unit(name) and len(chosen) < OTHERS_PER_PANEL
            if is_free and (shared not in ("", "1") or are_visible([*chosen, name])):
                chosen.append(name)
                break
        else:
            groups.append((unit(name), [name]))
    return groups


def held_panels(signals: Mapping[str, Array], units: Mapping[str, str]) -> list[Panel]:
    """Return panels of signals whose values are constant between rows, one panel per unit."""
    return [
        signal_panel(", ".join(names), unit, [(n, signals[n], f"s{k}") for k, n in enumerate(names)], held=True)
        for unit, names in by_unit(signals, units.__getitem__, signals.__getitem__)
    ]
