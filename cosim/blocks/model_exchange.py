"""Model exchange: a solver integrates the FMU's derivatives between events, by default CVODE as in FMPy.

The solver locates state events, which are zero crossings of event indicators. The FMU announces time events, and
requests step events after a solver step. Changes of inputs are events, too.
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
    "its events follow each other within {span:.2g} s, too fast for the solver: event indicator {number} crosses "
    "zero and returns ever faster, as for a bouncing ball before it rests. The FMU needs a mode for rest. Use a "
    "smaller tolerance to separate more events, or end the run before this time"
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
        reached: Time [s] that the solver has reached.
        longest: Longest step of the solver [s]; None for 1/50 of the run.
        max_steps: Largest number of solver steps between communication points and events; None for the solver's
            default.
        stops_at_events: True if a step ends at its first event, which the caller then handles by `handle_event`.
        cause: Kind of event at which the last step ended; "" if it ended without an event.
        awaits_inputs: True if inputs are set after each step. An event at the end of a step is then handled together
            with the change of inputs.
        changes_at: Ends of steps [s] at which inputs or parameters change. An event there is handled together with the
            change.
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
    _shortened = 0  # how often a step was shortened

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self._states, self._indicator_count = description.numberOfContinuousStates, description.numberOfEventIndicators
        # FMI 1.0 requires this call of every host
        self.needs_completed_steps = self.version == 1 or bool(self.about.needsCompletedIntegratorStep)
        # (indicator, direction) → times of its last crossings, and the number of shortened steps before them
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
        """Return the step function, whose errors name the failed FMI call and its time."""
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
        """Enter a mode of the FMU; FMI 1.0 has no modes."""
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
        """Handle an event: apply the change of inputs, then update discrete states."""
        self._enter("Event")
        if change is not None:
            change()
        self.update()
        self._enter("ContinuousTime")

    def save_state(self) -> tuple[float, list[float]]:
        """Return time [s] and continuous states, for `restore_state`."""
        return self.reached, numbers(self.fmu.getContinuousStates, self._states)

    def restore_state(self, saved: tuple[float, list[float]]) -> None:
        """Restore the states before a step. An event at the end of that step must not have been handled."""
        self.reached, states = saved
        self.cause = ""
        self._place(self.reached, states)
        self.solver.reset(self.reached)

    # -- internal -------------------------------------------------------------------------------

    def _step(self, t: float, h: float) -> None:
        """Integrate to the communication point across all events."""
        end, self._length = t + h, h
        if self.cause and not self.stops_at_events:  # nothing has changed since the end of the last step
            self.handle_event(h)
        spacing = math.ulp(max(abs(t), abs(end), end - self.start_time))
        close = TIME_TOLERANCE_ULPS * spacing + TIME_TOLERANCE_SHARE * h
        if h <= 2 * TIME_TOLERANCE_ULPS * spacing:
            raise SimulationError(
                self.name,
                t,
                f"a step of {h:.3g} s is too short: doubles at this time are {spacing:.2g} s apart; use a longer step",
            )
        while end - self.reached > close:
            event = self.next_event
            at_event = event is not None and event <= end + close
            target = end
            if event is not None and at_event:  # includes an event within rounding of the target
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

        The FMU is notified of each solver step if it requires this. A span of at most `min_span` [s] is not integrated.
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

        A step is repeated with shorter steps if, within the step, an indicator changes its sign twice after an event,
        or crosses zero against its slope, which means that the solver's error exceeds the change of the indicator.

        Raises:
            SimulationError: Two events are closer together than times can be separated.
        """
        if not self._indicator_count:
            event, _, time = self.solver.step(self.reached, target)
            return bool(event), float(time)
        spacing = math.ulp(max(abs(self.reached), abs(target), target - self.start_time))
        saved = self.save_state()
        hidden, false = set[int](), set[int]()  # indicators that require a shorter step
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
        """Record the time of crossings; raise SimulationError if they accumulate faster than the solver resolves."""
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
        """Return the event indicators after a time `span` [s] from a point, with states that follow their slopes."""
        states = [x + span * slope for x, slope in zip(point[1], slopes, strict=True)]
        return self._indicators(point[0] + span, states)

    def _place(self, time: float, states: Sequence[float]) -> None:
        """Set the FMU's time and continuous states."""
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
        """Return the solver's reason for its failure, with the name of the derivative concerned."""
        if error.derivative is None:
            return error.reason
        number, value = error.derivative
        derivatives = self.description.derivatives
        are_scalar = len(derivatives) == self._states  # with arrays, indices would not match
        name = derivatives[number].variable.name if are_scalar else f"number {number + 1}"
        return (
            f"the derivative {name} is {value}, even with the shortest steps of the solver. If the exact solution "
            "is finite, make `tolerance` smaller than the smallest state, or use solver: solve_ivp"
        )

    def handle_event(self, h: float) -> None:
        """Handle the event at the end of a step of `h` [s]; raise SimulationError for chattering."""
        cause, self.cause = self.cause, ""
        self.event_counts[cause] += 1
        self._events.append(self.reached)
        if len(self._events) == self._events.maxlen and self._events[-1] - self._events[0] <= CHATTERING_SHARE * h:
            span = f"{CHATTERING_SHARE * h:.2g} s"
            fault = f"it chatters: {len(self._events)} events within {span}, so that time stands still"
            raise SimulationError(self.name, self.reached, fault)
        before = self._point() if cause == "step" else None
        self.event()
        if before is None or self._point() != before:  # otherwise the solution continues smoothly
            self.solver.reset(self.reached)

    def _point(self) -> tuple[list[float], ...]:
        """Return continuous states, their derivatives and the event indicators."""
        states = self.save_state()[1]
        indicators = self._indicators(self.reached, states) if self._indicator_count else []
        return states, self._rates(), indicators

    def update(self) -> None:
        """Update discrete states until none changes, and store the time of the next time event."""
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
            self._enter("ContinuousTime")  # A time event that is due now is handled separately.
            self._enter("Event")
        fault = f"its discrete states do not settle: they still change after {MOST_EVENTS} updates at one time"
        if due is not None and due <= self.reached:
            fault = (
                f"{MOST_EVENTS} times in a row it gives t = {due:.6g} s as the time of its next event, which is "
                "not in the future; the FMU must give a later time or none"
            )
        raise SimulationError(self.name, self.reached, fault)

    def state_references(self) -> list[int]:
        """Return the states' value references. FMUs of FMI 1.0 declare them only at run time, if at all."""
        from fmpy.fmi1 import FMICallException

        count = self.description.numberOfContinuousStates
        references = (ctypes.c_uint * count)(*[NO_VARIABLE] * count)
        with contextlib.suppress(FMICallException):  # Some exporting tools do not implement the function.
            self.fmu.getStateValueReferences(references, count)
        return list(references)


def _is_hidden(begin: float, ahead: float, end: float, *, was: bool) -> bool:
    """Return True if an indicator changes its sign twice within a step, which hides both crossings.

    Args:
        ahead: Indicator shortly after the beginning, extrapolated by its slope.
        was: Result for a longer step. If it was True, the indicator must only move towards zero.
    """
    leaves = (ahead > 0.0) != (begin > 0.0) or (was and (ahead <= begin if begin > 0.0 else ahead >= begin))
    return leaves and (end > 0.0) == (begin > 0.0)
