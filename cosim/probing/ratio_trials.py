"""How an FMU's parameters change the ratio of both ends' accelerations of a connection.

A force between two bodies accelerates each by the body's inertia. A fit that changes a mass changes the ratio. Most
inertias are products or sums of parameters: two trials of each parameter tell a power from a sum.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.probing.exchange_points import CONSTANT, SMALL, Points, reactions
from cosim.probing.fmu_structure import Connection, ProbedParameter
from cosim.probing.log_runs import Course
from cosim.probing.prober import Prober
from cosim.terms.language import RatioFactor

PLACES = 4  # points at which ratios are measured


def with_factors(
    prober: Prober,
    course: Course,
    points: Points,
    connections: Sequence[Connection],
    parameters: Sequence[ProbedParameter],
) -> tuple[Connection, ...]:
    """Return connections with the factors of parameters in their ratios."""
    if not connections:
        return ()
    states = prober.fmu.names[0]
    pairs = [(c.first, c.second) for c in connections]
    velocities = [[states.index(p.velocity) for p in both] for both in pairs]
    displaced = [states.index(name) for both in pairs for p in both for name in (p.position, p.velocity)]
    places = [
        (t, points.moved(np.concatenate([x, u]), k, by)[: x.size], u)
        for t, x, u in points.places[:: points.spacing(PLACES)]
        for k in displaced
        for by in (SMALL, -SMALL)
    ]

    def ratios(changed: dict[str, float]) -> Array:
        """Return the ratios from positions and from velocities with other parameters, times a constant.

        Returns:
            Array of shape (connections, points, 2), NaN without an answer of an end.
        """
        table: Array = prober.call(reactions, prober.with_values(changed), course, places)[1]
        # point, connection, end that is displaced, position or velocity, ahead or behind, rate
        sides = table.reshape(-1, len(pairs), 2, 2, 2, table.shape[1])
        found = np.full((len(pairs), len(sides), 2), np.nan)
        for c, (first, second) in enumerate(velocities):
            answers = sides[:, c, :, :, 0] - sides[:, c, :, :, 1]
            one, other = answers[:, 1, :, first], answers[:, 0, :, second]
            both = (one > 0.0) & (other > 0.0)
            found[c][both] = other[both] / one[both]
        return found

    begin = time.monotonic()
    given = ratios({})
    found: list[list[RatioFactor]] = [[] for _ in connections]
    with prober.hurry(time.monotonic() - begin):
        for p in parameters:
            value = float(prober.values.get(p.name, p.quantity.start))
            low, high = p.quantity.bounds
            tried = p.tried, value + 2.0 * (p.tried - value)
            if not p.acts or p.tried == value:
                continue
            changes = np.full((2, len(pairs)), np.nan)
            for row, v in zip(changes, tried, strict=True):
                if low <= v <= high:
                    with suppress(SimulationError):  # the FMU refuses the value
                        for c, change in enumerate(ratios({p.name: v}) / given):
                            row[c] = np.nanmedian(change) if np.isfinite(change).any() else np.nan
            for factors, of_ratio in zip(found, changes.T.tolist(), strict=True):
                factors += _factor(p.name, value, tried, of_ratio)
    return tuple(replace(c, factors=tuple(factors)) for c, factors in zip(connections, found, strict=True))


def _factor(name: str, value: float, tried: Sequence[float], changes: Sequence[float]) -> Iterator[RatioFactor]:
    """Yield the factor of a parameter, if it changes a ratio.

    Args:
        tried: Two values of the parameter.
        changes: Ratio with each tried value over the given one; NaN if refused.
    """
    once, twice = changes
    if not (once > 0.0 and abs(math.log(once)) > CONSTANT):
        return
    factors = []
    if value and tried[0] / value > 0.0:
        power = math.log(once) / math.log(tried[0] / value)
        half = round(2.0 * power) / 2.0
        factors.append(RatioFactor(name, value, 0.0, half if abs(half - power) < CONSTANT else power))
    for power in (1.0, -1.0):  # of a sum, in which others stand beside it
        times = once**power
        factors.append(RatioFactor(name, value, (tried[0] - times * value) / (times - 1.0), power))
    able = [f for f in factors if f.shift + value != 0.0 and (f.shift + tried[1]) / (f.shift + value) > 0.0]
    if math.isfinite(twice):
        able.sort(key=lambda f: max(CONSTANT, abs(math.log(f.at(tried[1]) / twice))))
    yield from able[:1]
