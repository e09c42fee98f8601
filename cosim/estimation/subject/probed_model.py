"""The model of a probed FMU: its signals, places with usual sizes along the logs, terms and parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.units import unit_of_rate, unit_product
from cosim.logs.log import Log
from cosim.model.quantities import Parameter, Quantity
from cosim.probing.fmu_structure import Structure
from cosim.terms.catalogue import bound_terms, delay_of, sensor_errors
from cosim.terms.fmu_model import Dependencies, FmuModel, fmu_model
from cosim.terms.language import Direction, Opposite, Place, with_place

HORIZON_ROWS, HORIZON_SHARE = 50, 0.1  # duration of replays: least in rows, and usual share of a log
LATEST = 20  # longest delay of the inputs, in rows
SLOPE_ROWS = 5  # rows over which the rate of readings is taken
WIDEST = 100.0  # factor on a parameter without bounds, up and down
RESOLVED = 0.25  # substep times largest eigenvalue; transition of friction of half the usual force, in steps


def probed_model(structure: Structure, logs: Sequence[Log], terms: Sequence[type[Any]] = ()) -> FmuModel:
    """Return the model of a probed FMU with every term at every place.

    Args:
        logs: Estimation logs, in names of the FMU.
        terms: Terms of the user.
    """
    s, step, is_stepped = structure, logs[0].step, structure.way == "co-simulation"
    states = s.outputs if is_stepped else s.states
    duration = max(float(log.time[-1] - log.time[0]) for log in logs)
    outputs = [q.name for q in s.outputs]
    inputs, named_outputs = (
        tuple(replace(q, name=with_place(q.name)) for q in group) for group in (s.inputs, s.outputs)
    )
    # a state has the name of an output that shows it
    named = tuple(replace(q, name=with_place(s.shown_as(q.name))) for q in states)
    names = [q.name for q in states]
    rates = {names.index(p.position): names.index(p.velocity) for p in s.pairs if p.gain == 1.0}
    parameters = []
    for p in s.acting:  # without bounds, it keeps its sign; the size of 0 is the one tried
        q, (low, high) = p.quantity, p.quantity.bounds
        if q.start != 0.0:
            ends = sorted((q.start / WIDEST, q.start * WIDEST))
            low, high = max(low, ends[0]), min(high, ends[1])
        typical = abs(p.tried) if q.start == 0.0 else None
        parameters.append(Parameter(with_place(q.name), q.start, q.unit, q.doc, (low, high), typical=typical))
    moving = tuple(with_place(name) for name in (q.name for q in s.inputs) if any(map(np.ptp, _columns(logs, name))))
    sensors: list[type[Any]] = []
    for q, name in zip(named_outputs, outputs, strict=True):
        signed = any(float(np.nanmin(y)) < 0.0 for y in _columns(logs, name))
        sensors += sensor_errors(q, _size(s, logs, name), step, duration, signed=signed)
    delay = [delay_of(inputs, LATEST * step)] if inputs else []
    return fmu_model(
        s.fmu.stem,
        (named, inputs, named_outputs),
        parameters,
        [*delay, *bound_terms([*_places(s, logs, states)], terms)],
        dependencies=Dependencies(s.depends[:, : len(s.states)], s.depends[:, len(s.states) :]),
        rates=rates,
        variables={
            with_place(q.name): q.name for q in (*s.states, *s.inputs, *s.outputs, *(p.quantity for p in s.acting))
        },
        sensors=tuple(sensors),
        forced=tuple(q.name for k, q in enumerate(named) if is_stepped or k not in rates),
        calibrated=tuple(p.name for p in parameters),
        suspect=dict.fromkeys((p.name for p in parameters), moving),
        horizon=math.inf if is_stepped else float(f"{max(HORIZON_ROWS * step, HORIZON_SHARE * duration):.2g}"),
        shown={outputs.index(y): k for k, q in enumerate(s.states) if (y := s.shown.get(q.name))},
        stepped=is_stepped,
        starts=tuple(with_place(v.name) for v in s.starts),
        rate=step,
        substep=min(step, RESOLVED / s.largest_rate if s.largest_rate > 0.0 else math.inf),
        integrator="rk4",
    )


def _columns(logs: Sequence[Log], name: str) -> list[Array]:
    """Return an input or output in the logs that have it."""
    signals = [{**log.inputs, **log.outputs} for log in logs]
    return [columns[name] for columns in signals if name in columns]


def _size(s: Structure, logs: Sequence[Log], name: str) -> float:
    """Return the usual size of a signal, its spread.

    Of an input it is half of its range within the logs, else over all logs, else its value; 1 for a constant of 0.
    """
    columns = _columns(logs, name)
    if all(q.name != name for q in s.inputs) or not columns:
        return s.scales.get(name) or 1.0
    every = np.concatenate(columns)
    return 0.5 * max(map(np.ptp, columns)) or 0.5 * float(np.ptp(every)) or float(np.abs(every).max()) or 1.0


def _places(s: Structure, logs: Sequence[Log], states: Sequence[Quantity]) -> Iterator[Place]:
    """Yield every place of terms, with usual sizes along the logs.

    Args:
        states: The states, or the outputs in their place.
    """
    step, names, inputs = logs[0].step, [q.name for q in states], [q.name for q in s.inputs]
    units = {q.name: q.unit for group in (s.states, s.inputs, s.outputs) for q in group}
    size = partial(_size, s, logs)

    def rate(name: str) -> float:
        """Return the usual rate of change of a signal."""
        changes = [y[SLOPE_ROWS:] - y[:-SLOPE_ROWS] for y in _columns(logs, name)]
        read = max((float(np.nanstd(change)) for change in changes), default=0.0)
        return s.scales.get(f"der({name})") or read / (SLOPE_ROWS * step) or 1.0

    for k, q in enumerate(s.inputs):
        usual = size(q.name)
        largest = max((float(np.abs(u).max()) for u in _columns(logs, q.name)), default=0.0) or usual
        sizes = {"u": usual, "M": largest, "T": step}
        yield Place(with_place(q.name), {"u": q.unit, "M": q.unit, "T": "s"}, sizes, k)
    # Forces at a pair come in through an input or, as a damping tells, change further rates; else they change one rate.
    for pair in s.pairs:
        port = next((p for p in (*(p for p in pair.ports if p.is_alone), *pair.ports)), None)
        damping = next((d for d in s.dampings if d.pair == pair), None)
        if damping is not None and damping.port:
            port = next((p for p in pair.ports if p.input == damping.port), port)
        elif damping is not None and (damping.is_constant or damping.in_step):
            port = None
        if s.way == "co-simulation" and port is None:
            continue
        v, x, fastest = pair.velocity, pair.position, rate(pair.velocity)
        own = {"u": unit_of_rate(units[v]), "v": units[v], "q": units[x], "d": units[x]}
        travel = math.sqrt(12.0) * size(x)  # of a position that takes every value equally often
        sizes = {"u": fastest, "v": size(v), "q": size(x), "d": travel}
        ends = names.index(x), names.index(v)
        place = Place(with_place(v), own, sizes, -1, *ends, resolution=RESOLVED * fastest * step)
        if damping is not None and damping in s.directions and damping.in_step:
            quantity = next(p.quantity for p in s.parameters if p.name == damping.parameter)
            rates, number = tuple(map(names.index, damping.rates)), s.directions.index(damping)
            limits = damping.change, quantity.bounds[1]
            direction = Direction(number, damping.parameter, *limits, names.index(v), damping.speed, rates)
            own["u"] = unit_product([(units[v], 1), (quantity.unit, 1)])
            sizes["u"] = fastest / damping.gain
            place = replace(place, direction=direction, is_driven=bool(pair.ports))
        elif port is not None:
            own["u"], sizes["u"] = units[port.input], fastest / abs(port.gain)
            place = replace(place, input=inputs.index(port.input), sign=math.copysign(1.0, port.gain))
        yield place
    for c in s.connections:  # forces between two pairs, in units of the first one's acceleration
        x, v = c.first.position, c.first.velocity
        own = {"u": unit_of_rate(units[v]), "v": units[v], "q": units[x]}
        deflection, speed = c.deflection or size(x), c.speed or size(v)
        sizes = {"u": c.stiffness * deflection or c.damping * speed, "v": speed, "q": deflection}
        if c.stiffness:
            own["k"], sizes["k"] = unit_product([(own["u"], 1), (own["q"], -1)]), c.stiffness
        factors = tuple(replace(f, parameter=with_place(f.parameter)) for f in c.factors)
        other = Opposite(names.index(c.second.position), names.index(c.second.velocity), c.gear, c.ratio, factors)
        name = f"{with_place(v)}_against_{with_place(c.second.velocity)}"
        ends = names.index(x), names.index(v)
        yield Place(name, own, sizes, -1, *ends, resolution=RESOLVED * rate(v) * step, opposite=other)
    for name in s.storages:
        index, columns = names.index(name), _columns(logs, s.shown_as(name))
        middle = float(np.nanmean(np.concatenate(columns))) if columns else states[index].start
        sizes = {"q": size(name), "r": rate(name)}
        own = {"q": units[name], "r": unit_of_rate(units[name])}
        place = Place(with_place(name), own, sizes, state=index, middle=middle)
        feed = s.feeds.get(name)
        yield replace(place, input=inputs.index(feed.input), gain=feed.gain) if feed else place
