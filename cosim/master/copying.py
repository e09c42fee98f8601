"""Copies of signals, prepared once per run: within the row of doubles, and of values that doubles cannot hold."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from cosim.blocks.faults import LinkFunction
from cosim.blocks.stepping import LinkKind
from cosim.system.system import System
from cosim.system.wiring import Transfer, through

Plain = tuple[tuple["memoryview[float]", "memoryview[float]"], ...]  # contiguous parts of the row, target first
Noisy = tuple[tuple[int, int, Sequence[float]], ...]
# from a place to a place, in the row or beside it, through a function of (point, value)
Through = tuple[tuple[Any, int, Any, int, Callable[[int, Any], Any]], ...]
Copies = tuple[Plain, Noisy, Through]


class Copying:
    """Prepared transfers of a run over `steps` steps of `h` [s], with sensor noise and injected faults.

    Attributes:
        links: Transfer name → conversions of its value.
    """

    def __init__(self, system: System, row: Any, beside: list[Any], steps: int, h: float) -> None:
        self.system, self.row, self.beside, self.steps, self.h = system, row, beside, steps, h
        self.links: dict[str, Sequence[LinkFunction]] = {}
        self._view = doubles(row)
        self._entries: dict[str, tuple[int, tuple[Any, ...]]] = {}  # name → kind of copy (0 … 2) and its entry

    def of(self, transfers: Iterable[Transfer]) -> Copies:
        """Return transfers as plain copies of contiguous parts, as noisy, and as other copies."""
        parts: list[tuple[int, int, int]] = []  # first source, first target, length
        kinds: tuple[list[Any], list[Any], list[Any]] = ([], [], [])
        for transfer in transfers:
            if transfer.name not in self._entries:
                chain = transfer.through(self.system.seed, self.system.start, self.h, self.steps + 1)
                noise = next((link.values for link in chain if link.kind is LinkKind.ADDED), None)
                ends: tuple[int, tuple[Any, ...]] = 0, (transfer.source, transfer.target)
                if not transfer.plain:
                    origin, goal = (self.beside if beside else self.row for beside in transfer.beside)
                    ends = 2, (origin, transfer.source, goal, transfer.target, through(chain))
                elif noise is not None:
                    ends = 1, (transfer.source, transfer.target, noise)
                self.links[transfer.name], self._entries[transfer.name] = chain, ends
            kind, entry = self._entries[transfer.name]
            kinds[kind].append(entry)
        for source, target in kinds[0]:
            first, goal, count = parts[-1] if parts else (0, 0, 0)
            if parts and (source, target) == (first + count, goal + count):
                parts[-1] = first, goal, count + 1
            else:
                parts.append((source, target, 1))
        plain = tuple((self._view[b : b + n], self._view[a : a + n]) for a, b, n in parts)
        return plain, tuple(kinds[1]), tuple(kinds[2])


def copy_values(row: Any, copies: Copies, k: int) -> None:
    """Make the copies of communication point k."""
    plain, noisy, others = copies
    for target_places, places in plain:
        target_places[:] = places
    for source, target, samples in noisy:
        row[target] = row[source] + samples[k]
    for origin, source, goal, target, function in others:
        goal[target] = function(k, origin[source])


def doubles(buffer: Any) -> memoryview[float]:
    """Return a buffer of doubles as a flat memory view."""
    flat = memoryview(buffer)
    return flat.cast("B").cast("d") if flat.nbytes else memoryview(array("d"))
