"""What a kernel is: names, sizes and places; it filters a log and runs a model on a log's commands.

A kernel need not have been generated: whoever has a `Layout` and the two calls is one, a foreign FMU as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

from cosim.base.arrays import Array

DISTURBANCE = "disturbance."  # before the name of a forced state: the unknown input of its equation, a state of its own
CONSTANT = "constant."  # before the name of a parameter that is a state which never changes: the filter estimates it
MEMORY = "disturbance.time"  # the parameter that says how long it lasts [s]


@dataclass(frozen=True)
class Layout:
    """What stands where in the arrays of a kernel.

    parameters: names, in the order of `p`
    states:     names, in the order of `x`
    inputs:     names, in the order of `u`
    outputs:    names of the measured outputs, in the order of `y`
    stochastic: places of the states that process noise reaches and that reach a measured output
    noisy:      places, within `stochastic`, of the states that process noise enters: unknown inputs of equations
                where the kernel has them, else the forced states themselves
    memory:     number of remembered values
    delay:      place of the delay among the parameters, -1 where the model has none
    driven:     places of the states that process noise does not reach and that reach a measured output
    carrying:   places of the stochastic states that nothing random reaches but a parameter that is a constant state
    rates:      state → the state that is its derivative, where there is one
    """

    parameters: tuple[str, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    stochastic: tuple[int, ...]
    noisy: tuple[int, ...]
    memory: int = 0
    delay: int = -1
    driven: tuple[int, ...] = ()
    carrying: tuple[int, ...] = ()
    rates: Mapping[str, str] = field(default_factory=dict)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of the stochastic states."""
        return tuple(self.states[k] for k in self.stochastic)

    @property
    def noise_places(self) -> list[int]:
        """Places, among all states, of those that process noise enters."""
        return [self.stochastic[k] for k in self.noisy]

    @property
    def forced_places(self) -> list[int]:
        """Places, among all states, of those in whose equations something may be missing."""
        return [self.states.index(name) for name in self.forced]

    @property
    def forced(self) -> tuple[str, ...]:
        """Names of the states in whose equations something may be missing."""
        return tuple(self.states[k].removeprefix(DISTURBANCE) for k in self.noise_places)

    @cached_property
    def constants(self) -> Mapping[str, int]:
        """Parameters that are constant states → their places among all states."""
        return {n.removeprefix(CONSTANT): k for k, n in enumerate(self.states) if n.startswith(CONSTANT)}

    @property
    def coloured(self) -> bool:
        """Whether noise enters unknown inputs that last for a while."""
        return MEMORY in self.parameters


@dataclass(frozen=True)
class Data:
    """What the filter sees of a log: u (rows, inputs), y (rows, outputs) with NaN where missing.

    substeps: RK4 steps from row to row
    interpolated: names of inputs that run straight from row to row; the others are held
    late:     (rows, outputs) part of a row, −½ … ½, by which a reading is older than its row; None: by none
    settle:   rows after the first over which the covariance stays P0, for so long no state is known better
    table:    rows stand each for itself: none follows from the one before
    """

    step: float
    start: float
    u: Array
    y: Array
    substeps: int
    settle: int = 0
    interpolated: frozenset[str] = frozenset()
    late: Array | None = None
    table: bool = False

    def rows(self, first: int, end: int) -> Data:
        """The rows from `first` up to `end`, everything that goes by row with them."""
        kept = slice(first, end)
        late = None if self.late is None else self.late[kept]
        return replace(self, start=self.start + first * self.step, u=self.u[kept], y=self.y[kept], late=late)


@dataclass(frozen=True)
class Filtered:
    """errors and variances (rows, outputs) of each measurement before it is taken; states and memory after."""

    errors: Array
    variances: Array
    states: Array
    memory: Array


@dataclass(frozen=True)
class Simulated:
    """outputs (rows, outputs) free of noise, states and memory (rows, …); NaN before the first row."""

    outputs: Array
    states: Array
    memory: Array


class Kernel(Protocol):
    """What runs the filter over a log."""

    @property
    def layout(self) -> Layout:
        """Names, sizes and places."""

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log; q is per stochastic state, r per output, or per row and output.

        A run that diverges gives infinite errors.
        """

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Run on the commands of a log from row `first`, `kicks` (rows, states) added to the state at each row."""
