"""Copies of signals, prepared once per run: within the row of doubles, and of values that doubles cannot represent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from cosim.blocks.faults import LinkFunction
from cosim.system.system import System
from cosim.system.wiring import Transfer, through

Copies = Callable[[int], None]  # function that makes the copies of a communication point


class Copying:
    """Prepared transfers of a run of `steps` steps of `h` [s], with sensor noise and injected faults.

    Attributes:
        links: Name of a transfer → noise and faults that change its value.
        functions: Name of a transfer → function of (point, value) that applies them.
    """

    def __init__(self, system: System, row: Any, beside: list[Any], steps: int, h: float) -> None:
        self.system, self.row, self.beside, self.steps, self.h = system, row, beside, steps, h
        self.values = np.ctypeslib.as_array(row)
        self.links: dict[str, Sequence[LinkFunction]] = {}
        self.functions: dict[str, Callable[[int, Any], Any]] = {}

    def of(self, transfers: Iterable[Transfer]) -> Copies:
        """Return a function that makes transfers: all plain copies within the row at once, then the others."""
        sources, targets = list[int](), list[int]()  # of plain copies
        others: list[tuple[Any, int, Any, int, Callable[[int, Any], Any]]] = []  # from a place to a place by a function
        for transfer in transfers:
            if transfer.name not in self.links:
                chain = transfer.through(self.system.seed, self.system.start, self.h, self.steps + 1)
                self.links[transfer.name], self.functions[transfer.name] = chain, through(chain)
            source, target = transfer.source, transfer.target
            if self.links[transfer.name] or any(transfer.beside):
                origin, goal = (self.beside if beside else self.row for beside in transfer.beside)
                others.append((origin, source, goal, target, self.functions[transfer.name]))
            else:
                sources.append(source)
                targets.append(target)
        values, from_, to = self.values, np.array(sources, np.intp), np.array(targets, np.intp)

        def copy(k: int) -> None:
            if sources:
                values[to] = values[from_]
            for origin, source, goal, target, function in others:
                goal[target] = function(k, origin[source])

        return copy
