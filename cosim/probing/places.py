"""Places where terms can be added to an FMU, the interface used for its refinement, and its internal step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.arrays import Array, NamedValues
from cosim.core.errors import FmuError, InputError, SimulationError
from cosim.fmi.description import Way, read_description, reals, state_names, ways
from cosim.isolation.limits import Limits
from cosim.logs.log import Log
from cosim.model.quantities import Quantity
from cosim.probing.co_simulation import co_simulation_structure
from cosim.probing.fmu_structure import Structure
from cosim.probing.model_exchange import exchange_structure
from cosim.probing.prober import LIMITS, SAME, Course, Prober, moved, outputs_along, probing, sine_course

STEP_SEARCH_ROWS = 60  # rows of a simulation
STEP_DOUBLINGS = 6  # step of the search, relative to the step of the log
MIN_WRONG_DIFFERENCE = 0.2  # relative difference of results of too short steps
MAX_CORRECT_DIFFERENCE = 0.05  # relative difference of correct results
INNER_STEP_ACCURACY = 0.05  # accuracy of an internal step


@dataclass(frozen=True)
class OwnStep:
    """An internal step of a co-simulation FMU that exceeds the communication step, so that results are wrong.

    Attributes:
        length, asked: Internal step and requested communication step [s].
    """

    length: float
    asked: float

    @property
    def finding(self) -> str:
        """Return the finding as a sentence with its cure."""
        return (
            f"has an internal step of about {self.length:.3g} s, above the requested step of {self.asked:.3g} s, so "
            f"its results are wrong; use model exchange, or steps that are multiples of {self.length:.3g} s"
        )


def probe_own_step(
    fmu: Path,
    logs: Sequence[Log] = (),
    values: NamedValues = MappingProxyType({}),
    *,
    limits: Limits = LIMITS,
) -> OwnStep | None:
    """Return the internal step of a co-simulation FMU if it exceeds the step of the log, otherwise None.

    Args:
        logs: Logs; the first one gives inputs and step. Without logs, small sines are used.
        values: Start values by name.
        limits: Limits of each simulation.

    Raises:
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start with its own parameters.
    """
    with probing(fmu, values, limits) as prober:
        if "co-simulation" not in ways(prober.description):
            return None
        course = excited_course(prober, Course.of(logs[0]) if logs else sine_course(prober.description))
        states = frozenset(state_names(prober.description)) - {v.name for v in reals(prober.description, "output")}
        begin = time.monotonic()
        table, stop = prober.call(outputs_along, prober.fmu, course, "co-simulation", states)
        if len(table) < 2:
            raise stop or prober.fmu.too_short(course)
        took = time.monotonic() - begin

        def steps(step: float, count: int) -> Array:
            """Return the outputs after each of `count` steps with constant inputs."""
            times = np.asarray(course.time[0] + step * np.arange(count + 1), np.float64)
            inputs = {n: np.repeat(v[:1], count + 1) for n, v in course.inputs.items()}
            held = Course(course.name, times, inputs, {}, step)
            result: Array = prober.call(outputs_along, prober.fmu, held, "co-simulation", states)[0]
            return result

        with prober.hurry(took), suppress(SimulationError, FmuError):
            step, count = course.step, 2**STEP_DOUBLINGS
            # same end time with several steps
            tables = [steps(step * 2**k, count // 2**k) for k in range(STEP_DOUBLINGS)]
            if any(len(each) != count // 2**k + 1 for k, each in enumerate(tables)):
                return None
            size = np.maximum(np.ptp(np.concatenate(tables), axis=0), SAME)
            gaps = [float((np.abs(a[-1] - b[-1]) / size).max(initial=0.0)) for a, b in pairwise(tables)]
            if gaps[0] > MIN_WRONG_DIFFERENCE and min(gaps) < MAX_CORRECT_DIFFERENCE and int(np.argmin(gaps)) > 0:
                # this many short steps give the result of a single long one
                distance = (np.abs(tables[0] - steps(step * count, 1)[-1]) / size).sum(axis=1)
                own = roundest(step * count / max(1, int(np.argmin(distance))))
                return OwnStep(own, step) if own > step else None
    return None


def excited_course(prober: Prober, course: Course) -> Course:
    """Return the first rows of input trajectories with inputs displaced from rest, so that the FMU moves."""
    course = course.first(STEP_SEARCH_ROWS)
    for variable in reals(prober.description, "input"):
        if variable.name in course.inputs:
            inputs = {**course.inputs, variable.name: moved(variable, course.inputs[variable.name])}
            course = replace(course, inputs=inputs)
    return course


def roundest(value: float) -> float:
    """Return the number with the fewest digits within the accuracy of a value."""
    rounded = (float(f"{value:.{digits}g}") for digits in (1, 2, 3))
    return next((r for r in rounded if abs(r - value) <= INNER_STEP_ACCURACY * value), value)


# Places and interface; an internal step of co-simulation affects the choice of the interface.


MAX_STEP_EIGENVALUE = 20.0  # largest product of step and eigenvalue for a filter over the states


@dataclass(frozen=True, eq=False)
class Places:
    """Structure of an FMU, places where terms can be added, and the interface used for refinement.

    Attributes:
        reason: Reason for the interface.
        structure: Structure seen through the interface.
        own_step: Internal step in co-simulation; None if it does not exceed the step of the log.
    """

    reason: str
    structure: Structure
    own_step: OwnStep | None

    @property
    def findings(self) -> tuple[str, ...]:
        """Return sentences on an internal step and on failures."""
        stops = [f"{stop}; the structure was measured before this" for stop in self.structure.stops]
        return (*([self.own_step.finding] if self.own_step else []), *stops)

    def as_json(self) -> dict[str, Any]:
        """Return the places as JSON types."""
        s = self.structure
        shows = {shown: state for state, shown in reversed([*s.shown.items()])}

        def entry(q: Quantity, **more: Any) -> dict[str, Any]:
            return {"name": q.name, "unit": q.unit, "start": q.start, **more}

        return {
            "way": s.way,
            "reason": self.reason,
            **{name: [*map(asdict, getattr(s, name))] for name in ("pairs", "connections", "dampings", "events")},
            "storages": [entry(next(q for q in s.states or s.outputs if q.name == name)) for name in s.storages],
            "feeds": {name: asdict(port) for name, port in s.feeds.items()},
            "sensors": [entry(q, shows=shows.get(q.name, "")) for q in s.outputs],
            "inputs": [entry(q) for q in s.inputs],
            "parameters": [entry(p.quantity, acts=p.acts, starts=p.starts, failure=p.failure) for p in s.parameters],
            "largest_rate": s.largest_rate,
            "step": s.step,
            "own_step": self.own_step.length if self.own_step else 0.0,
            "findings": list(self.findings),
        }


def probe_structure(
    fmu: Path, logs: Sequence[Log] = (), *, way: Way | None = None, limits: Limits = LIMITS
) -> Structure:
    """Return the structure of an FMU, from simulations along logs, or along small sines without logs.

    Args:
        way: Interface to probe; None prefers model exchange.
        limits: Limits of each simulation.

    Raises:
        InputError: The FMU lacks the interface.
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    with probing(fmu, limits=limits) as prober:
        offered = ways(prober.description)
        chosen = way or ("model-exchange" if "model-exchange" in offered else "co-simulation")
        if chosen not in offered:
            raise InputError.at(prober.path, f"has no usable interface for {chosen}; it offers {', '.join(offered)}")
        courses = [Course.of(log) for log in logs] or [sine_course(prober.description)]
        if chosen == "co-simulation":
            return co_simulation_structure(prober, courses)
        return exchange_structure(prober, courses)


def probe_places(fmu: Path, logs: Sequence[Log] = (), *, limits: Limits = LIMITS) -> Places:
    """Return the places of an FMU where terms can be added.

    Args:
        logs: Logs of the FMU; without logs, small sines drive the inputs.
        limits: Limits of each simulation.

    Raises:
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start.
    """
    offered = ways(read_description(fmu))
    own_step = probe_own_step(fmu, logs, limits=limits)
    way: Way = "co-simulation"
    reason = "it has no model exchange"
    if "model-exchange" in offered:
        try:
            structure = probe_structure(fmu, logs, way="model-exchange", limits=limits)
            way, reason = choose_way(structure, own_step, offered)
            if way == "model-exchange":
                return Places(reason, structure, own_step)
        except (InputError, FmuError, SimulationError) as error:
            if "co-simulation" not in offered:
                raise
            reason = f"its model exchange fails: {error!s}"
    return Places(reason, probe_structure(fmu, logs, way="co-simulation", limits=limits), own_step)


def choose_way(exchange: Structure, own_step: OwnStep | None, offered: Sequence[Way]) -> tuple[Way, str]:
    """Return the interface used for a refinement, and the reason.

    Args:
        exchange: Structure seen through model exchange.
    """
    stiffness = exchange.step * exchange.largest_rate
    events = sum(count.total for count in exchange.events)
    objection: str | None = None
    if events:
        objection = f"model exchange has {events} events along the logs"
    elif stiffness > MAX_STEP_EIGENVALUE:
        objection = (
            f"the product of step and largest eigenvalue is {stiffness:.3g} in model exchange, above "
            f"{MAX_STEP_EIGENVALUE:g}"
        )
    elif not exchange.states:
        objection = "model exchange has no continuous states"
    if objection is None:
        return "model-exchange", (
            "its states and derivatives are accessible, no events occur along the logs, and the product of step "
            "and largest "
            f"eigenvalue is {stiffness:.2g}, at most {MAX_STEP_EIGENVALUE:g}"
        )
    if "co-simulation" not in offered:
        return "model-exchange", f"it has no co-simulation, although {objection}"
    if own_step:
        return "model-exchange", (
            f"its co-simulation has an internal step of {own_step.length:.3g} s, above the step of the logs, "
            f"although {objection}"
        )
    return "co-simulation", objection
