"""Initialization of a system: values are exchanged until they no longer change; then every component starts.

Values that do not settle belong to a loop that exists only during initialization, or that no FMU declares. The values
that connections hold from one exchange to the next are then the unknowns of an equation, which is solved.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.component import GET, PUT, EarlyEnd
from cosim.core.arrays import Array
from cosim.core.errors import NotFinite, SimulationError
from cosim.master.loops import MOST_DIFFERENCES, SHIFT, LoopSolver, is_lost
from cosim.master.root_finding import RootFinding
from cosim.scenario.scenario import LoopSettings

if TYPE_CHECKING:
    from cosim.master.master import Master

EXACT_SWEEPS = 10  # exchanges in which values must settle exactly; later ones allow a tolerance
LAST_SWEEP = 50_000  # largest number of exchanges while changes shrink
SETTLED_CHANGE = 1e-12  # largest relative change of a settled value
SHRINKING_RATIO = 0.9  # ratio of changes below which they shrink, over more sweeps than a chain of connections needs


class Initialization:
    """Initialization of the components of a run, with the copies between them.

    Args:
        solvers: Solvers of algebraic loops.
    """

    def __init__(self, master: Master, solvers: Sequence[LoopSolver] = ()) -> None:
        self.system, self.components, self.announce = master.system, master.components, master.announce
        self.row, self.beside, self.signals = master.row, master.beside, master.values
        self.pulls = {stage.component.name: master.copying.of(stage.transfers) for stage in self.system.stages}
        self.held = master.copying.of(self.system.held)
        self.solver_of = {name: solver for solver in solvers for name in solver.names}
        signals, columns = self.system.signals, self.system.columns
        held = {t.target for t in self.system.held if not t.beside[1]}
        # real values that connections hold from one exchange to the next
        self.places = sorted(k for k in held if columns[k] not in signals or not signals[columns[k]].is_whole)

    def run(self) -> None:
        """Exchange values until they settle, then end initialization; raise SimulationError if a component fails."""
        is_solved = self._settle()
        before = self._values()
        for component in self.components:
            self.announce(component).start()
        for component in self.components:
            self.announce(component, GET).get()
        for _ in self.components:  # some FMUs (20-sim) have valid outputs only after initialization
            if self._values() == before:
                break
            before = self._values()
            self.sweep()
        if is_solved and self._grows():  # the loop also exists after initialization
            raise self._not_settled(self.system.columns[self.places[0]], 1)

    def _not_settled(self, name: str, count: int) -> SimulationError:
        return NotFinite(
            name,
            self.system.start,
            f"it still changes after {count} exchanges of values in initialization: it is part of an algebraic loop "
            "that these exchanges do not solve; put an FMU without direct feedthrough into the loop",
        )

    def _settle(self) -> bool:
        """Exchange values until they settle. If changes do not shrink, solve for them and return True."""
        earlier, period, first = math.inf, EXACT_SWEEPS + len(self.system.held), np.zeros(len(self.places))
        for sweep in range(1, LAST_SWEEP + 1):
            before, row = self._values(), list(self.row)
            try:
                self.sweep()
            except SimulationError as error:
                if sweep <= EXACT_SWEEPS or self.ends_run(error):
                    raise
                break  # the values of a loop grew with each exchange
            if sweep == 1:
                first = self.signals[self.places]
            if self._values() == before or (sweep > EXACT_SWEEPS and is_settled(row, self.row)):
                return False
            if sweep % period == 0:
                change = max((abs(a - b) for a, b in zip(self.row, row, strict=True)), default=0.0)
                if not change < SHRINKING_RATIO * earlier:
                    break
                earlier = change
        changed = (name for name, a, b in zip(self.system.columns, self.row, row, strict=True) if a != b)
        name = next(changed, "initialization")
        if not (self.places and self._solve(first)):
            raise self._not_settled(name, sweep)
        return True

    def _solve(self, start: Array) -> bool:
        """Solve for the held values, beginning at `start`; return True if there is a solution."""
        settings = self.system.solving or LoopSettings()
        roots = RootFinding(settings.tolerance, settings.iterations, np.ones(start.size), np.full(start.size, True))
        if start.size <= MOST_DIFFERENCES:
            outcome = roots.newton(self._exchanged, start, self._slopes)
        else:
            outcome = roots.anderson(self._exchanged, start)
        if outcome is None:
            return False
        is_finite = (np.abs(outcome.z) <= np.maximum(1.0, np.abs(start)) / settings.tolerance).all()
        return bool(outcome.converged and is_finite and self._exchanged(outcome.z) is not None)

    def _exchanged(self, z: Array) -> Array | None:
        """Return the held values after an exchange that begins with values z; None if a component refuses them."""
        self.signals[self.places] = z
        try:
            self.sweep()
        except SimulationError as error:
            if self.ends_run(error):
                raise
            return None
        return self.signals[self.places]

    def _slopes(self, z: Array, g: Array, *, fresh: bool = True) -> Array:
        """Return the Jacobian of an exchange by differences."""
        shifts = np.diag(SHIFT * np.maximum(1.0, np.abs(z)))
        moved = [self._exchanged(z + shift) for shift in shifts]
        columns = [np.zeros(z.size) if each is None else each - g for each in moved]
        return np.array(columns).T / np.diag(shifts)

    def _grows(self) -> bool:
        """Return True if deviations of held values grow with each exchange after initialization."""
        z = self.signals[self.places]
        g = self._exchanged(z)
        if g is None or z.size > MOST_DIFFERENCES:
            return False
        slopes = self._slopes(z, g)
        self._exchanged(z)
        return bool(np.max(np.abs(np.linalg.eigvals(slopes))) >= 1.0)

    def ends_run(self, error: SimulationError) -> bool:
        """Return True if an error during an exchange ends the run; False if a component only refuses values."""
        return isinstance(error, EarlyEnd) or any(map(is_lost, self.components))

    def sweep(self) -> None:
        """Exchange all values once."""
        for component in self.components:
            self.pulls[component.name](0)
            if (solver := self.solver_of.get(component.name)) is None:
                self.announce(component, PUT).put()
                self.announce(component, GET).get()
            elif component.name == solver.last:
                solver.solve_start()
        self.held(0)

    def _values(self) -> tuple[bytes, list[Any]]:
        return bytes(self.row), list(self.beside)


def is_settled(before: Iterable[float], after: Iterable[float]) -> bool:
    """Return True if all values equal those of the previous exchange, within rounding."""
    return all(abs(a - b) <= SETTLED_CHANGE * max(1.0, abs(b)) for a, b in zip(after, before, strict=True))
