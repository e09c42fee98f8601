"""Initialization of a system: values are exchanged until they settle; then every component starts.

Values that exchanging does not settle are those of a loop that exists in initialization only, or that no FMU declares.
The values that connections hold from one exchange to the next are then the unknowns of an equation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import NotFinite, SimulationError
from cosim.blocks.component import EarlyEnd
from cosim.isolation.rows import CALLS, GET, OTHER, PUT
from cosim.master.copying import copy_values
from cosim.master.loops import MOST_DIFFERENCES, SHIFT, LoopSolver, is_lost
from cosim.master.root_finding import NotDefined, RootFinding
from cosim.scenario.scenario import LoopSettings

if TYPE_CHECKING:
    from cosim.master.master import Master

EXACT_SWEEPS = 10  # sweeps that must settle exactly; later sweeps settle within a tolerance
LAST_SWEEP = 50_000  # limit for shrinking changes
SETTLED_CHANGE = 1e-12  # relative change of a settled value
SHRINKING_RATIO = 0.9  # ratio of changes below which they shrink, over more sweeps than a chain of connections needs


class Initialization:
    """Components of a run in initialization mode, and the copies between them.

    Args:
        solvers: Solvers of algebraic loops.
    """

    def __init__(self, master: Master, solvers: Sequence[LoopSolver] = ()) -> None:
        self.system, self.components, self.row, self.beside = (
            master.system,
            master.components,
            master.row,
            master.beside,
        )
        self.doing, copying = master.doing, master.copying
        self.pulls = {stage.component.name: copying.of(stage.transfers) for stage in self.system.stages}
        self.held = copying.of(self.system.held)
        self.solver_of = {name: solver for solver in solvers for name in solver.names}

    def run(self) -> None:
        """Exchange values until settled, then end initialization; raise SimulationError after a failure."""
        solved = self._settle()
        before = self._values()
        for k, component in enumerate(self.components):
            self.doing[0] = CALLS * k + OTHER
            component.start()
        for k, component in enumerate(self.components):
            self.doing[0] = CALLS * k + GET
            component.get()
        for _ in self.components:  # Some FMUs (20-sim) have valid outputs only after initialization.
            if self._values() == before:
                break
            before = self._values()
            self.sweep()
        if solved and self._grows(solved):  # The loop is there after initialization too.
            raise self._not_settled(self.system.columns[solved[0]], 1)

    def _not_settled(self, name: str, count: int) -> SimulationError:
        return NotFinite(
            name,
            self.system.start,
            (
                f"it still changes after {count} exchanges of initialization: an algebraic loop that "
                "exchanging values does not settle; an FMU without direct feedthrough in the loop breaks "
                "it"
            ),
        )

    def _settle(self) -> list[int]:
        """Exchange values until they settle; solve for them if their changes do not shrink.

        Returns:
            Places of the values that were solved for, if any.
        """
        places = self._unknowns()
        earlier, period, first = math.inf, EXACT_SWEEPS + len(self.system.held), [0.0] * len(places)
        for sweep in range(1, LAST_SWEEP + 1):
            before, row = self._values(), list(self.row)
            try:
                self.sweep()
            except SimulationError as error:
                if sweep <= EXACT_SWEEPS or isinstance(error, EarlyEnd) or self._is_any_lost():
                    raise
                break  # The values of a loop grew from exchange to exchange.
            if sweep == 1:
                first = [self.row[k] for k in places]
            if self._values() == before or (sweep > EXACT_SWEEPS and is_settled(row, self.row)):
                return []
            if sweep % period == 0:
                change = max((abs(a - b) for a, b in zip(self.row, row, strict=True)), default=0.0)
                if not change < SHRINKING_RATIO * earlier:
                    break
                earlier = change
        changed = (name for name, a, b in zip(self.system.columns, self.row, row, strict=True) if a != b)
        name = next(changed, "initialization")
        if not (places and self._solve(places, np.array(first))):
            raise self._not_settled(name, sweep)
        return places

    def _unknowns(self) -> list[int]:
        """Return the places of real values that connections hold from one exchange to the next."""
        signals, columns = self.system.signals, self.system.columns
        places = {t.target for t in self.system.held if not t.beside[1]}
        return sorted(k for k in places if columns[k] not in signals or not signals[columns[k]].is_whole)

    def _solve(self, places: Sequence[int], start: Array) -> bool:
        """Solve for the values at places of the row from a start; return whether there is a solution."""
        settings = self.system.solving or LoopSettings()
        roots = RootFinding(settings.tolerance, settings.iterations, np.ones(start.size), np.full(start.size, True))
        exchanged = partial(self._exchanged, places)
        try:
            if start.size <= MOST_DIFFERENCES:
                outcome = roots.newton(exchanged, start, partial(self._slopes, places))
            else:
                outcome = roots.anderson(exchanged, start)
        except NotDefined:
            return False
        is_finite = (np.abs(outcome.z) <= np.maximum(1.0, np.abs(start)) / settings.tolerance).all()
        return bool(outcome.converged and is_finite and exchanged(outcome.z) is not None)

    def _exchanged(self, places: Sequence[int], z: Array) -> Array | None:
        """Return the values at places of the row after an exchange that begins with z; None where it is refused."""
        for place, value in zip(places, z.tolist(), strict=True):
            self.row[place] = value
        try:
            self.sweep()
        except SimulationError as error:
            if isinstance(error, EarlyEnd) or self._is_any_lost():
                raise
            return None
        return np.array([self.row[k] for k in places])

    def _slopes(self, places: Sequence[int], z: Array, g: Array, *, fresh: bool = True) -> Array:
        """Return the slopes of an exchange by differences."""
        shifts = np.diag(SHIFT * np.maximum(1.0, np.abs(z)))
        moved = [self._exchanged(places, z + shift) for shift in shifts]
        columns = [np.zeros(z.size) if each is None else each - g for each in moved]
        return np.array(columns).T / np.diag(shifts)

    def _grows(self, places: Sequence[int]) -> bool:
        """Return whether deviations of values grow from exchange to exchange after initialization."""
        z = np.array([self.row[k] for k in places])
        g = self._exchanged(places, z)
        if g is None or z.size > MOST_DIFFERENCES:
            return False
        slopes = self._slopes(places, z, g)
        self._exchanged(places, z)
        return bool(np.max(np.abs(np.linalg.eigvals(slopes))) >= 1.0)

    def _is_any_lost(self) -> bool:
        return any(is_lost(component) for component in self.components)

    def sweep(self) -> None:
        """Exchange all values once."""
        for k, component in enumerate(self.components):
            copy_values(self.row, self.pulls[component.name], 0)
            if (solver := self.solver_of.get(component.name)) is not None:
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
