"""Parameters of an FMU for model exchange that tell how forces act.

A settable parameter that brakes a coordinate tells how any force there acts. A force between two bodies accelerates
each by the body's inertia, so a fit that changes a mass changes the ratio of both accelerations. Most inertias are
products or sums of parameters: two trials of each parameter tell a power from a sum.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.probing.exchange_points import CONSTANT, LARGE, PLACES, SMALL, Points, reactions
from cosim.probing.fmu_structure import Connection, Damping, Pair, ProbedParameter
from cosim.probing.log_runs import SAME, Course
from cosim.probing.prober import Prober
from cosim.terms.language import RatioFactor

NEARLY = 1e-6  # relative difference up to which a change is proportional to velocity and parameter
# Changes of a parameter as multiples of its size; the first is taken that the bounds allow twice.
CHANGES = (1.0, 0.1, -0.25)
RATIO_PLACES = 4  # points at which ratios are measured


def dampings(
    prober: Prober,
    course: Course,
    points: Points,
    pairs: Sequence[Pair],
    parameters: Sequence[ProbedParameter],
    in_step: bool,
) -> tuple[Damping, ...]:
    """Return the settable damping of each pair on which no input acts alone.

    With another value of it, the rates change in proportion to this velocity and to the change of the parameter,
    whatever the other velocities and the inputs are, and no output changes directly.
    """
    states, inputs, _ = prober.fmu.names
    n, every = len(states), points.spacing(PLACES)
    velocities = [states.index(p.velocity) for p in pairs]
    trials, places = list[Pair](), list[tuple[float, Array, Array]]()
    for pair, index in zip(pairs, velocities, strict=True):
        speed = float(points.scale[index])
        fits = points.low[index] <= 0.0 < 2.0 * speed <= points.high[index]
        if not fits or any(port.is_alone for port in pair.ports):
            continue
        elsewhere = [*(k for k in velocities if k != index), *range(n, n + len(inputs))]
        # each point with the velocity 0, V, 2·V, and V while other velocities and the inputs are elsewhere
        for number, (t, x, u) in enumerate(points.places[::every]):
            places += [(t, np.where(np.arange(n) == index, k * speed, x), u) for k in (0.0, 1.0, 2.0)]
            z, rng = np.concatenate([x, u]), np.random.default_rng(4 * number + 3)
            z[elsewhere] += LARGE * points.scale[elsewhere] * rng.uniform(-1.0, 1.0, len(elsewhere))
            z[index] = speed
            z = np.clip(z, points.low, points.high)
            places.append((t, z[:n], z[n:]))
        trials.append(pair)
    able = [p for p in parameters if p.acts and not p.starts and not p.failure]
    if not trials or not able:
        return ()

    def react(values: Mapping[str, float]) -> Array:
        """Return the reactions with parameter values, shape (trials, points, 4, columns)."""
        table: Array = prober.call(reactions, prober.with_values(values), course, places)[1]
        return table.reshape(len(trials), -1, 4, table.shape[1])

    slopes = np.array(points.slopes[::every])[:, :n, n:]

    base, found = react({}), dict[str, Damping]()
    for parameter in able:
        name, value, (low, high) = parameter.name, parameter.quantity.start, parameter.quantity.bounds
        size = abs(value) or abs(parameter.tried)
        change = next((c * size for c in CHANGES if low <= value + 2.0 * c * size <= high), 0.0)
        if not change:  # the bounds allow none
            continue
        try:  # changes of rates and outputs by the change of the parameter and by twice this change
            both = [react({name: value + share * change}) - base for share in (1.0, 2.0)]
        except SimulationError:
            continue
        for pair, once, twice in zip(trials, *both, strict=True):
            usable = np.isfinite(once).all(axis=(1, 2)) & np.isfinite(twice).all(axis=(1, 2))
            once, twice, along = once[usable], twice[usable], slopes[usable]
            index, usual = states.index(pair.velocity), once[:, 1]
            speed = float(points.scale[index])
            noise, force = SAME * points.size, -change * speed
            near = noise + NEARLY * np.abs(usual).max(axis=0, initial=0.0)
            equal = (once[:, 0], 0.0), (once[:, 2], 2.0 * usual), (once[:, 3], usual), (twice[:, 1], 2.0 * usual)
            affected, own = np.flatnonzero((np.abs(usual) > noise).any(axis=0)), usual[:, index] / force
            is_damping = len(own) and affected.max(initial=-1) < n and (own * abs(force) > noise[index]).all()
            if not is_damping or any((np.abs(one - other) > near).any() for one, other in equal):
                continue  # the changes are those of something else
            gain, rates, direction = float(np.median(own)), [states[k] for k in affected], usual[:, :n] / force
            is_constant = len(rates) == 1 and bool(np.ptp(own) <= CONSTANT * gain)
            port = ""
            for entry in pair.ports:
                # slopes that are a constant multiple of the direction
                of_input = along[:, :, inputs.index(entry.input)]
                factor = float((of_input * direction).sum() / (direction**2).sum())
                if np.abs(of_input - factor * direction).max() <= CONSTANT * np.abs(of_input).max():
                    port = entry.input
                    break
            damping = Damping(pair, name, gain, tuple(rates), is_constant, port, change, speed, in_step)
            found.setdefault(pair.velocity, damping)
    return tuple(found.values())


# -- ratios ---------------------------------------------------------------------------------------


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
        for t, x, u in points.places[:: points.spacing(RATIO_PLACES)]
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
            value, (low, high) = p.quantity.start, p.quantity.bounds
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
