"""The model of a probed FMU: its signals, places with usual sizes along the logs, terms and parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from cosim.base.units import unit_of_rate, unit_product
from cosim.logs.log import Log
from cosim.model.quantities import Parameter, Quantity
from cosim.probing.fmu_structure import Connection, Damping, Pair, Port, ProbedParameter, Structure
from cosim.terms.catalogue import bound_terms, delay_of, sensor_errors
from cosim.terms.fmu_model import Dependencies, FmuModel, fmu_model
from cosim.terms.language import Direction, Opposite, Place, with_place

HORIZON_ROWS, HORIZON_SHARE = 50, 0.1  # duration of replays: least in rows, and usual share of a log
LATEST = 20  # longest delay of the inputs, in rows
SLOPE_ROWS = 5  # rows over which the rate of readings is taken
WIDEST = 100.0  # factor on a parameter without bounds, up and down
RESOLVED = 0.25  # transition of friction of half the usual force, in steps: Runge-Kutta is stable from 0.18 on
FINEST = 0.25  # substep times largest eigenvalue; a fit takes the coarsest with equal likelihood


@dataclass(frozen=True)
class ProbedModel:
    """A probed FMU with its estimation logs, in names of the FMU, and terms of the user."""

    structure: Structure
    logs: Sequence[Log]
    terms: Sequence[type[Any]] = ()

    @property
    def is_stepped(self) -> bool:
        """Return True for co-simulation, with outputs in place of states."""
        return self.structure.way == "co-simulation"

    @property
    def step(self) -> float:
        """Return the time between rows [s]."""
        return self.logs[0].step

    @property
    def duration(self) -> float:
        """Return the duration of the longest log [s]."""
        return max(float(log.time[-1] - log.time[0]) for log in self.logs)

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Return the states, or the outputs in their place."""
        return self.structure.outputs if self.is_stepped else self.structure.states

    @cached_property
    def ranges(self) -> dict[str, float]:
        """Return input → range of the commands."""
        names = [q.name for q in self.structure.inputs]
        return {n: max(float(np.ptp(log.inputs[n])) for log in self.logs if n in log.inputs) for n in names}

    @cached_property
    def units(self) -> dict[str, str]:
        """Return the unit of every signal."""
        signals = self.structure.states, self.structure.inputs, self.structure.outputs
        return {q.name: q.unit for group in signals for q in group}

    def size(self, name: str) -> float:
        """Return the usual size of a signal: its spread, of an input half of its range; 1 for a constant."""
        if name in self.ranges:
            return 0.5 * self.ranges[name] or 1.0
        return self.structure.scales.get(name) or 1.0

    def largest(self, name: str) -> float:
        """Return the largest magnitude of an input, or its usual size."""
        columns = [log.inputs[name] for log in self.logs if name in log.inputs]
        return max((float(np.abs(u).max()) for u in columns), default=0.0) or self.size(name)

    def rate(self, name: str) -> float:
        """Return the usual rate of change of a signal."""
        columns = [log.outputs[name] for log in self.logs if name in log.outputs]
        read = max((float(np.nanstd(y[SLOPE_ROWS:] - y[:-SLOPE_ROWS])) for y in columns), default=0.0)
        return self.structure.scales.get(f"der({name})") or read / (SLOPE_ROWS * self.step) or 1.0

    def middle(self, state: Quantity) -> float:
        """Return the mean of a state's readings, or its start value without any."""
        shown = self.structure.shown_as(state.name)
        columns = [log.outputs[shown] for log in self.logs if shown in log.outputs]
        return float(np.nanmean(np.concatenate(columns))) if columns else state.start

    # -- places -------------------------------------------------------------------------------------

    def places(self) -> Iterator[Place]:
        """Yield every place of terms."""
        for k, q in enumerate(self.structure.inputs):
            sizes = {"u": self.size(q.name), "M": self.largest(q.name), "T": self.step}
            yield Place(with_place(q.name), {"u": q.unit, "M": q.unit, "T": "s"}, sizes, k)
        yield from filter(None, map(self._place_of_pair, self.structure.pairs))
        yield from map(self._place_of_connection, self.structure.connections)
        names = [q.name for q in self.states]
        for name in self.structure.storages:
            index = names.index(name)
            units = {"q": self.units[name], "r": self._rate_unit(name)}
            sizes = {"q": self.size(name), "r": self.rate(name)}
            place = Place(with_place(name), units, sizes, state=index, middle=self.middle(self.states[index]))
            port = self.structure.feeds.get(name)
            inputs = [q.name for q in self.structure.inputs]
            yield replace(place, input=inputs.index(port.input), gain=port.gain) if port else place

    def _place_of_pair(self, pair: Pair) -> Place | None:
        """Return the place of forces at a pair; None in co-simulation without a port."""
        port, damping = self._way_of_forces(pair)
        if self.is_stepped and port is None:
            return None
        names, v, q = [s.name for s in self.states], pair.velocity, pair.position
        units = {"u": self._rate_unit(v), "v": self.units[v], "q": self.units[q], "d": self.units[q]}
        travel = math.sqrt(12.0) * self.size(q)  # of a position that takes every value equally often
        sizes = {"u": self.rate(v), "v": self.size(v), "q": self.size(q), "d": travel}
        resolution = RESOLVED * self.rate(v) * self.step
        place = Place(with_place(v), units, sizes, -1, names.index(q), names.index(v), resolution=resolution)
        if damping is not None:
            direction = self._direction(damping)
            units["u"] = unit_product([(self.units[v], 1), (self._parameters[damping.parameter].unit, 1)])
            sizes["u"] = self.rate(v) / damping.gain
            return replace(place, direction=direction, is_driven=bool(pair.ports))
        if port is None:
            return place
        units["u"], sizes["u"] = self.units[port.input], self.rate(v) / abs(port.gain)
        inputs = [s.name for s in self.structure.inputs]
        return replace(place, input=inputs.index(port.input), sign=math.copysign(1.0, port.gain))

    def _way_of_forces(self, pair: Pair) -> tuple[Port | None, Damping | None]:
        """Return the input by which forces come in, or the damping that tells how they act; neither for one rate."""
        port = next((p for p in (*(p for p in pair.ports if p.is_alone), *pair.ports)), None)
        damping = next((d for d in self.structure.dampings if d.pair == pair), None)
        if damping is None or damping.port:
            return next((p for p in pair.ports if damping and p.input == damping.port), port), None
        if damping.is_constant:
            return None, None
        return (None, damping) if damping.in_step else (port, None)

    @property
    def _parameters(self) -> dict[str, Quantity]:
        """Return the parameters of the FMU by name."""
        return {p.name: p.quantity for p in self.structure.parameters}

    def _direction(self, d: Damping) -> Direction:
        """Return the direction of forces that a damping tells."""
        names, (_, high) = [s.name for s in self.structure.states], self._parameters[d.parameter].bounds
        rates = tuple(names.index(name) for name in d.rates)
        number, state = self.structure.directions.index(d), names.index(d.pair.velocity)
        return Direction(number, d.parameter, d.change, high, state, d.speed, rates)

    def _place_of_connection(self, c: Connection) -> Place:
        """Return the place of forces between two pairs, in units of the first one's acceleration."""
        names, q, v = [s.name for s in self.states], c.first.position, c.first.velocity
        units = {"u": self._rate_unit(v), "v": self.units[v], "q": self.units[q]}
        deflection, speed = c.deflection or self.size(q), c.speed or self.size(v)
        sizes = {"u": c.stiffness * deflection or c.damping * speed, "v": speed, "q": deflection}
        if c.stiffness:
            units["k"], sizes["k"] = unit_product([(units["u"], 1), (units["q"], -1)]), c.stiffness
        factors = tuple(replace(f, parameter=with_place(f.parameter)) for f in c.factors)
        other = Opposite(names.index(c.second.position), names.index(c.second.velocity), c.gear, c.ratio, factors)
        name = f"{with_place(v)}_against_{with_place(c.second.velocity)}"
        resolution, ends = RESOLVED * self.rate(v) * self.step, (names.index(q), names.index(v))
        return Place(name, units, sizes, -1, *ends, resolution=resolution, opposite=other)

    def _rate_unit(self, name: str) -> str:
        return unit_of_rate(self.units[name])

    # -- model --------------------------------------------------------------------------------------

    def model(self) -> FmuModel:
        """Return the model with every term at every place."""
        s = self.structure
        signals = self._named_states(), _named(s.inputs), _named(s.outputs)
        parameters = [_parameter(p) for p in s.acting]
        listed = (*s.states, *s.inputs, *s.outputs, *(p.quantity for p in s.acting))
        fastest = FINEST / s.largest_rate if s.largest_rate > 0.0 else math.inf
        return fmu_model(
            s.fmu.stem,
            signals,
            parameters,
            self._catalogue(),
            dependencies=Dependencies(
                np.vstack([s.state_in_rate, s.state_in_output]), np.vstack([s.input_in_rate, s.input_in_output])
            ),
            rates=self._rates(),
            variables={with_place(q.name): q.name for q in listed},
            sensors=tuple(e for q in signals[2] for e in self._sensors(q)),
            forced=tuple(q.name for k, q in enumerate(signals[0]) if self.is_stepped or k not in self._rates()),
            calibrated=tuple(p.name for p in parameters),
            suspect=dict.fromkeys(
                (p.name for p in parameters), tuple(with_place(name) for name, width in self.ranges.items() if width)
            ),
            horizon=math.inf if self.is_stepped else self._horizon(),
            shown=self._shown(),
            stepped=self.is_stepped,
            starts=tuple(with_place(v.name) for v in s.starts),
            rate=self.step,
            substep=min(self.step, fastest),
            integrator="rk4",
        )

    def _named_states(self) -> list[Quantity]:
        """Return the states with names of the model: that of an output that shows the state, else the FMU's."""
        return [replace(q, name=with_place(self.structure.shown_as(q.name))) for q in self.states]

    def _rates(self) -> dict[int, int]:
        """Return position → its velocity, both by index."""
        names = [q.name for q in self.states]
        pairs = [pair for pair in self.structure.pairs if pair.gain == 1.0]
        return {names.index(pair.position): names.index(pair.velocity) for pair in pairs}

    def _shown(self) -> dict[int, int]:
        """Return the index of the state that each output equals, by index of the output."""
        outputs = [q.name for q in self.structure.outputs]
        return {
            outputs.index(y): k for k, q in enumerate(self.structure.states) if (y := self.structure.shown.get(q.name))
        }

    def _catalogue(self) -> list[type[Any]]:
        inputs = _named(self.structure.inputs)
        bound = bound_terms([*self.places()], self.terms)
        return [*([delay_of(inputs, LATEST * self.step)] if inputs else []), *bound]

    def _sensors(self, output: Quantity) -> Iterator[type[Any]]:
        name = next(q.name for q in self.structure.outputs if with_place(q.name) == output.name)
        signed = any(float(np.nanmin(log.outputs[name])) < 0.0 for log in self.logs if name in log.outputs)
        return sensor_errors(output, self.size(name), self.step, self.duration, signed=signed)

    def _horizon(self) -> float:
        return float(f"{max(HORIZON_ROWS * self.step, HORIZON_SHARE * self.duration):.2g}")


def _named(quantities: Sequence[Quantity]) -> list[Quantity]:
    """Return signals with names of the model."""
    return [replace(q, name=with_place(q.name)) for q in quantities]


def _parameter(p: ProbedParameter) -> Parameter:
    """Return the declaration of a parameter. Without bounds, it keeps its sign; the size of 0 is the one tried."""
    q = p.quantity
    low, high = q.bounds
    if q.start != 0.0:
        ends = sorted((q.start / WIDEST, q.start * WIDEST))
        low, high = max(low, ends[0]), min(high, ends[1])
    typical = abs(p.tried) if q.start == 0.0 else None
    return Parameter(with_place(q.name), q.start, q.unit, q.doc, (low, high), typical=typical)
