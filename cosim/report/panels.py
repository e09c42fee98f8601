"""Panels of signals in display units, common to page and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import displayed, shown_unit

OTHERS_PER_PANEL = 6
WIDEST_RANGES = 20.0  # axis' range over the range of a signal without a unit; smaller signals would look constant
CONSTANT = 1e-9  # range of a constant signal, relative to its size
POINTS = ("dots", "crosses")  # words of a style
NO_UNIT = ("", "1")
NO_UNIT_TEXT = "no unit declared"  # in place of a unit on an axis; the script of a page reads it, too


@dataclass(frozen=True)
class Trace:
    """One line of a panel.

    The word `dots` or `crosses` in `style` draws points.

    Attributes:
        values: Values in the panel's unit.
        held: True if each value is held until the next sample, as commands are.
        anew: True if the line restarts at each break of its drawing.
        x: Increasing values of the horizontal axis; None takes the values of the drawing.
        stems: True for lines from zero to each value, displaced by `shift`.
        upper: Upper ends of bars that begin at the values.
        items: Texts shown instead of values.
    """

    label: str
    values: Array
    style: str
    held: bool = False
    anew: bool = False
    x: Array | None = None
    stems: bool = False
    shift: float = 0.0
    upper: Array | None = None
    items: Mapping[float, str] = field(default_factory=dict)

    @property
    def form(self) -> str:
        """Return the kind of drawing for the page's script."""
        if self.upper is not None or self.stems:
            return "stems" if self.upper is None else "bars"
        return next((word for word in self.style.split() if word in POINTS), "held" if self.held else "line")


@dataclass(frozen=True)
class Band:
    """A shaded region between two lines.

    Attributes:
        x: Increasing values of the horizontal axis; None takes the values of the drawing.
    """

    label: str
    lower: Array
    upper: Array
    x: Array | None = None


@dataclass(frozen=True)
class Panel:
    """One set of axes with traces, band and limits.

    Attributes:
        outside: Intervals of time [s] in which the model has left the region of its logs.
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
    """Return the label of an axis for the values of a unit."""
    return shown_unit(unit) or unit or NO_UNIT_TEXT


def extent(signals: Sequence[Array]) -> tuple[float, float] | None:
    """Return the least and largest finite value."""
    finite = np.concatenate([np.zeros(0), *(values[np.isfinite(values)] for values in signals)])
    return (float(finite.min()), float(finite.max())) if finite.size else None


def by_unit(
    names: Iterable[str], unit: Callable[[str], str], values: Callable[[str], Array]
) -> list[tuple[str, list[str]]]:
    """Return unit and signal names of each panel.

    Signals without a unit share a panel only if each is visible on the common axis.
    """
    groups: list[tuple[str, list[str], float, float, float]] = []  # unit, names, range, smallest range of a signal
    for name in names:
        shared, around = unit(name), extent([values(name)])
        low, high = around or (math.inf, -math.inf)
        smallest = high - low if high - low > CONSTANT * max(abs(low), abs(high)) else math.inf
        for k, (other, chosen, least, most, narrowest) in enumerate(groups):
            least, most, narrowest = min(low, least), max(high, most), min(smallest, narrowest)
            shows_all = shared not in NO_UNIT or most - least <= WIDEST_RANGES * narrowest
            if shared == other and len(chosen) < OTHERS_PER_PANEL and shows_all:
                groups[k] = other, [*chosen, name], least, most, narrowest
                break
        else:
            groups.append((shared, [name], low, high, smallest))
    return [(shared, chosen) for shared, chosen, *_ in groups]


def held_panels(signals: Mapping[str, Array], units: Mapping[str, str]) -> list[Panel]:
    """Return panels of signals that hold their values between rows, grouped by unit."""
    panels = []
    for unit, names in by_unit(signals, units.__getitem__, signals.__getitem__):
        traces = [Trace(n, displayed(signals[n], unit), f"s{k}", held=True) for k, n in enumerate(names)]
        panels.append(Panel(", ".join(names), shown_unit(unit) or "1", traces))
    return panels
