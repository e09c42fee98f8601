"""Panels of signals in display units, common to page and figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cosim.base.arrays import Array

OTHERS_PER_PANEL = 6
WIDEST_RANGES = 20.0  # axis' range over the range of a signal without a unit; smaller signals would look constant
CONSTANT = 1e-9  # range of a constant signal, relative to its size
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
        words = self.style.split()
        if self.upper is not None:
            return "bars"
        if self.stems:
            return "stems"
        return "dots" if "dots" in words else "crosses" if "crosses" in words else "held" if self.held else "line"


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
    """One set of axes with traces, band and limits."""

    title: str
    unit: str
    traces: Sequence[Trace]
    band: Band | None = None
    limits: tuple[float, ...] = ()
    limit_label: str = ""
    symbol: str = ""


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
    groups: list[tuple[str, list[str], _Range]] = []
    for name in names:
        shared, extent = unit(name), _Range.of(values(name))
        for k, (other, chosen, span) in enumerate(groups):
            both = span.union(extent)
            if shared == other and len(chosen) < OTHERS_PER_PANEL and (shared not in NO_UNIT or both.shows_all):
                groups[k] = (other, [*chosen, name], both)
                break
        else:
            groups.append((shared, [name], extent))
    return [(shared, chosen) for shared, chosen, _ in groups]


@dataclass(frozen=True)
class _Range:
    """Range of the signals on an axis, and the smallest range of a varying signal."""

    low: float
    high: float
    smallest: float

    @classmethod
    def of(cls, values: Array) -> _Range:
        finite = values[np.isfinite(values)]
        if not finite.size:
            return cls(math.inf, -math.inf, math.inf)
        low, high = float(finite.min()), float(finite.max())
        constant = high - low <= CONSTANT * max(abs(low), abs(high))
        return cls(low, high, math.inf if constant else high - low)

    def union(self, other: _Range) -> _Range:
        """Return the smallest range that contains both."""
        return _Range(min(self.low, other.low), max(self.high, other.high), min(self.smallest, other.smallest))

    @property
    def shows_all(self) -> bool:
        """Return whether every signal is large enough to see."""
        return self.high - self.low <= WIDEST_RANGES * self.smallest
