"""Structure of an FMU for model exchange, from simulations along logs and evaluations near their points."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations

import numpy as np

from cosim.blocks.derivatives import DifferentiableFmu
from cosim.core.arrays import Array, Flags, NamedValues
from cosim.core.errors import FmuError, InputError, SimulationError
from cosim.fmi.description import reals, scalars, states_of
from cosim.probing.fmu_structure import Connection, Damping, Pair, Port, ProbedParameter, Structure
from cosim.probing.prober import (
    SAME,
    Course,
    Fmu,
    Prober,
    Run,
    nominal_of,
    quantities,
    separate_pairs,
    simulate,
    tried_parameters,
)
from cosim.terms.language import RatioFactor

CONSTANT_DISPLACEMENT = 1e-2  # share of a value by which a constant state or input is displaced


def exchange_structure(prober: Prober, courses: Sequence[Course]) -> Structure:
    """Return the structure of an FMU for model exchange.

    Raises:
        InputError: The FMU does not declare its states.
        SimulationError: The FMU fails at its start.
    """
    if len(states_of(prober.description)) != len(prober.description.derivatives):
        raise InputError.at(
            prober.path,
            "modelDescription.xml does not name the state of each derivative (attribute `derivative`); use the "
            "co-simulation interface, or export the FMU with this attribute",
            FmuError.exit_code,
        )
    names = states, inputs, outputs = prober.fmu.names
    first_states, first_outputs, shown = prober.call(start_point, prober.fmu, courses[0])
    courses = [course.begun(shown, outputs) for course in courses]
    runs: list[Run] = [prober.call(simulate, prober.fmu, course) for course in courses]
    if not any(run.time.size for run in runs):
        raise runs[0].stop or prober.fmu.too_short(courses[0])
    points, scales = _points(prober, courses, runs)
    known, table = np.array(points.known), np.array(points.values)
    finite = np.isfinite(table).all(axis=1)
    known, table = known[finite], table[finite]
    n = len(states)
    found = equal_columns(known[:, :n], table[:, n:])
    depends = points.depends
    pairs = _pairs(names, known, table, points)
    has_events = any(run.events.total for run in runs)
    places = points.places[:: points.spacing(PARAMETER_POINTS)]
    parameters = tried_parameters(prober, lambda fmu: prober.call(reactions, fmu, courses[0], places), points.size)
    is_single = prober.description.modelExchange.canBeInstantiatedOnlyOncePerProcess
    # states outside pairs whose derivative depends on an input or another state
    paired = {name for pair in pairs for name in (pair.position, pair.velocity)}
    storages = [name for k, name in enumerate(states) if name not in paired and np.delete(depends[k], k).any()]
    matrices = [s[:n, :n] for s in points.slopes if n and np.isfinite(s[:n, :n]).all()]
    return Structure(
        fmu=prober.path,
        way="model-exchange",
        states=quantities(prober.description, states, first_states),
        inputs=quantities(prober.description, inputs),
        outputs=quantities(prober.description, outputs, first_outputs),
        depends=depends,
        pairs=pairs,
        connections=with_factors(prober, courses[0], points, [*_connections(states, pairs, points, runs)], parameters),
        storages=tuple(storages),
        shown={states[k]: outputs[j] for k, j in found.items()},
        largest_rate=max((float(np.abs(np.linalg.eigvals(m)).max()) for m in matrices), default=0.0),
        scales=scales,
        step=min(course.step for course in courses),
        events=tuple(run.events for run in runs),
        parameters=parameters,
        dampings=dampings(prober, courses[0], points, pairs, parameters, not has_events and not is_single),
        stops=tuple(str(run.stop) for run in runs if run.stop),
    )


def _points(prober: Prober, courses: Sequence[Course], runs: Sequence[Run]) -> tuple[Points, dict[str, float]]:
    """Return evaluations near points of all simulations, and the standard deviation of each signal."""
    states, inputs, outputs = prober.fmu.names
    good = [run for run in runs if run.time.size]
    known = np.concatenate([np.hstack([run.states, run.inputs]) for run in good])
    values = np.concatenate([run.values for run in good])
    spread, spreads = known.std(axis=0), values.std(axis=0)
    largest = np.abs(known).max(axis=0)
    sizes = {v.name: nominal_of(v) for v in reversed(prober.description.modelVariables)}
    nominal = np.array([abs(sizes.get(name, 0.0)) or 1.0 for name in (*states, *inputs)])
    unmoved = np.where(largest > 0.0, CONSTANT_DISPLACEMENT * largest, nominal)
    scale = np.where(spread > SAME * largest, spread, unmoved)
    size = np.maximum(np.abs(values).max(axis=0), SAME)
    signals = quantities(prober.description, (*states, *inputs), known[0])
    low, high = (np.array([q.bounds[end] for q in signals]) for end in (0, 1))
    points = Points(scale, size, np.zeros((values.shape[1], known.shape[1]), bool), low, high)
    share = max(2, LOG_POINTS // max(1, len(good)))
    for course, run in zip(courses, runs, strict=True):
        if not run.time.size:
            continue
        rows = sorted({int(k) for k in np.linspace(0, run.time.size - 1, share)})
        points = prober.call(evaluated, prober.fmu, course, rows, points)
    rates = [f"der({name})" for name in states]
    columns = (*states, *inputs, *rates, *outputs)
    return points, dict(zip(columns, map(float, (*spread, *spreads)), strict=True))


def _pairs(names: Sequence[Sequence[str]], known: Array, table: Array, points: Points) -> tuple[Pair, ...]:
    """Return pairs (position, velocity): the derivative of a state equals another state times a constant."""
    states, inputs, _ = names
    n = len(states)
    rates, x = table[:, :n], known[:, :n]
    fits = []
    for q, v in permutations(range(n), 2):
        gain = float(rates[:, q] @ x[:, v] / max(float(x[:, v] @ x[:, v]), 1e-300))
        size = np.abs(rates[:, q]).max(initial=0.0)
        if size > 0.0 and np.abs(rates[:, q] - gain * x[:, v]).max() <= SAME * size:
            fits.append((q, v, gain))
    slopes = np.array(points.slopes)[:, :n, n:]
    pairs = []
    for q, v, gain in separate_pairs(fits):
        acting = [j for j in range(len(inputs)) if points.depends[v, n + j] and not points.depends[q, n + j]]
        ports = tuple(
            Port(inputs[j], float(np.nanmedian(slopes[:, v, j])), int(points.depends[:n, n + j].sum()) == 1)
            for j in acting
        )
        pairs.append(Pair(states[q], states[v], 1.0 if abs(gain - 1.0) <= SAME else gain, ports))
    return tuple(pairs)


def _connections(
    states: Sequence[str], pairs: Sequence[Pair], points: Points, runs: Sequence[Run]
) -> Iterator[Connection]:
    """Yield the springs and dampers between pairs.

    By reciprocity, a connection changes both accelerations in the constant ratio of the inertias. For coordinates that
    share an inertia, such as those of a double pendulum, the ratio changes with the motion.
    """
    slopes, along = np.array(points.slopes), np.concatenate([run.states for run in runs if run.time.size])
    usual = np.nanmedian(slopes, axis=0)
    for first, second in combinations([p for p in pairs if p.gain == 1.0], 2):
        (q, v), (r, w) = ((states.index(p.position), states.index(p.velocity)) for p in (first, second))
        ends = (slopes[:, v, r], slopes[:, w, q]), (slopes[:, v, w], slopes[:, w, v])
        ratios = [o[one > 0.0] / one[one > 0.0] for one, o in ends if (one > 0.0).any() and (o > 0.0).any()]
        if not ratios or any(np.ptp(x) > MAX_CONSTANT_VARIATION * np.median(x) for x in ratios):
            continue
        ratio = float(np.median(ratios[0]))
        spring, damper, own = float(usual[v, r]), float(usual[v, w]), float(usual[v, q] * usual[w, r])
        is_alone = abs(own - spring * usual[w, q]) <= MAX_CONSTANT_VARIATION * abs(own)
        gear = float(-spring / usual[v, q]) if is_alone and spring > 0.0 else 1.0
        deflection, speed = (float(np.std(along[:, a] - gear * along[:, b])) for a, b in ((q, r), (v, w)))
        yield Connection(first, second, gear, gear * ratio, spring / gear, damper / gear, deflection, speed)


# Dependencies, derivatives and equalities of an FMU for model exchange, from evaluations near points of its
# simulations. This code runs in the worker process.


LOG_POINTS = 40  # points over all logs
PARAMETER_POINTS = 12  # number of points at which parameters are tried
MAX_CONSTANT_VARIATION = 1e-3  # relative variation over the points, of inertia ratios and of constant directions
SMALL, LARGE = 1e-4, 0.5  # displacements relative to the spread
DISPLACED_STARTS = 6  # number of displaced starts to find the outputs that equal states


@dataclass(eq=False)
class Points:
    """Evaluations of an FMU at points of its simulations.

    Attributes:
        scale: Displacement unit of each state and input.
        size: Magnitude of each derivative and output, for comparisons.
        depends: True if a derivative or output (row) changes with a state or input (column).
        low, high: Limits of states and inputs; displacements stay within them.
        slopes: Partial derivatives at each point.
        places: Time, states and inputs of each point.
        known, values: (states, inputs) and (derivatives, outputs) at all points and at randomly displaced points.
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
        """Evaluate the FMU near its present point, which the caller restores afterwards; `t` is only stored.

        Differences by SMALL give slopes; those by LARGE show dependencies that vanish at the point, as in a dead
        band. A random point separates signals that are equal along the logs.
        """
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
        """Return the spacing with which at most `count` points are selected evenly."""
        return max(1, -(-len(self.places) // count))

    def _inside(self, moved: Array, z: Array) -> Array:
        """Return a displaced point clipped to the limits; a point outside the limits is not moved further out."""
        return np.clip(moved, np.minimum(self.low, z), np.maximum(self.high, z))


def _safe_rates(block: DifferentiableFmu, x: Array, u: Array, t: float | None = None) -> Array:
    """Return derivatives and outputs, optionally at time `t` [s]; NaN if the FMU rejects the point."""
    try:
        return block.rates(x if t is None else block.move(t, x, u), u)
    except SimulationError:
        return np.full(block.order + len(scalars(reals(block.description, "output"))), np.nan)


# -- jobs of the worker -----------------------------------------------------------------------


def start_point(fmu: Fmu, course: Course) -> tuple[Array, Array, dict[int, int]]:
    """Return states and outputs after initialization, and state → output that equals it.

    The equalities are tested at points displaced from the start.
    """
    with fmu.opened(course) as (block, _):
        block.start()
        x, u = block.current_point()
        start = block.rates(x, u)[x.size :]
        rng, known, values = np.random.default_rng(1), [], []
        for _ in range(DISPLACED_STARTS):
            z = x + 0.1 * np.where(x == 0.0, 1.0, np.abs(x)) * rng.uniform(-1.0, 1.0, x.size)
            known.append(z)
            values.append(_safe_rates(block, z, u))
    table = np.array(values)
    finite = np.isfinite(table).all(axis=1)
    return x, start, equal_columns(np.array(known)[finite], table[finite][:, x.size :])


def equal_columns(known: Array, values: Array) -> dict[int, int]:
    """Return, for each column of `known`, the index of the first equal column of `values`."""
    equal = {}
    for k, column in enumerate(known.T if len(known) > 1 else ()):
        for j, other in enumerate(values.T):
            if np.abs(other - column).max() <= SAME * np.abs(column).max() and np.ptp(column) > 0.0:
                equal[k] = j
                break
    return equal


def evaluated(fmu: Fmu, course: Course, rows: Sequence[int], points: Points) -> Points:
    """Return the points, extended by evaluations at rows of a simulation."""
    simulate(fmu, course, points.add, rows)
    return points


def reactions(fmu: Fmu, course: Course, places: Sequence[tuple[float, Array, Array]]) -> tuple[Array, Array]:
    """Return the states after initialization, and derivatives with outputs at points.

    Values are NaN if the FMU rejects a point.
    """
    with fmu.opened(course) as (block, _):
        block.start()
        states, _ = block.current_point()
        return states, np.array([_safe_rates(block, x, u, t) for t, x, u in places])


# Parameters of an FMU for model exchange that show how forces act. A settable damping parameter of a velocity shows how
# any force along this velocity acts. A force between two bodies accelerates each by the body's inertia, so a fit that
# changes a mass changes the ratio of both accelerations. Most inertias are products or sums of parameters: two trials
# of each parameter distinguish a power law from a sum.


PROPORTIONALITY_TOLERANCE = 1e-6  # largest relative deviation from proportionality to velocity and parameter
# Changes of a parameter as multiples of its size; the first whose double the bounds allow is used.
PARAMETER_CHANGES = (1.0, 0.1, -0.25)
RATIO_PLACES = 4  # number of points for the measurement of ratios


def dampings(
    prober: Prober,
    course: Course,
    points: Points,
    pairs: Sequence[Pair],
    parameters: Sequence[ProbedParameter],
    in_step: bool,
) -> tuple[Damping, ...]:
    """Return a settable damping parameter for each pair without an input that acts on this pair alone.

    With another value of the parameter, the derivatives change in proportion to the pair's velocity and to the change,
    independent of the other velocities and inputs, and no output changes directly.
    """
    states, inputs, _ = prober.fmu.names
    n, every = len(states), points.spacing(PARAMETER_POINTS)
    velocities = [states.index(p.velocity) for p in pairs]
    trials, places = list[Pair](), list[tuple[float, Array, Array]]()
    for pair, index in zip(pairs, velocities, strict=True):
        speed = float(points.scale[index])
        fits = points.low[index] <= 0.0 < 2.0 * speed <= points.high[index]
        if not fits or any(port.is_alone for port in pair.ports):
            continue
        elsewhere = [*(k for k in velocities if k != index), *range(n, n + len(inputs))]
        # each point with the velocities 0, V and 2·V, and V with other velocities and inputs displaced
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

    def react(values: NamedValues) -> Array:
        """Return the derivatives and outputs for parameter values, shape (trials, points, 4, columns)."""
        table: Array = prober.call(reactions, prober.with_values(values), course, places)[1]
        return table.reshape(len(trials), -1, 4, table.shape[1])

    slopes = np.array(points.slopes[::every])[:, :n, n:]

    base, found = react({}), dict[str, Damping]()
    for parameter in able:
        name, value, (low, high) = parameter.name, parameter.quantity.start, parameter.quantity.bounds
        size = abs(value) or abs(parameter.tried)
        change = next((c * size for c in PARAMETER_CHANGES if low <= value + 2.0 * c * size <= high), 0.0)
        if not change:  # the bounds forbid every change
            continue
        try:  # changes of derivatives and outputs for the change of the parameter and for twice this change
            both = [react({name: value + share * change}) - base for share in (1.0, 2.0)]
        except SimulationError:
            continue
        for pair, once, twice in zip(trials, *both, strict=True):
            usable = np.isfinite(once).all(axis=(1, 2)) & np.isfinite(twice).all(axis=(1, 2))
            once, twice, along = once[usable], twice[usable], slopes[usable]
            index, usual = states.index(pair.velocity), once[:, 1]
            speed = float(points.scale[index])
            noise, force = SAME * points.size, -change * speed
            near = noise + PROPORTIONALITY_TOLERANCE * np.abs(usual).max(axis=0, initial=0.0)
            equal = (once[:, 0], 0.0), (once[:, 2], 2.0 * usual), (once[:, 3], usual), (twice[:, 1], 2.0 * usual)
            affected, own = np.flatnonzero((np.abs(usual) > noise).any(axis=0)), usual[:, index] / force
            is_damping = len(own) and affected.max(initial=-1) < n and (own * abs(force) > noise[index]).all()
            if not is_damping or any((np.abs(one - other) > near).any() for one, other in equal):
                continue  # the parameter is not a damping
            gain, rates, direction = float(np.median(own)), [states[k] for k in affected], usual[:, :n] / force
            is_constant = len(rates) == 1 and bool(np.ptp(own) <= MAX_CONSTANT_VARIATION * gain)
            port = ""
            for entry in pair.ports:
                # derivatives that are a constant multiple of the direction
                of_input = along[:, :, inputs.index(entry.input)]
                factor = float((of_input * direction).sum() / (direction**2).sum())
                if np.abs(of_input - factor * direction).max() <= MAX_CONSTANT_VARIATION * np.abs(of_input).max():
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
    """Return the connections, with a factor of their ratio for each parameter of an inertia."""
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
        """Return the ratios, up to a constant, from positions and from velocities, for changed parameters.

        Returns:
            Array of shape (connections, points, 2), NaN if an end does not respond.
        """
        table: Array = prober.call(reactions, prober.with_values(changed), course, places)[1]
        # point, connection, displaced end, position or velocity, forward or backward, derivative
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
                    with suppress(SimulationError):  # the FMU rejects the value
                        for c, change in enumerate(ratios({p.name: v}) / given):
                            row[c] = np.nanmedian(change) if np.isfinite(change).any() else np.nan
            for factors, of_ratio in zip(found, changes.T.tolist(), strict=True):
                factors += _factor(p.name, value, tried, of_ratio)
    return tuple(replace(c, factors=tuple(factors)) for c, factors in zip(connections, found, strict=True))


def _factor(name: str, value: float, tried: Sequence[float], changes: Sequence[float]) -> Iterator[RatioFactor]:
    """Yield the factor of a parameter if it changes a ratio.

    Args:
        tried: Two values of the parameter.
        changes: Ratio at each tried value divided by the ratio at the default; NaN if rejected.
    """
    once, twice = changes
    if not (once > 0.0 and abs(math.log(once)) > MAX_CONSTANT_VARIATION):
        return
    factors = []
    if value and tried[0] / value > 0.0:
        power = math.log(once) / math.log(tried[0] / value)
        half = round(2.0 * power) / 2.0
        factors.append(RatioFactor(name, value, 0.0, half if abs(half - power) < MAX_CONSTANT_VARIATION else power))
    for power in (1.0, -1.0):  # a term of a sum
        times = once**power
        factors.append(RatioFactor(name, value, (tried[0] - times * value) / (times - 1.0), power))
    able = [f for f in factors if f.shift + value != 0.0 and (f.shift + tried[1]) / (f.shift + value) > 0.0]
    if math.isfinite(twice):
        able.sort(key=lambda f: max(MAX_CONSTANT_VARIATION, abs(math.log(f.at(tried[1]) / twice))))
    yield from able[:1]
