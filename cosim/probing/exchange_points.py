"""Dependencies, slopes and equalities of an FMU for model exchange, from displaced points of its simulations.

Runs in the worker process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cosim.blocks.derivatives import DifferentiableFmu
from cosim.core.arrays import Array, Flags
from cosim.core.errors import SimulationError
from cosim.fmi.description import reals, scalars
from cosim.probing.log_runs import SAME, Course, Fmu, Run, simulate

POINTS = 40  # points over all logs
PLACES = 12  # points at which parameters are tried
CONSTANT = 1e-3  # relative change over the points, up to which a ratio is one of inertias, and a direction constant
SMALL, LARGE = 1e-4, 0.5  # displacements relative to the spread
STARTS = 6  # displaced starts to find the states that outputs show


@dataclass(eq=False)
class Points:
    """Evaluations of an FMU at points of its simulations.

    Attributes:
        scale: Displacement unit of each state and input.
        size: Magnitude of each rate and output, for comparisons.
        depends: Whether a rate or output (row) changes with a state or input (column).
        low, high: Limits of states and inputs, which no displacement exceeds.
        slopes: Slopes at each point.
        places: Time, states and inputs of each point.
        known, values: States with inputs, and rates with outputs, of all points and of points displaced at random.
    """

    scale: Array
    size: Array
    depends: Flags
    low: Array
    high: Array
    slopes: list[Array] = field(default_factory=list)
    places: list[tuple[float, Array, Array]] = field(default_factory=list)
    known: list[Array] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def add(self, block: DifferentiableFmu, t: float, x: Array, u: Array) -> None:
        """Evaluate the FMU about a point; the caller restores the point."""
        n, z = x.size, np.concatenate([x, u])

        def at(z: Array) -> Array:
            return _safe_rates(block, z[:n], z[n:])

        value = at(z)
        slopes = np.zeros((value.size, z.size))
        for k in range(z.size):
            ahead, behind, up, down = (self.moved(z, k, s) for s in (SMALL, -SMALL, LARGE, -LARGE))
            rates = at(ahead)
            slopes[:, k] = (rates - at(behind)) / ((ahead[k] - behind[k]) or np.nan)
            for other in (rates, at(up), at(down)):
                self.depends[:, k] |= np.nan_to_num(np.abs(other - value)) > SAME * self.size
        rng = np.random.default_rng(len(self.places))
        displaced = self._inside(z + LARGE * self.scale * rng.uniform(-1.0, 1.0, z.size), z)
        self.known += [z, displaced]
        self.values += [value, at(displaced)]
        self.slopes.append(slopes)
        self.places.append((t, x, u))

    def moved(self, z: Array, k: int, by: float) -> Array:
        """Return a point with one state or input displaced.

        Args:
            by: Displacement in units of `scale`.
        """
        moved = z.copy()
        moved[k] += by * self.scale[k]
        return self._inside(moved, z)

    def spacing(self, count: int) -> int:
        """Return the spacing of at most so many evenly spread places."""
        return max(1, -(-len(self.places) // count))

    def _inside(self, moved: Array, z: Array) -> Array:
        """Return a displaced point within the limits, or no further outside than the point itself."""
        return np.clip(moved, np.minimum(self.low, z), np.maximum(self.high, z))


def _safe_rates(block: DifferentiableFmu, x: Array, u: Array, t: float | None = None) -> Array:
    """Return rates and outputs, at another time if given; NaN where the FMU refuses the point."""
    try:
        return block.rates(x if t is None else block.move(t, x, u), u)
    except SimulationError:
        return np.full(block.order + len(scalars(reals(block.description, "output"))), np.nan)


# -- jobs of the worker -----------------------------------------------------------------------


def start_point(fmu: Fmu, course: Course) -> tuple[Array, Array, dict[int, int]]:
    """Return states and outputs of the FMU after its initialization, and state → output that equals it.

    The equalities are those at points displaced about the start.
    """
    with fmu.opened(course) as (block, _):
        block.start()
        x, u = block.current_point()
        start = block.rates(x, u)[x.size :]
        rng, known, values = np.random.default_rng(1), [], []
        for _ in range(STARTS):
            z = x + 0.1 * np.where(x == 0.0, 1.0, np.abs(x)) * rng.uniform(-1.0, 1.0, x.size)
            known.append(z)
            values.append(_safe_rates(block, z, u))
    table = np.array(values)
    finite = np.isfinite(table).all(axis=1)
    return x, start, equal_columns(np.array(known)[finite], table[finite][:, x.size :])


def equal_columns(known: Array, values: Array) -> dict[int, int]:
    """Return for each column of `known` the first column of `values` with the same numbers."""
    equal = {}
    for k, column in enumerate(known.T if len(known) > 1 else ()):
        for j, other in enumerate(values.T):
            if np.abs(other - column).max() <= SAME * np.abs(column).max() and np.ptp(column) > 0.0:
                equal[k] = j
                break
    return equal


def evaluated(fmu: Fmu, course: Course, rows: Sequence[int], points: Points, run: Run | None) -> Points:
    """Return points with evaluations at rows.

    Args:
        run: The simulation, so that the FMU is moved to its points; None to simulate again, as events demand.
    """
    if run is None:
        simulate(fmu, course, points.add, rows)
        return points
    with fmu.opened(course) as (block, _):
        block.start()
        for k in rows:
            x = block.move(float(run.time[k]), run.states[k], run.inputs[k])
            points.add(block, float(run.time[k]), x, run.inputs[k])
    return points


def reactions(fmu: Fmu, course: Course, places: Sequence[tuple[float, Array, Array]]) -> tuple[Array, Array]:
    """Return the states after initialization, and rates with outputs at points, NaN where the FMU refuses."""
    with fmu.opened(course) as (block, _):
        block.start()
        states, _ = block.current_point()
        return states, np.array([_safe_rates(block, x, u, t) for t, x, u in places])
