"""Powers of an FMU's parameters in the ratio of both ends' accelerations of a connection.

A force between two bodies accelerates each by the body's inertia. A fit that changes a mass changes the ratio.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.probing.exchange_points import CONSTANT, SMALL, Points, reactions
from cosim.probing.fmu_structure import Connection, ProbedParameter
from cosim.probing.log_runs import Course
from cosim.probing.parameter_trials import trial_values
from cosim.probing.prober import Prober

PLACES = 4  # points at which a ratio is measured


def with_powers(
    prober: Prober,
    course: Course,
    points: Points,
    connections: Iterable[Connection],
    parameters: Sequence[ProbedParameter],
) -> tuple[Connection, ...]:
    """Return connections with the powers of parameters in their ratios."""
    return tuple(replace(c, powers=_powers(prober, course, points, c, parameters)) for c in connections)


def _powers(
    prober: Prober, course: Course, points: Points, connection: Connection, parameters: Sequence[ProbedParameter]
) -> tuple[tuple[str, float, float], ...]:
    """Return parameters, their values and powers."""
    by_position = connection.stiffness != 0.0
    states = prober.fmu.names[0]
    ends = [states.index(p.position if by_position else p.velocity) for p in (connection.first, connection.second)]
    rates = [states.index(p.velocity) for p in (connection.first, connection.second)]
    places = _places(points, ends)

    def ratio(changed: dict[str, float]) -> float:
        """Return a multiple of the ratio, or NaN."""
        try:
            table: Array = prober.call(reactions, prober.with_values(changed), course, places)[1]
        except SimulationError:
            return math.nan
        sides = table.reshape(-1, 2, 2, table.shape[1])  # point, end that is displaced, ahead and behind
        one, other = (sides[:, k, 0, rates[1 - k]] - sides[:, k, 1, rates[1 - k]] for k in (1, 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.median(other / one))

    given, powers = ratio({}), []
    for p in parameters:
        value = float(prober.values.get(p.name, p.quantity.start))
        for tried in trial_values(value, p.quantity.bounds)[:1] if p.acts and not p.failure and value else ():
            change = ratio({p.name: tried}) / given
            power = math.log(change) / math.log(tried / value) if change > 0.0 and tried / value > 0.0 else 0.0
            if abs(power) > CONSTANT:
                powers.append((p.name, value, power))
    return tuple(powers)


def _places(points: Points, ends: Sequence[int]) -> list[tuple[float, Array, Array]]:
    """Return points with each of two states displaced, ahead and behind."""
    places = []
    for t, x, u in points.places[:: max(1, -(-len(points.places) // PLACES))]:
        for k in ends:
            for sign in (1.0, -1.0):
                moved = x.copy()
                moved[k] += sign * SMALL * points.scale[k]
                places.append((t, moved, u))
    return places
