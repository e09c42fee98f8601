"""Model exchange: a solver integrates the FMU's derivatives between events, by default CVODE as in FMPy.

State events are zero crossings of indicators, located by the solver. Time events are announced by the FMU. Step events
are requested by the FMU after a solver step. Input changes are events too.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from cosim.blocks.instance import Instance, Step, end_of
from cosim.blocks.solvers import DOUBLES, Solver, SolverFailed, derivatives_of, numbers, solver
from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.core.times import TIME_TOLERANCE_SHARE, TIME_TOLERANCE_ULPS
from cosim.fmi.description import Way

EVENTS_NOT_SEPARATED = (
    "its events follow each other within {span:.2g} s, too fast for the solver to separate them: event indicator "
    "{number} crosses zero and returns ever faster, like a ball before it rests. The FMU needs a mode in which it "
    "rests. A smaller tolerance separates more events; an end of the run before this time avoids them"
)

DEFAULT_TOLERANCE = 1e-5  # relative tolerance by default, as in FMPy
MIN_SOLVER_STEPS = 50  # largest solver step as a fraction 1/50 of the whole time, as in FMPy
MOST_EVENTS = 1000  # discrete updates at a time, or immediately consecutive events
CHATTERING_SHARE = 1e-6  # fraction of a communication step; MOST_EVENTS within it is chattering
NO_VARIABLE = 2**32 - 1  # FMI 1.0's value reference of a state without variable
MIN_EVENT_SPACINGS = 10_000  # multiples of the spacing of doubles between two events; CVODE locates each within 100
RETRY_STEP_SHARE = 0.25  # share of a solver step that is tried if it does not separate two events
SHRINKING_SPANS = 4  # spans between crossings of an indicator that are each shorter than the one before
STRAIGHT_SHARE = 0.1  # of a solver step, in which an indicator follows its slope, as CVODE assumes after an event


class ModelExchange(Instance):
    """An FMU instance for model exchange.

    Attributes:
        reached: Time [s] of the solver.
        longest: Longest step of the solver [s]; None for a share of the run.
        max_steps: Largest number of solver steps between communication points and events; None for the solver's own.
        stops_at_events: Whether a step ends at its first event, which `handle_event` then handles.
        cause: Kind of the event at which the last step ended; "" without one.
        awaits_inputs: Whether inputs follow each step. An event at its end is handled with them, as one event.
        changes_at: Times [s] at which inputs or parameters are changed after the step that ends there, likewise.
    """

    way: Way = "model-exchange"
    fmpy_class = "Model"
    reached = _length = 0.0
    next_event: float | None = None
    solver: Any = None
    solver_name: Solver | None = None
    longest: float | None = None
    max_steps: int | None = None
    stops_at_events, cause = False, ""
    awaits_inputs, changes_at = False, frozenset[float]()
    _first: Any = None  # event information from the initialization of FMI 1.0
    _started = False
    _shortened = 0  # number of shortened steps

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self._states, self._indicator_count = description.numberOfContinuousStates, description.numberOfEventIndicators
        # FMI 1.0 demands the call of every host.
        self.needs_completed_steps = self.version == 1 or bool(self.about.needsCompletedIntegratorStep)
        # indicator and direction → times of its last crossings, and the number of shortened steps until then
        self._crossings: dict[tuple[int, int], deque[tuple[float, int]]] = {}
        self._events: deque[float] = deque(maxlen=MOST_EVENTS)  # times of the last events
        self.event_counts = {"state": 0, "time": 0, "step": 0}

    def prepare(self) -> None:
        self._started, self.solver = False, None
        if self.version == 1:
            self.fmu.setTime(self.start_time)
        super().prepare()

    def leave(self) -> None:
        if self.version == 1:
            self._first = self.fmu.initialize()
        else:
            self.fmu.exitInitializationMode()
        self.reached = self.start_time
        self.update()
        self._enter("ContinuousTime")
        self.solver = solver(
            self.solver_name,
            self.fmu,
            self.symbol,
            states=self._states,
            indicators=self._indicator_count,
            start=self.start_time,
            longest=self.longest or (self.stop_time - self.start_time) / MIN_SOLVER_STEPS,
            tolerance=DEFAULT_TOLERANCE if self.tolerance is None else self.tolerance,
            single_steps=self.needs_completed_steps,
            max_steps=self.max_steps,
        )
        self._started = True

    def stepping(self) -> Step:
        """Return the step; its errors name the failed call of many, and the time of this call."""
        from fmpy.fmi1 import FMICallException

        def step(component: Any, t: float, h: float, _: int) -> int:
            try:
                self._step(t, h)
            except FMICallException as error:
                self.time = self.reached
                self.judge(error.function, error.status)
            return 0

        return step

    def _enter(self, mode: str) -> None:
        """Enter a mode of the FMU; FMI 1.0 has none."""
        if self.version > 1:
            getattr(self.fmu, f"enter{mode}Mode")()

    def inputs_changed(self, take: Callable[[], None] | None) -> None:
        if take is None:  # An event at the end of the step is handled without them, unless a change is due.
            if (
                self.cause
                and not self.stops_at_events
                and not self._is_changed_at(self.reached, TIME_TOLERANCE_SHARE * self._length)
            ):
                self.handle_event(self._length)
            return
        if not self._started:
            take()
            return
        if self.cause and not self.stops_at_events:
            self.event_counts[self.cause] += 1
            self.cause = ""
        self.event(take)
        self.solver.reset(self.reached)

    def event(self, change: Callable[[], None] | None = None) -> None:
        """Handle an event: change inputs, then update discrete states."""
        self._enter("Event")
        if change is not None:
            change()
        self.update()
        self._enter("ContinuousTime")

    def save_state(self) -> tuple[float, list[float]]:
        """Return time [s] and continuous states, for `restore_state`."""
        return self.reached, numbers(self.fmu.getContinuousStates, self._states)

    def restore_state(self, saved: tuple[float, list[float]]) -> None:
        """Take back the states before a step, whose event, if any, has not been handled."""
        self.reached, states = saved
        self.cause = ""
        self._place(self.reached, states)
        self.solver.reset(self.reached)

    # -- internal -------------------------------------------------------------------------------

    def _step(self, t: float, h: float) -> None:
        """Integrate to the communication point across all events."""
        end, self._length = t + h, h
        if self.cause and not self.stops_at_events:  # Nothing has changed at the last step's end.
            self.handle_event(h)
        spacing = math.ulp(max(abs(t), abs(end), end - self.start_time))
        close = TIME_TOLERANCE_ULPS * spacing + TIME_TOLERANCE_SHARE * h
        if h <= 2 * TIME_TOLERANCE_ULPS * spacing:
            raise SimulationError(
                self.name, t, f"a step of {h:.3g} s is too short at this time: doubles are {spacing:.2g} s apart there"
            )
        while end - self.reached > close:
            event = self.next_event
            at_event = event is not None and event <= end + close
            target = end
            if event is not None and at_event:  # An event within rounding of the target is not missed.
                target = event if event < end - close else max(event, end)
            state_event, step_event = self._integrate(target, TIME_TOLERANCE_ULPS * spacing)
            if state_event or step_event or at_event:
                self.cause = (
                    "state" if state_event else "step" if self.reached < target else "time" if at_event else "step"
                )
                if self.stops_at_events:
                    return
                if end - self.reached <= close and (self.awaits_inputs or self._is_changed_at(end, close)):
                    return
                self.handle_event(h)

    def _is_changed_at(self, time: float, close: float) -> bool:
        return any(abs(time - at) <= close for at in self.changes_at)

    def _integrate(self, target: float, min_span: float) -> tuple[bool, bool]:
        """Integrate to the target or the first event; return whether a state event and a step event occurred.

        The FMU is told of each step of the solver if it needs that. Nothing is integrated over `min_span` [s] or less.
        """
        while True:
            state_event = False
            if target - self.reached <= min_span:
                self.reached = max(self.reached, target)
            else:
                try:
                    state_event, self.reached = self._solver_step(target)
                except SolverFailed as error:
                    raise SimulationError(self.name, self.reached, self._explain(error)) from None
            self.fmu.setTime(self.reached)
            step_event = False
            if self.needs_completed_steps:
                answer = self.fmu.completedIntegratorStep()
                step_event, terminate = (answer, False) if self.version == 1 else answer
                if terminate:
                    raise end_of(self.name, self.reached)
            if state_event or step_event or self.reached >= target:
                return state_event, step_event

    def _solver_step(self, target: float) -> tuple[bool, float]:
        """Take one or more steps of the solver; return whether a state event occurred, and the time reached.

        A step is too long if an indicator leaves its side after an event and returns to it within the step, or if it
        crosses zero against its slope, since the error of the solver is larger than its way. Shorter steps follow.

        Raises:
            SimulationError: Two events are closer together than times can be separated.
        """
        if not self._indicator_count:
            event, _, time = self.solver.step(self.reached, target)
            return bool(event), float(time)
        spacing = math.ulp(max(abs(self.reached), abs(target), target - self.start_time))
        saved = self.save_state()
        hidden, false = set[int](), set[int]()  # indicators for which the step is too long
        while True:
            is_first = self.solver.is_first
            begins = self._indicators(*saved) if is_first else []
            slopes = self._rates() if is_first else []
            event, roots, time = self.solver.step(self.reached, target)
            if not (event or is_first):
                return False, float(time)
            reached, length = (float(time), self.save_state()[1]), self.solver.last_step
            ends = self._indicators(*reached)
            if is_first:
                ahead = self._ahead(saved, slopes, STRAIGHT_SHARE * length)
                hidden = {k for k in range(len(ends)) if _is_hidden(begins[k], ahead[k], ends[k], was=k in hidden)}
            if event:
                self._place(*reached)
                ahead = self._ahead(reached, self._rates(), STRAIGHT_SHARE * length)
                ways = [root * (z - end) for root, z, end in zip(roots, ahead, ends, strict=True)]
                false = {k for k, way in enumerate(ways) if way < 0.0 or (k in false and roots[k] and way == 0.0)}
            if not (hidden or (event and false)):
                self._place(*reached)
                if event:
                    self._note_crossings(roots, reached[0], spacing)
                return bool(event), reached[0]
            self._place(*saved)
            if RETRY_STEP_SHARE * length <= MIN_EVENT_SPACINGS * spacing:
                fields = {"span": length, "number": min(hidden | false) + 1}
                raise SimulationError(self.name, self.reached, EVENTS_NOT_SEPARATED.format(**fields))
            self._shortened += 1
            self.solver.reset(self.reached, RETRY_STEP_SHARE * length)

    def _note_crossings(self, roots: Sequence[int], time: float, spacing: float) -> None:
        """Note the time of crossings; raise SimulationError if they come ever faster, too fast for the solver."""
        for crossing in ((k, root) for k, root in enumerate(roots) if root):
            last = self._crossings.setdefault(crossing, deque(maxlen=SHRINKING_SPANS + 1))
            last.append((time, self._shortened))
            spans = [b[0] - a[0] for a, b in pairwise(last)]
            if len(spans) < SHRINKING_SPANS or any(b >= a for a, b in pairwise(spans)):
                continue
            if spans[0] <= MIN_EVENT_SPACINGS * spacing or all(b[1] > a[1] for a, b in pairwise(last)):
                fault = EVENTS_NOT_SEPARATED.format(span=spans[-1], number=crossing[0] + 1)
                raise SimulationError(self.name, self.reached, fault)

    def _ahead(self, point: tuple[float, Sequence[float]], slopes: Sequence[float], span: float) -> list[float]:
        """Return the event indicators a time span [s] ahead of a point, along the slopes of the states."""
        states = [x + span * slope for x, slope in zip(point[1], slopes, strict=True)]
        return self._indicators(point[0] + span, states)

    def _place(self, time: float, states: Sequence[float]) -> None:
        """Set time and continuous states."""
        self.fmu.setTime(time)
        self.set_states(states)

    def set_states(self, states: Sequence[float] | Array) -> None:
        """Set the continuous states."""
        if count := len(states):
            cells = (ctypes.c_double * count)(*states)
            self.fmu.setContinuousStates(ctypes.cast(cells, DOUBLES), count)

    def _indicators(self, time: float, states: Sequence[float]) -> list[float]:
        """Return the event indicators at a point."""
        self._place(time, states)
        return numbers(self.fmu.getEventIndicators, self._indicator_count)

    def _rates(self) -> list[float]:
        """Return the derivatives of the continuous states."""
        return numbers(derivatives_of(self.fmu), self._states)

    def _explain(self, error: SolverFailed) -> str:
        """Return the solver's reason with the derivative's name."""
        if error.derivative is None:
            return error.reason
        number, value = error.derivative
        derivatives = self.description.derivatives
        are_scalar = len(derivatives) == self._states  # Arrays would break the numbering.
        name = derivatives[number].variable.name if are_scalar else f"number {number + 1}"
        return (
            f"the derivative {name} is {value}, also with the shortest steps of the solver. If the solution is "
            "finite, its error grew: make `tolerance` smaller than the smallest state, or use solver: solve_ivp"
        )

    def handle_event(self, h: float) -> None:
        """Handle the event at which the step of `h` [s] has come to; raise SimulationError for chattering."""
        cause, self.cause = self.cause, ""
        self.event_counts[cause] += 1
        self._events.append(self.reached)
        if len(self._events) == self._events.maxlen and self._events[-1] - self._events[0] <= CHATTERING_SHARE * h:
            span = f"{CHATTERING_SHARE * h:.2g} s"
            fault = f"it chatters: {len(self._events)} events within {span}, so that time stands still"
            raise SimulationError(self.name, self.reached, fault)
        before = self._point() if cause == "step" else None
        self.event()
        if before is None or self._point() != before:  # Else the solution goes on smoothly.
            self.solver.reset(self.reached)

    def _point(self) -> tuple[list[float], ...]:
        """Return continuous states, their derivatives and the event indicators."""
        states = self.save_state()[1]
        indicators = self._indicators(self.reached, states) if self._indicator_count else []
        return states, self._rates(), indicators

    def update(self) -> None:
        """Update discrete states until stable; note the next time event."""
        due: float | None = None
        for _ in range(MOST_EVENTS):
            if self.version > 1:
                update = self.fmu.newDiscreteStates if self.version == 2 else self.fmu.updateDiscreteStates
                more, terminate, _, _, defined, time = update()
            else:
                first, self._first = self._first, None
                converged, _, _, terminate, defined, time = self.fmu.eventUpdate() if first is None else first
                more = first is None and not converged
            if terminate:
                raise end_of(self.name, self.reached)
            due = time if defined else None
            if more:
                continue
            if due is None or due > self.reached:
                self.next_event = due
                return
            self._enter("ContinuousTime")  # A time event due now is an event of its own.
            self._enter("Event")
        fault = f"its discrete states still change after {MOST_EVENTS} updates"
        if due is not None and due <= self.reached:
            fault = (
                f"{MOST_EVENTS} times in a row it gives t = {due:.6g} s as the time of its next event, which is "
                "not in the future; the FMU must give a later time or none"
            )
        raise SimulationError(self.name, self.reached, fault)

    def state_references(self) -> list[int]:
        """Return the value references of the continuous states. FMI 1.0 declares them at run time only, if at all."""
        from fmpy.fmi1 import FMICallException

        count = self.description.numberOfContinuousStates
        references = (ctypes.c_uint * count)(*[NO_VARIABLE] * count)
        with contextlib.suppress(FMICallException):  # Some exporters do not implement it.
            self.fmu.getStateValueReferences(references, count)
        return list(references)


def _is_hidden(begin: float, ahead: float, end: float, *, was: bool) -> bool:
    """Return whether an indicator leaves its side and returns to it within a step.

    Args:
        ahead: Indicator shortly after the beginning, along its slope.
        was: Whether it did so in a longer step. It then still does if it moves towards the other side.
    """
    leaves = (ahead > 0.0) != (begin > 0.0) or (was and (ahead <= begin if begin > 0.0 else ahead >= begin))
    return leaves and (end > 0.0) == (begin > 0.0)
