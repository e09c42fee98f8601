"""Course of inputs during a communication step: held, or a polynomial through their values at communication points.

A held input, and one fed by a known signal that is held, has its value of the step's start until the step ends. A
polynomial of degree d passes through the last d + 1 values: up to the start of the step for inputs whose new value is
not available yet (extrapolation), up to its end for inputs that have it already (interpolation). The FMU gets the mean
of the polynomial over the step, by Simpson's rule:

    ū = (p(t) + 4·p(t + h/2) + p(t + h)) / 6
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

import numpy as np

from cosim.core.arrays import Array
from cosim.fmi.description import takes_any_step
from cosim.system.schedule import Stage
from cosim.system.system import System
from cosim.system.wiring import Transfer

DISPLACEMENT = 1e-3  # of an input, relative to its magnitude, to see whether outputs follow it
TAIL = 1e-3  # share of a step with the inputs of its end
SPARE = 4  # stored points beyond those of the polynomial, for steps that are taken back
StepFunction = Callable[[float, float], None]  # of the start and the length of a step [s]


class Polynomial:
    """Polynomials of one degree through the last values of several signals.

    Points at or after a new one are dropped, because a step was taken back.
    """

    def __init__(self, degree: int) -> None:
        self.degree = degree
        self._points: deque[tuple[float, Array]] = deque(maxlen=degree + 1 + SPARE)

    def add(self, t: float, values: Array) -> None:
        """Add the values of a time."""
        while self._points and self._points[-1][0] >= t:
            self._points.pop()
        self._points.append((t, values))

    def __call__(self, t: float) -> Array:
        """Return the values at a time, by Lagrange's formula."""
        points = list(self._points)[-self.degree - 1 :]
        total = np.zeros_like(points[-1][1])
        for k, (at, values) in enumerate(points):
            others = [other for j, (other, _) in enumerate(points) if j != k]
            total += np.prod([(t - other) / (at - other) for other in others]) * values
        return total

    def mean(self, t: float, h: float) -> Array:
        """Return the means over an interval."""
        return (self(t) + 4.0 * self(t + 0.5 * h) + self(t + h)) / 6.0


def with_courses(step: StepFunction, system: System, stage: Stage, row: Array) -> StepFunction:
    """Return a step in which real inputs follow polynomials, which are absent from the row.

    Those with the value of the step's start are extrapolated, those with the value of its end interpolated. Afterwards
    the inputs of the step's end are put, and the outputs that depend directly on them are read. A component that
    answers only after a step makes a last part of the step with these inputs instead.
    """
    component, (old_degree, new_degree) = stage.component, system.courses

    def real_targets(transfers: Iterable[Transfer], degree: int) -> list[int]:
        real = (t.target for t in transfers if not (any(t.beside) or system.signals[t.name].is_whole))
        return list(real) if degree else []

    def read_again() -> None:
        """Put the inputs and get the outputs, without a step."""
        getattr(component, "try_inputs", component.put)()
        component.get()

    held = (t for t in system.held if t.name.partition(".")[0] == component.name)
    old = real_targets((t for t in held if t.origin.partition(".")[0] not in system.known), old_degree)
    new, answers = real_targets(stage.pulls, new_degree), False
    if new:  # Does an output follow an input without a step?
        own = [k for k, column in enumerate(system.columns) if column.partition(".")[0] == component.name]
        outputs = own[len(component.inputs) :]
        before = row.copy()
        for place in new:
            row[place] += DISPLACEMENT * max(1.0, abs(row[place]))
            read_again()
            answers |= bool((row[outputs] != before[outputs]).any())
            row[place] = before[place]
        read_again()
        description = getattr(component, "description", None)
        if not answers and description is not None and not takes_any_step(description):
            new = []
    if not old + new:
        return step
    past, course, is_first = Polynomial(old_degree), Polynomial(new_degree), True
    start = row[new]

    def stepped(t: float, h: float) -> None:
        nonlocal is_first
        held, given = row[old], row[new]
        if is_first:  # Before the first step, only the values of its end are in the row.
            course.add(t, start)
            is_first = False
        past.add(t, held)
        course.add(t + h, given)
        tail = TAIL * h if new and not answers else 0.0
        mean = (course.mean(t, h) - tail / h * given) / (1.0 - tail / h)
        row[old], row[new] = past.mean(t, h), mean
        try:
            step(t, h - tail)
            if tail:
                row[new] = given
                step(t + h - tail, tail)
        finally:
            row[old], row[new] = held, given
        if answers:
            read_again()

    return stepped
