"""What is plotted: panels of signals in display units, the same for the page and for the figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cosim.base.arrays import Array

OTHERS_PER_PANEL = 6
LINE, HELD, DOTS, STEMS, BARS, CROSSES = range(6)


@dataclass(frozen=True)
class Trace:
    """One line: its values in the panel's unit.

    held:  from one sample to the next, where it is a command
    anew:  the line ends at each break of its drawing and begins again
    x:     places of its own, rising; else those of its drawing
    stems: from zero to each value, `shift` beside its place
    upper: bars from the values to these
    items: what is read out in place of some values
    A style that has the word `dots` or `crosses` draws points.
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
    def way(self) -> int:
        """How it is drawn, as the page's script numbers it: LINE, HELD, DOTS, STEMS, BARS, CROSSES."""
        if self.upper is not None:
            return BARS
        if self.stems:
            return STEMS
        words = self.style.split()
        return DOTS if "dots" in words else CROSSES if "crosses" in words else HELD if self.held else LINE

    @property
    def reach(self) -> list[Array]:
        """What an axis must show of it."""
        zero = [np.zeros(1)] if self.stems else []
        return [self.values, *zero] if self.upper is None else [self.values, self.upper]


@dataclass(frozen=True)
class Band:
    """A region of two standard deviations about a line; x: places of its own, rising."""

    label: str
    lower: Array
    upper: Array
    x: Array | None = None


@dataclass(frozen=True)
class Panel:
    """One set of axes over time."""

    title: str
    unit: str
    traces: Sequence[Trace]
    band: Band | None = None
    limits: tuple[float, ...] = ()
    limit_label: str = ""
    symbol: str = ""


def by_unit(names: Iterable[str], unit: Callable[[str], str]) -> list[tuple[str, list[str]]]:
    """Each unit, in the order the units come, with names that share a panel; many of one unit take several."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(unit(name), []).append(name)
    return [
        (shared, chosen[first : first + OTHERS_PER_PANEL])
        for shared, chosen in groups.items()
        for first in range(0, len(chosen), OTHERS_PER_PANEL)
    ]
