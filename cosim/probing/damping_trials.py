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
    index: int
    speed: float
    slopes: Mapping[str, Array]
    places: list[tuple[float, Array, Array]]


@dataclass(frozen=True, eq=False)
class _Change:
    """A change of a parameter, and the columns of the reactions: states with their rates, and sizes of all."""

    parameter: str
    change: float
    sizes: Array
    states: Sequence[str]


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
    react = _Reactions(prober, course, trials)
    base, found = react({}), dict[str, Damping]()
    for parameter in able:
        value = float(prober.values.get(parameter.name, parameter.quantity.start))
        by = _Change(parameter.name, _change_of(parameter, value), points.size, states)
        with suppress(SimulationError):
            for damping in _of_parameter(react, base, value, by):
                found.setdefault(damping.pair.velocity, damping)
    return tuple(found.values())


@dataclass(frozen=True)
class _Reactions:
    """Reactions of the FMU at the places of all trials."""

    prober: Prober
    course: Course
    trials: Sequence[_Trial]

    def __call__(self, values: Mapping[str, float]) -> Array:
        """Return the reactions with parameter values, shape (trials, points, 4, columns)."""
        places = [place for trial in self.trials for place in trial.places]
        table: Array = self.prober.call(reactions, self.prober.with_values(values), self.course, places)[1]
        return table.reshape(len(self.trials), -1, 4, table.shape[1])


def _of_parameter(react: _Reactions, base: Array, value: float, by: _Change) -> list[Damping]:
    """Return the dampings that a parameter is; none without a change that its bounds allow.

    Args:
        base: Reactions with the given value.
    """

    def judged(once: Array, twice: Array) -> list[Damping]:
        return [*filter(None, (_damping(*each, by) for each in zip(once, twice, react.trials, strict=True)))]

    if not by.change:
        return []
    once = react({by.parameter: value + by.change}) - base
    if not judged(once, 2.0 * once):
        return []
    return judged(once, react({by.parameter: value + 2.0 * by.change}) - base)


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
    return _Trial(pair, index, speed, acting, places)


def _change_of(parameter: ProbedParameter, value: float) -> float:
    """Return the change to try; 0 if the bounds allow none."""
    low, high = parameter.quantity.bounds
    size = abs(value) or abs(parameter.tried)
    return next((c * size for c in CHANGES if low <= value + 2.0 * c * size <= high), 0.0)


def _damping(once: Array, twice: Array, trial: _Trial, by: _Change) -> Damping | None:
    """Return the damping from changes of the reactions; None if they are those of something else.

    Args:
        once, twice: Changes of rates and outputs by the change of the parameter and by twice this change, shape
            (points, 4, columns).
    """
    usable = np.isfinite(once).all(axis=(1, 2)) & np.isfinite(twice).all(axis=(1, 2))
    once, twice = once[usable], twice[usable]
    if not len(once):
        return None
    usual, noise, force = once[:, 1], SAME * by.sizes, -by.change * trial.speed
    near = noise + NEARLY * np.abs(usual).max(axis=0)
    equal = (once[:, 0], 0.0), (once[:, 2], 2.0 * usual), (once[:, 3], usual), (twice[:, 1], 2.0 * usual)
    if any((np.abs(one - other) > near).any() for one, other in equal):
        return None
    affected, own = np.flatnonzero((np.abs(usual) > noise).any(axis=0)), usual[:, trial.index] / force
    if affected.max(initial=-1) >= len(by.states) or (own * abs(force) <= noise[trial.index]).any():
        return None
    gain, rates = float(np.median(own)), tuple(by.states[k] for k in affected.tolist())
    is_constant = len(rates) == 1 and bool(np.ptp(own) <= CONSTANT * gain)
    direction = usual[:, : len(by.states)] / force
    port = next((u for u, slopes in trial.slopes.items() if _are_parallel(slopes[usable], direction)), "")
    return Damping(trial.pair, by.parameter, gain, rates, is_constant, port, by.change, trial.speed)


def _are_parallel(slopes: Array, direction: Array) -> bool:
    """Return True if slopes by an input are a constant multiple of a direction, both of shape (points, states)."""
    factor = float((slopes * direction).sum() / (direction**2).sum())
    return bool(np.abs(slopes - factor * direction).max() <= CONSTANT * np.abs(slopes).max())
