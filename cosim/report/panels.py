"""What is plotted: panels of signals in display units, the same for the page and for the figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from cosim.arrays import Array

OTHERS_PER_PANEL = 6


@dataclass(frozen=True)
class Trace:
    """One line: its values in the panel's unit; `held` from one sample to the next where it is a command."""

    label: str
    values: Array
    style: str
    held: bool = False


@dataclass(frozen=True)
class Band:
    """A region of two standard deviations about a line."""

    label: str
    lower: Array
    upper: Array


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
