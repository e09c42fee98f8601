"""Structure of an FMU for model exchange: simulations along logs, and evaluations about their points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import FmuError, InputError, SimulationError
from cosim.fmi.description import states_of
from cosim.probing.exchange_points import (
    CONSTANT,
    PLACES,
    POINTS,
    Points,
    equal_columns,
    evaluated,
    reactions,
    start_point,
)
from cosim.probing.fmu_structure import Connection, Pair, Port, ProbedParameter, Structure
from cosim.probing.force_trials import dampings, with_factors
from cosim.probing.log_runs import SAME, Course, Run, nominal_of, simulate
from cosim.probing.parameter_trials import tried_parameters
from cosim.probing.prober import Prober, quantities, separate_pairs

STEADY = 1e-2  # share of a value that displaces an unmoved state or input


def exchange_structure(prober: Prober, courses: Sequence[Course]) -> Structure:
    """Return the structure of an FMU for model exchange.

    Raises:
        InputError: The FMU does not declare its states.
        SimulationError: The FMU fails at its start.
    """
    if len(states_of(prober.description)) != len(prober.description.derivatives):
        raise InputError.at(
            prober.path,
            "does not declare the state of every derivative; probe its co-simulation, or export it again",
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
    parameters = _parameters(prober, courses[0], points, has_events)
    is_single = prober.description.modelExchange.canBeInstantiatedOnlyOncePerProcess
    # states in no pair with a rate that an input or another state changes
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
    """Return evaluations about points of all simulations, and the spread of each signal."""
    states, inputs, outputs = prober.fmu.names
    good = [run for run in runs if run.time.size]
    known = np.concatenate([np.hstack([run.states, run.inputs]) for run in good])
    values = np.concatenate([run.values for run in good])
    spread, spreads = known.std(axis=0), values.std(axis=0)
    largest = np.abs(known).max(axis=0)
    sizes = {v.name: nominal_of(v) for v in reversed(prober.description.modelVariables)}
    nominal = np.array([abs(sizes.get(name, 0.0)) or 1.0 for name in (*states, *inputs)])
    unmoved = np.where(largest > 0.0, STEADY * largest, nominal)
    scale = np.where(spread > SAME * largest, spread, unmoved)
    size = np.maximum(np.abs(values).max(axis=0), SAME)
    signals = quantities(prober.description, (*states, *inputs), known[0])
    low, high = (np.array([q.bounds[end] for q in signals]) for end in (0, 1))
    points = Points(scale, size, np.zeros((values.shape[1], known.shape[1]), bool), low, high)
    reals_only = all(name in inputs for course in courses for name in course.inputs)
    share = max(2, POINTS // max(1, len(good)))
    for course, run in zip(courses, runs, strict=True):
        if not run.time.size:
            continue
        rows = sorted({int(k) for k in np.linspace(0, run.time.size - 1, share)})
        replayed = run if reals_only and not run.events.total else None
        points = prober.call(evaluated, prober.fmu, course, rows, points, replayed)
    rates = [f"der({name})" for name in states]
    columns = (*states, *inputs, *rates, *outputs)
    return points, dict(zip(columns, map(float, (*spread, *spreads)), strict=True))


def _pairs(names: Sequence[Sequence[str]], known: Array, table: Array, points: Points) -> tuple[Pair, ...]:
    """Return the states with a rate that equals another state times a constant."""
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

    By reciprocity, a connection changes both accelerations in a constant ratio, that of the inertias. Slopes of
    coordinates that share an inertia, such as those of a double pendulum, change with the motion.
    """
    slopes, along = np.array(points.slopes), np.concatenate([run.states for run in runs if run.time.size])
    usual = np.nanmedian(slopes, axis=0)
    for first, second in combinations([p for p in pairs if p.gain == 1.0], 2):
        (q, v), (r, w) = ((states.index(p.position), states.index(p.velocity)) for p in (first, second))
        ends = (slopes[:, v, r], slopes[:, w, q]), (slopes[:, v, w], slopes[:, w, v])
        ratios = [o[one > 0.0] / one[one > 0.0] for one, o in ends if (one > 0.0).any() and (o > 0.0).any()]
        if not ratios or any(np.ptp(x) > CONSTANT * np.median(x) for x in ratios):
            continue
        ratio = float(np.median(ratios[0]))
        spring, damper, own = float(usual[v, r]), float(usual[v, w]), float(usual[v, q] * usual[w, r])
        is_alone = abs(own - spring * usual[w, q]) <= CONSTANT * abs(own)
        gear = float(-spring / usual[v, q]) if is_alone and spring > 0.0 else 1.0
        deflection, speed = (float(np.std(along[:, a] - gear * along[:, b])) for a, b in ((q, r), (v, w)))
        yield Connection(first, second, gear, gear * ratio, spring / gear, damper / gear, deflection, speed)


def _parameters(prober: Prober, course: Course, points: Points, has_events: bool) -> tuple[ProbedParameter, ...]:
    """Return each settable parameter with what it changes, at points or only through events."""
    places = points.places[:: points.spacing(PLACES)]
    tried = tried_parameters(prober, lambda fmu: prober.call(reactions, fmu, course, places), points.size)
    if not has_events:
        return tried
    base: Run = prober.call(simulate, prober.fmu, course)
    found = []
    for p in tried:
        if not (p.acts or p.starts):  # along a simulation with events, it may change more
            try:
                run: Run = prober.call(simulate, prober.with_values({p.name: p.tried}), course)
                same = run.values.shape == base.values.shape and np.allclose(run.values, base.values, SAME, 0.0)
                p = replace(p, acts=not same)
            except SimulationError as error:
                p = replace(p, failure=str(error))
        found.append(p)
    return tuple(found)
