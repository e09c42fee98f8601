"""Inputs during a communication step: constant, or a polynomial through their values at communication points.

A held input is constant from the start to the end of a step. A polynomial of degree d passes through the last d + 1
values: up to the start of the step for inputs whose new value is not available yet (extrapolation), up to its end for
inputs that have it already (interpolation). An FMI 2.0 FMU that interpolates its inputs gets value and derivatives of
the polynomial at the start of the step. Any other FMU gets the mean of the polynomial over the step.
"""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.component import ADVANCE, Row
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.stepping import Course as CCourse
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.fmi.description import takes_any_step
from cosim.system.schedule import Stage

if TYPE_CHECKING:
    from cosim.master.master import Master

INPUT_DISPLACEMENT = 1e-3  # of an input, relative to its magnitude, to see whether outputs follow it
TAIL = 1e-3  # share of a step with the inputs of its end
SPARE = 4  # stored points beyond those of the polynomial, for steps that are taken back
StepFunction = Callable[[float, float], None]  # of the start and the length of a step [s]


class Polynomial:
    """Polynomials of equal degree through the last values of several signals, in Newton's form.

    A new point replaces all points at the same or a later time, which exist if a step was taken back.
    """

    def __init__(self, degree: int) -> None:
        self.degree = degree
        self._points: deque[tuple[float, Array]] = deque(maxlen=degree + 1 + SPARE)

    def add(self, t: float, values: Array) -> None:
        """Add the values at time t [s]."""
        while self._points and self._points[-1][0] >= t:
            self._points.pop()
        self._points.append((t, values))

    def mean(self, t: float, h: float = 0.0) -> Array:
        """Return the mean of each signal over the interval from t to t + h [s]; its value at t for h = 0.

        The means of (s − t₀) and (s − t₀)·(s − t₁) are a and a·(a + t₀ − t₁) + h²/12, with a = t − t₀ + h/2.
        """
        last, values = self._points[-1]
        ahead = (t - last) + 0.5 * h
        slope, curvature, gap = self._differences()
        if slope is not None:
            values = values + ahead * slope
        if curvature is not None:
            values = values + (ahead * (ahead + gap) + h * h / 12.0) * curvature
        return values

    def derivatives(self, t: float) -> tuple[Array, Array]:
        """Return the first and the second derivatives at a time."""
        last, values = self._points[-1]
        slope, curvature, gap = self._differences()
        if slope is None or curvature is None:
            nothing = np.zeros_like(values)
            return nothing if slope is None else slope, nothing
        return slope + (2.0 * (t - last) + gap) * curvature, 2.0 * curvature

    def in_c(self, row: Row, places: Sequence[int], start: float) -> CCourse:
        """Return the C structure of the polynomials, with points up to the start of the steps [s]."""
        room, count = self.degree + 1 + SPARE, len(places)
        points = [point for point in reversed(self._points) if point[0] <= start][:room] if count else []
        place = (ctypes.c_void_p * count)(*(ctypes.addressof(row) + 8 * k for k in places))
        times, values = (ctypes.c_double * room)(*(t for t, _ in points)), (ctypes.c_double * (room * count))()
        values[: len(points) * count] = [value for _, row in points for value in row.tolist()]
        buffers = place, times, values
        course = CCourse(self.degree, count, len(points), room, *(ctypes.addressof(buffer) for buffer in buffers))
        course.keeping = buffers
        return course

    def _differences(self) -> tuple[Array | None, Array | None, float]:
        """Return the first two divided differences (None if there are too few points) and the last step's length."""
        if not self.degree or len(self._points) < 2:
            return None, None, 0.0
        (before, old), (last, new) = self._points[-2], self._points[-1]
        gap = last - before
        slope = (new - old) / gap
        if self.degree < 2 or len(self._points) < 3:
            return slope, None, gap
        first, oldest = self._points[-3]
        return slope, (slope - (old - oldest) / (before - first)) / (last - first), gap


def read_again(component: Any) -> None:
    """Put the inputs and get the outputs of a component, without a step and without an event."""
    getattr(component, "try_inputs", component.put)()
    component.get()


class CourseStep:
    """A component's step in which real inputs follow polynomials instead of the values in the row.

    Inputs that are known up to the step's start are extrapolated; inputs that are known up to its end are interpolated.
    Afterwards the inputs of the step's end are put, and the outputs with direct feedthrough are read. If outputs react
    only after a step, the last part of the step is made with the inputs of the step's end instead.

    Attributes:
        old, new: Indices in the row of the extrapolated, and of the interpolated inputs.
        past, course: Polynomials of the extrapolated, and of the interpolated inputs.
        answers: True if outputs react to an interpolated input without a step.
        follows: True if the component gets derivatives of the polynomials instead of means.
        tail: Length of the last part, relative to that of the step.
    """

    def __init__(self, step: StepFunction, master: Master, stage: Stage) -> None:
        self._step, self._master, self._row, system = step, master, master.values, master.system
        self.component = component = stage.component
        old_degree, new_degree = system.courses
        self.old = [t.target for t in system.extrapolated(component.name)]
        self.new = [t.target for t in stage.pulls if system.is_real(t)] if new_degree else []
        self._names = [system.columns[place].partition(".")[2] for place in (*self.old, *self.new)]
        own = [k for k, column in enumerate(system.columns) if column.partition(".")[0] == component.name]
        outputs = own[len(component.inputs) :]
        self.answers = bool(self.new) and self._answers(outputs)
        description = getattr(component, "description", None)
        if not self.answers and description is not None and not takes_any_step(description):
            self.new = []
        self.past, self.course = Polynomial(old_degree), Polynomial(new_degree)
        self._start: Array | None = self._row[self.new]  # before the first step, the row has only its end's values
        self.follows = max(system.courses) > 1 and _follows_derivatives(master, stage, self._names, outputs)
        self.tail = TAIL if self.new and not (self.answers or self.follows) else 0.0

    def __call__(self, t: float, h: float) -> None:
        """Step from t to t + h [s]."""
        row, old, new, past, course = self._row, self.old, self.new, self.past, self.course
        held, given = row[old], row[new]
        if self._start is not None:
            course.add(t, self._start)
            self._start = None
        past.add(t, held)
        course.add(t + h, given)
        tail = self.tail * h
        try:
            if self.follows:
                row[old], row[new] = past.mean(t), course.mean(t)
                orders = zip(past.derivatives(t), course.derivatives(t), strict=True)
                derivatives = [[*of_old.tolist(), *of_new.tolist()] for of_old, of_new in orders]
                component: Any = self._master.announce(self.component, ADVANCE)
                component.step_by_derivatives(self._names, derivatives, t, h)
            else:
                mean = course.mean(t, h)
                row[old], row[new] = past.mean(t, h), (mean - tail / h * given) / (1.0 - tail / h) if tail else mean
                self._step(t, h - tail)
                if tail:
                    row[new] = given
                    self._step(t + h - tail, tail)
        finally:
            row[old], row[new] = held, given
        if self.answers:
            read_again(self.component)

    def in_c(self) -> str | tuple[CCourse, CCourse]:
        """Return both polynomials for the C loop, or the reason why C cannot make the step."""
        if self.tail:
            return f"{self.component.name} has interpolated inputs and responds to them only after a step"
        if self.follows:
            return f"{self.component.name} receives derivatives of its inputs"
        row, start = self._master.row, self._master.system.start
        return self.past.in_c(row, self.old, start), self.course.in_c(row, self.new, start)

    def _answers(self, outputs: Sequence[int]) -> bool:
        """Return True if an output reacts to an interpolated input without a step."""
        row, answers = self._row, False
        before = row.copy()
        for place in self.new:
            row[place] += INPUT_DISPLACEMENT * max(1.0, abs(row[place]))
            read_again(self.component)
            answers |= bool((row[outputs] != before[outputs]).any())
            row[place] = before[place]
        read_again(self.component)
        return answers


def _follows_derivatives(master: Master, stage: Stage, names: Sequence[str], outputs: Sequence[int]) -> bool:
    """Return True if an FMU uses second derivatives of its inputs, tested by two steps that are taken back.

    Some FMUs that declare this capability ignore the derivatives. Means of polynomials give a coupling of second order
    with any FMU.
    """
    component: Any = stage.component
    if not (isinstance(component, FmuBlock) and component.interpolates_inputs and component.rolls_back):
        return False
    h, before, answers = stage.every * master.h, master.values.copy(), []
    state = component.save_state()
    try:
        for size in (0.0, 2.0 * INPUT_DISPLACEMENT / h**2):
            orders = [0.0] * len(names), [size] * len(names)
            component.step_by_derivatives(names, orders, master.system.start, h)
            answers.append(master.values[outputs])
            component.restore_state(state, keep=True)
            master.values[:] = before
    except SimulationError:
        return False
    finally:
        component.free_state(state)
    return bool((answers[0] != answers[1]).any())
