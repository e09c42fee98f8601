"""Internal step of an FMU for co-simulation, found by simulation.

It affects the choice of interface for a refinement.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cosim.core.arrays import Array, NamedValues
from cosim.core.errors import FmuError, SimulationError
from cosim.fmi.description import reals, state_names, ways
from cosim.isolation.limits import Limits
from cosim.logs.log import Log
from cosim.probing.log_runs import SAME, Course, moved, outputs_along, sine_course
from cosim.probing.prober import LIMITS, Prober

ROWS = 60  # rows of a simulation
DOUBLINGS = 6  # step of the search, relative to the step of the log
OWN, CONVERGED = 0.2, 0.05  # relative differences of results: of too short steps, and of correct ones
ROUNDED = 0.05  # accuracy of an internal step
STILL = 0.3  # share of rows without any change below which the FMU is not at rest


@dataclass(frozen=True)
class OwnStep:
    """The internal step of an FMU in co-simulation.

    Attributes:
        length, asked: Internal step and requested communication step [s].
        distorts: True if results at the requested step are wrong; False if the outputs only change rarely.
    """

    length: float
    asked: float
    distorts: bool

    @property
    def finding(self) -> str:
        """Return the finding as a sentence with its cure."""
        cure = f"use {'model exchange, or ' if self.distorts else ''}steps that are multiples of {self.length:.3g} s"
        if self.distorts:
            what = f"has an internal step of about {self.length:.3g} s, above the requested step of {self.asked:.3g} s"
            return f"{what}, so its results are wrong; {cure}"
        return f"its outputs change only about every {self.length:.3g} s, with steps of {self.asked:.3g} s; {cure}"


def probe_own_step(
    fmu: Path,
    logs: Sequence[Log] = (),
    values: NamedValues = MappingProxyType({}),
    *,
    limits: Limits = LIMITS,
) -> OwnStep | None:
    """Return the internal step of an FMU in co-simulation, None if it has none.

    Args:
        logs: Logs; the first one gives inputs and step. Without logs, small sines are used.
        values: Start values by name.
        limits: Limits of each simulation.

    Raises:
        FmuError: The FMU is invalid or does not load.
        SimulationError: The FMU fails, crashes or hangs at its start with its own parameters.
    """
    with Prober(fmu, values, limits) as prober:
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
            step, count = course.step, 2**DOUBLINGS
            tables = [steps(step * 2**k, count // 2**k) for k in range(DOUBLINGS)]  # same end time with several steps
            if any(len(each) != count // 2**k + 1 for k, each in enumerate(tables)):
                return None
            size = np.maximum(np.ptp(np.concatenate(tables), axis=0), SAME)
            gaps = [float((np.abs(a[-1] - b[-1]) / size).max(initial=0.0)) for a, b in pairwise(tables)]
            if gaps[0] > OWN and min(gaps) < CONVERGED and int(np.argmin(gaps)) > 0:
                # this many short steps give the result of a single long one
                distance = (np.abs(tables[0] - steps(step * count, 1)[-1]) / size).sum(axis=1)
                own = roundest(step * count / max(1, int(np.argmin(distance))))
                return OwnStep(own, step, own > step)
            changes = np.diff(table, axis=0).any(axis=1)
            if 1.0 - changes.mean() > STILL and changes[len(changes) // 2 :].any():
                return OwnStep(roundest(step / max(1e-3, changes.mean())), step, distorts=False)
    return None


def excited_course(prober: Prober, course: Course) -> Course:
    """Return the first rows of a course with inputs displaced from rest, so that the FMU moves."""
    course = course.first(ROWS)
    for variable in reals(prober.description, "input"):
        if variable.name in course.inputs:
            inputs = {**course.inputs, variable.name: moved(variable, course.inputs[variable.name])}
            course = replace(course, inputs=inputs)
    return course


def roundest(value: float) -> float:
    """Return the number with the fewest digits near an inaccurate value."""
    rounded = (float(f"{value:.{digits}g}") for digits in (1, 2, 3))
    return next((r for r in rounded if abs(r - value) <= ROUNDED * value), value)
