"""Kernel interface: layout, filter and simulation of a log.

A kernel need not be generated: any object with the methods of `Kernel` can be used, also a foreign FMU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from cosim.core.arrays import Array, NamedValues

DISTURBANCE = "disturbance."  # prefix of a forced state's unknown input, a state of its own
CONSTANT_PREFIX = "constant."  # prefix of a parameter as constant state, for the filter to estimate
DEVIATION = "deviation."  # prefix of the deviation of a free run's output, which unknown inputs drive
EARLIER = "earlier."  # prefix of the deviation in the row before, which stands for hidden states
START_PREFIX = "start."  # prefix of a start value of an FMU for co-simulation, a constant state
CORRELATION_TIME = "disturbance.time"  # parameter with the correlation time of unknown inputs [s]


@dataclass(frozen=True)
class Layout:
    """Layout of a kernel's arrays.

    Attributes:
        parameters: Names in the order of `p`.
        states: Names in the order of `x`.
        inputs: Names in the order of `u`.
        outputs: Names of the measured outputs in the order of `y`.
        stochastic: Indices of states that process noise reaches and that influence a measured output.
        noisy: Indices within `stochastic` of the unknown inputs.
        memory: Number of values in the memory of effects.
        delay: Index of the delay parameter, −1 without delay.
        driven: Indices of states that the noise does not reach but that influence a measured output.
        carrying: Indices of stochastic states whose only random source is a constant state.
        rates: State → state that equals its derivative.
        is_free_run: True if unknown inputs drive deviations of the outputs of a free run.
        along: Parameter → neutral value, for terms of a free run that depend on a position or level.
        positions: Indices of the measured outputs for these positions and levels.
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
    is_free_run: bool = False
    along: NamedValues = field(default_factory=dict)
    positions: tuple[int, ...] = ()

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Return the names of the stochastic states."""
        return tuple(self.states[k] for k in self.stochastic)

    @property
    def noise_places(self) -> list[int]:
        """Return the indices of the states with process noise."""
        return [self.stochastic[k] for k in self.noisy]

    @property
    def start_places(self) -> list[int]:
        """Return the indices of the start states of a free run."""
        return [k for k, name in enumerate(self.states) if name.startswith(START_PREFIX)]

    @property
    def forced_places(self) -> list[int]:
        """Return the indices of the states with forced equations."""
        return [self.states.index(name) for name in self.forced]

    @property
    def forced(self) -> tuple[str, ...]:
        """Return the names of the states with forced equations, whose process noise represents missing effects."""
        return tuple(self.states[k].removeprefix(DISTURBANCE) for k in self.noise_places)

    @cached_property
    def constants(self) -> Mapping[str, int]:
        """Return parameter → index of its constant state."""
        return {n.removeprefix(CONSTANT_PREFIX): k for k, n in enumerate(self.states) if n.startswith(CONSTANT_PREFIX)}


@dataclass(frozen=True)
class Data:
    """A log as input of the filter.

    Attributes:
        u: Inputs, shape (rows, inputs).
        y: Measurements, shape (rows, outputs), NaN if missing.
        substeps: Number of RK4 steps from row to row.
        interpolated: True for inputs to interpolate between rows; the other inputs are held.
        late: Age of each reading relative to its row, −½ … ½ rows, shape (rows, outputs); None if all are 0.
        lags: Time constant of each output's sensor in rows, shape (outputs,); None without lags.
        settle: Number of rows after the first one in which the covariance is kept at P0 while states settle.
    """

    step: float
    start: float
    u: Array
    y: Array
    substeps: int
    settle: int = 0
    interpolated: frozenset[str] = frozenset()
    late: Array | None = None
    lags: Array | None = None

    @property
    def times(self) -> Array:
        """Return the time of each row [s]."""
        return self.start + self.step * np.arange(len(self.u), dtype=np.float64)

    def rows(self, first: int, end: int) -> Data:
        """Return the part of the log from row `first` to before row `end`."""
        rows = slice(first, end)
        late = None if self.late is None else self.late[rows]
        return replace(self, start=self.start + first * self.step, u=self.u[rows], y=self.y[rows], late=late)


@dataclass(frozen=True)
class Filtered:
    """Innovations and their variances (rows, outputs) before each measurement update; states and memory after it.

    Attributes:
        covariances: Covariance of the stochastic states after each update; None if the kernel has no covariance.
    """

    errors: Array
    variances: Array
    states: Array
    memory: Array
    covariances: Array | None = None


@dataclass(frozen=True)
class Simulated:
    """Noise-free simulation: outputs (rows, outputs), states and memory (rows, …); NaN before row `first`."""

    outputs: Array
    states: Array
    memory: Array


def no_filtered(layout: Layout, data: Data, *, states: bool = False) -> Filtered:
    """Return the result of a filter that diverges at its first row."""
    rows, random = len(data.y) if states else 0, len(layout.stochastic)
    shapes: list[tuple[int, ...]] = [(rows, len(layout.states)), (rows, layout.memory), (rows, random, random)]
    return Filtered(np.full(data.y.shape, np.inf), np.ones(data.y.shape), *(np.full(s, np.nan) for s in shapes))


def no_simulated(layout: Layout, data: Data) -> Simulated:
    """Return the result of a simulation that diverges at its first row."""
    counts = len(layout.outputs), len(layout.states), layout.memory
    return Simulated(*(np.full((len(data.u), count), np.nan) for count in counts))


class Kernel(Protocol):
    """Interface of objects that filter and simulate a log."""

    @property
    def layout(self) -> Layout:
        """Return the layout of the arrays."""

    def run(self, data: Data, p: Array, x0: Array, P0: Array, q: Array, r: Array, *, states: bool = False) -> Filtered:
        """Filter one log. If the filter diverges, the innovations are infinite.

        Args:
            p: Parameter values.
            x0: Initial state.
            P0: Initial covariance.
            q: Process noise density of each stochastic state [unit²/s].
            r: Measurement noise variance of each output, or of each row and output.
        """

    def simulate(
        self, data: Data, p: Array, x0: Array, memory: Array, kicks: Array | None = None, *, first: int = 0
    ) -> Simulated:
        """Simulate with the commands of a log from row `first`.

        Args:
            kicks: Increments added to the state at each row, shape (rows, states).
        """


Inputs = tuple[Data, Array, Array, Array, Array, Array]  # arguments of `Kernel.run`
Begin = tuple[Data, Array, Array, Array, "Array | None", int]  # arguments of `Kernel.simulate`; the last one is `first`


def filter_all(kernel: Kernel, inputs: Sequence[Inputs]) -> Sequence[Filtered]:
    """Filter several logs, in one call if the kernel supports this."""
    together: Any = getattr(kernel, "call_all", None)
    return together("run", inputs) if together else [kernel.run(*each) for each in inputs]


def simulate_all(kernel: Kernel, begins: Sequence[Begin]) -> Sequence[Simulated]:
    """Make several simulations, in one call if the kernel supports this."""
    together: Any = getattr(kernel, "call_all", None)
    return together("simulate", begins) if together else [kernel.simulate(*b[:-1], first=b[-1]) for b in begins]
