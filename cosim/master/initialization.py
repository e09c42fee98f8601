"""Initialization of a system: values are exchanged until they settle; then every component starts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.base.errors import SimulationError
from cosim.base.messages import code_of
from cosim.blocks.component import Component
from cosim.blocks.messages import VALUE_NOT_FINITE
from cosim.isolation.rows import CALLS, GET, OTHER, PUT
from cosim.master import messages
from cosim.master.copying import Copies, copy_values
from cosim.master.loops import LoopSolver
from cosim.system.system import System

EXACT_SWEEPS = 10  # sweeps that must settle exactly; later sweeps settle within a tolerance
MOST_SWEEPS = 1000  # sweeps after which unsettled values are an error, unless their changes shrink
LAST_SWEEP = 50_000  # limit for shrinking changes
SETTLED_CHANGE = 1e-12  # relative change of a settled value
SHRINKING_RATIO = 0.9  # ratio of changes over MOST_SWEEPS below which they shrink


@dataclass(frozen=True)
class Initialization:
    """Components in initialization mode, and the copies between them.

    Attributes:
        pulls: Component → copies before its call.
        held: Copies after all calls.
        doing: Current call, for observers.
        solvers: Solvers of algebraic loops.
    """

    system: System
    components: Sequence[Component]
    row: Any
    beside: Sequence[Any]
    pulls: Mapping[str, Copies]
    held: Copies
    doing: MutableSequence[int]
    solvers: Sequence[LoopSolver] = ()

    def run(self) -> None:
        """Exchange values until settled, then end initialization; raise SimulationError after a failure."""
        self._settle()
        before = self._values()
        for k, component in enumerate(self.components):
            self.doing[0] = CALLS * k + OTHER
            component.start()
        for k, component in enumerate(self.components):
            self.doing[0] = CALLS * k + GET
            component.get()
        if self._values() != before:  # Some FMUs (20-sim) have valid outputs only after initialization.
            self.sweep()

    def _settle(self) -> None:
        earlier, name = math.inf, ""
        for sweep in range(1, LAST_SWEEP + 1):
            before, row = self._values(), list(self.row)
            try:
                self.sweep()
            except SimulationError as error:
                if sweep <= EXACT_SWEEPS or code_of(error) != VALUE_NOT_FINITE.code:
                    raise
                name = error.component
                break  # The values of a loop grew from exchange to exchange.
            if self._values() == before or (sweep > EXACT_SWEEPS and is_settled(row, self.row)):
                return
            if sweep % MOST_SWEEPS == 0:
                change = max((abs(a - b) for a, b in zip(self.row, row, strict=True)), default=0.0)
                if not change < SHRINKING_RATIO * earlier:
                    break
                earlier = change
        changed = (name for name, a, b in zip(self.system.columns, self.row, row, strict=True) if a != b)
        name = name or next(changed, "initialization")
        raise SimulationError(name, self.system.start, messages.NOT_SETTLED(count=sweep))

    def sweep(self) -> None:
        """Exchange all values once."""
        solver_of = {member.component.name: solver for solver in self.solvers for member in solver.members}
        for k, component in enumerate(self.components):
            copy_values(self.row, self.pulls[component.name], 0)
            if (solver := solver_of.get(component.name)) is not None:
                if component.name == solver.last:
                    solver.solve_start()
                continue
            self.doing[0] = CALLS * k + PUT
            component.put()
            self.doing[0] = CALLS * k + GET
            component.get()
        copy_values(self.row, self.held, 0)

    def _values(self) -> tuple[bytes, list[Any]]:
        return bytes(self.row), list(self.beside)


def is_settled(before: Iterable[float], after: Iterable[float]) -> bool:
    """Return whether all values agree with those of the previous exchange, within rounding."""
    return all(abs(a - b) <= SETTLED_CHANGE * max(1.0, abs(b)) for a, b in zip(after, before, strict=True))
