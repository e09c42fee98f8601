"""Course of inputs during a communication step: held, or a polynomial through their values at communication points.

A held input, and one fed by a known signal that is held, has its value of the step's start until the step ends. A
polynomial of degree d passes through the last d + 1 values: up to the start of the step for inputs whose new value is
not available yet (extrapolation), up to its end for inputs that have it already (interpolation). The FMU gets the mean
of the polynomial over the step, by Simpson's rule:

    ū = (p(t) + 4·p(t + h/2) + p(t + h)) / 6
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.blocks.description import takes_any_step
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


def with_courses(step: StepFunction, system: System, stage: Stage, row: Any) -> StepFunction:
    """Return a step in which real inputs follow courses."""
    component, (past, ahead) = stage.component, system.courses
    held = [
        t
        for t in system.held
        if t.name.partition(".")[0] == component.name and t.origin.partition(".")[0] not in system.known
    ]
    old = _real_targets(held, system) if past else []
    new = _real_targets(stage.pulls, system) if ahead else []
    if not old + new:
        return step
    owned = [k for k, column in enumerate(system.columns) if column.partition(".")[0] == component.name]
    read: Callable[[], None] | None = partial(_read_again, component)
    if new and not _answers(component, row, new, owned[len(component.inputs) :]):
        read, description = None, getattr(component, "description", None)
        if description is not None and not takes_any_step(description):
            new = []
    return polynomial_step(step, row, (old, past), (new, ahead), read)


def _real_targets(transfers: Sequence[Transfer], system: System) -> list[int]:
    """Return the places of real inputs that transfers feed."""
    return [t.target for t in transfers if not (any(t.beside) or system.signals[t.name].is_whole)]


def _read_again(component: Any) -> None:
    """Put the inputs and get the outputs, without a step."""
    getattr(component, "try_inputs", component.put)()
    component.get()


def _answers(component: Any, row: Any, inputs: Sequence[int], outputs: Sequence[int]) -> bool:
    """Return whether an output follows an input without a step."""
    before, follows = list(row), False
    for place in inputs:
        row[place] += DISPLACEMENT * max(1.0, abs(row[place]))
        _read_again(component)
        follows |= any(row[k] != before[k] for k in outputs)
        row[place] = before[place]
    _read_again(component)
    return follows


def polynomial_step(
    step: StepFunction,
    row: Any,
    extrapolated: tuple[Sequence[int], int],
    interpolated: tuple[Sequence[int], int],
    read: Callable[[], None] | None,
) -> StepFunction:
    """Return a step with polynomial inputs, absent from the row.

    Args:
        extrapolated: Places of inputs with the value of the step's start, and the degree.
        interpolated: Places of inputs with the value of the step's end, and the degree.
        read: Puts the inputs of the step's end and gets the outputs that depend directly on them; None for a component
            that answers only after a step, which makes a last part of the step with these inputs.
    """
    (old, old_degree), (new, new_degree) = extrapolated, interpolated
    past, course = Polynomial(old_degree), Polynomial(new_degree)
    is_first = True

    def stepped(t: float, h: float) -> None:
        nonlocal is_first
        held, given = np.array([row[k] for k in old]), np.array([row[k] for k in new])
        if is_first:  # Before the first step, only the values of its end are in the row.
            course.add(t, start)
            is_first = False
        past.add(t, held)
        course.add(t + h, given)
        tail = TAIL * h if new and read is None else 0.0
        mean = (course.mean(t, h) - tail / h * given) / (1.0 - tail / h)
        for places, values in ((old, past.mean(t, h)), (new, mean)):
            for place, value in zip(places, values.tolist(), strict=True):
                row[place] = value
        try:
            step(t, h - tail)
            if tail:
                for place, value in zip(new, given.tolist(), strict=True):
                    row[place] = value
                step(t + h - tail, tail)
        finally:
            for places, values in ((old, held), (new, given)):
                for place, value in zip(places, values.tolist(), strict=True):
                    row[place] = value
        if new and read is not None:
            read()

    start = np.array([row[k] for k in new])
    return stepped
