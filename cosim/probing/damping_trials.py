"""Settable parameters of an FMU for model exchange that brake a coordinate; they tell how any force there acts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.probing.exchange_points import CONSTANT, LARGE, PLACES, Points, reactions
from cosim.probing.fmu_structure import Damping, Pair, ProbedParameter
from cosim.probing.log_runs import SAME, Course
from cosim.probing.prober import Prober

NEARLY = 1e-6  # relative difference up to which a change is proportional to velocity and parameter
# Changes of a parameter as multiples of its size; the first is taken that the bounds allow twice.
CHANGES = (1.0, 0.1, -0.25)


@dataclass(frozen=True, eq=False)
class _Trial:
    """Points about which one velocity moves, with reactions of the FMU as it is.

    Attributes:
        index: Index of the velocity.
        speed: Usual speed V.
        slopes: Input → rates per input, shape (points, states), of the inputs that act on the velocity.
        places: At each point with the velocity 0, V, 2·V, and V while other velocities and the inputs are elsewhere.
    """

    pair: Pair
    states: Sequence[str]
    index: int
    speed: float
    slopes: Mapping[str, Array]
    places: list[tuple[float, Array, Array]]


def dampings(
    prober: Prober, course: Course, points: Points, pairs: Sequence[Pair], parameters: Sequence[ProbedParameter]
) -> tuple[Damping, ...]:
    """Return the settable damping of each pair on which no input acts alone.

    With another value of it, the rates change in proportion to this velocity and to the change of the parameter,
    whatever the other velocities and the inputs are, and no output changes directly.
    """
    states, inputs, _ = prober.fmu.names
    velocities = [states.index(p.velocity) for p in pairs]
    shared = (p for p in pairs if not any(port.is_alone for port in p.ports))
    trials = [*filter(None, (_trial_of(p, (states, inputs), velocities, points) for p in shared))]
    able = [p for p in parameters if p.acts and not p.starts and not p.failure]
    if not trials or not able:
        return ()
    places = [place for trial in trials for place in trial.places]

    def react(values: Mapping[str, float]) -> Array:
        """Return the reactions with parameter values, shape (trials, points, 4, columns)."""
        table: Array = prober.call(reactions, prober.with_values(values), course, places)[1]
        return table.reshape(len(trials), -1, 4, table.shape[1])

    base, found = react({}), dict[str, Damping]()
    for parameter in able:
        name, (low, high) = parameter.name, parameter.quantity.bounds
        value = float(prober.values.get(name, parameter.quantity.start))
        size = abs(value) or abs(parameter.tried)
        change = next((c * size for c in CHANGES if low <= value + 2.0 * c * size <= high), 0.0)
        if not change:  # the bounds allow none
            continue
        with suppress(SimulationError):
            once = react({name: value + change}) - base
            likely = [_damping(o, 2.0 * o, trial, name, change, points) for o, trial in zip(once, trials, strict=True)]
            if not any(likely):
                continue
            twice = react({name: value + 2.0 * change}) - base
            for o, t, trial in zip(once, twice, trials, strict=True):
                if (damping := _damping(o, t, trial, name, change, points)) is not None:
                    found.setdefault(damping.pair.velocity, damping)
    return tuple(found.values())


def _trial_of(
    pair: Pair, names: tuple[Sequence[str], Sequence[str]], velocities: Sequence[int], points: Points
) -> _Trial | None:
    """Return the points of a pair; None if its velocity may not have both speeds and 0.

    Args:
        names: Names of the states, and of the inputs.
        velocities: Indices of all velocities.
    """
    states, inputs = names
    n, index = len(states), states.index(pair.velocity)
    speed, every = float(points.scale[index]), points.spacing(PLACES)
    if not points.low[index] <= 0.0 < 2.0 * speed <= points.high[index]:
        return None
    elsewhere, places = [*(k for k in velocities if k != index), *range(n, n + len(inputs))], []
    for t, x, u in points.places[::every]:
        for multiple in (0.0, 1.0, 2.0):
            moved = x.copy()
            moved[index] = multiple * speed
            places.append((t, moved, u))
        z, rng = np.concatenate([x, u]), np.random.default_rng(len(places))
        z[elsewhere] += LARGE * points.scale[elsewhere] * rng.uniform(-1.0, 1.0, len(elsewhere))
        z[index] = speed
        z = np.clip(z, points.low, points.high)
        places.append((t, z[:n], z[n:]))
    slopes = np.array(points.slopes[::every])
    acting = {port.input: slopes[:, :n, n + inputs.index(port.input)] for port in pair.ports}
    return _Trial(pair, states, index, speed, acting, places)


def _damping(once: Array, twice: Array, trial: _Trial, parameter: str, change: float, points: Points) -> Damping | None:
    """Return the damping from changes of the reactions; None if they are those of something else.

    Args:
        once, twice: Changes of rates and outputs by the change of the parameter and by twice this change, shape
            (points, 4, columns).
    """
    usable = np.isfinite(once).all(axis=(1, 2)) & np.isfinite(twice).all(axis=(1, 2))
    once, twice = once[usable], twice[usable]
    if not len(once):
        return None
    usual, noise, force = once[:, 1], SAME * points.size, -change * trial.speed
    near = noise + NEARLY * np.abs(usual).max(axis=0)
    equal = (once[:, 0], 0.0), (once[:, 2], 2.0 * usual), (once[:, 3], usual), (twice[:, 1], 2.0 * usual)
    if any((np.abs(one - other) > near).any() for one, other in equal):
        return None
    affected, own = np.flatnonzero((np.abs(usual) > noise).any(axis=0)), usual[:, trial.index] / force
    if affected.max(initial=-1) >= len(trial.states) or (own * abs(force) <= noise[trial.index]).any():
        return None
    gain, rates = float(np.median(own)), tuple(trial.states[k] for k in affected.tolist())
    is_constant = len(rates) == 1 and bool(np.ptp(own) <= CONSTANT * gain)
    direction = usual[:, : len(trial.states)] / force
    port = ""
    for name, slopes in trial.slopes.items():  # an input whose slopes are a constant multiple of the direction
        along = slopes[usable]
        factor = float((along * direction).sum() / (direction**2).sum())
        if np.abs(along - factor * direction).max() <= CONSTANT * np.abs(along).max():
            port = name
            break
    return Damping(trial.pair, parameter, gain, rates, is_constant, port, change, trial.speed)
