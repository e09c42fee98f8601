"""FMUs of FMI 3.0 that are stepped with event mode and clocks.

Between events such an FMU is in step mode. It may return early from a step, because of an event or because it was asked
to. At an instant (a communication point or an event) the master calls

    enter, (tick)*, (put, get, fired)*, update, [(tick)*, (put, get, fired)*, update]*, leave

on every FMU that takes part. Discrete inputs and clocked variables are set and read there only, clocked variables while
one of their clocks ticks.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from cosim.blocks.clocks import PERIODIC, Clock, Timer, Timing, read_clocks
from cosim.blocks.component import Row, Signal
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.instance import STEPS, Instance, end_of
from cosim.blocks.values import Values
from cosim.core.errors import SimulationError, Terminated
from cosim.fmi.description import Way, takes_any_step
from cosim.fmi.fmi_types import Exchange, element_names

NOT_YET_KNOWN, UNCHANGED, CHANGED = range(3)  # fmi3IntervalQualifier
TICK_NOW = 1e-9  # fraction of an interval within which a tick is due
INITIALIZATION, EVENT, STEP = "initialization", "event", "step"


class EventInstance(Instance):
    """An FMU instance for FMI 3.0 co-simulation with event mode.

    Attributes:
        may_return: Whether the FMU may return early from a step. An FMU with steps of one length may not.
        in_small_steps: Whether the FMU is asked to return after each of its own steps.
        stop: Interruption of the run that arrived during a step.
    """

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self.may_return = takes_any_step(description)
        self.in_small_steps = False
        self.stop: BaseException | None = None

    def make_instance(self, logging: bool, **options: Any) -> None:
        options |= {"eventModeUsed": True, "earlyReturnAllowed": self.may_return}
        if self.about.providesIntermediateUpdate:
            options["intermediateUpdate"] = self._update_between
        super().make_instance(logging, **options)

    def _update_between(self, *arguments: Any) -> None:
        """Ask for an early return where one is due.

        It is due after an interruption, or after each own step of the FMU.

        No values are set or read: inputs are constant during a step, and rows belong to communication points.

        Args:
            arguments: Those of fmi3IntermediateUpdateCallback.
        """
        _, t, _, _, is_finished, can_return, is_asked, at = arguments
        try:
            is_asked[0] = can_return and (self.stop is not None or (self.in_small_steps and is_finished))
            at[0] = t
        except (KeyboardInterrupt, Terminated) as stop:  # Exceptions cannot pass through C.
            self.stop = stop


class EventFmu(FmuBlock):
    """A co-simulation FMU with event mode and clocks.

    Attributes:
        clocks: Declared clocks by name.
        output_clocks: Clocks that the FMU ticks by itself.
        timers: Timers of the clocks that tick at known times.
        reached: Time [s] to which the FMU has come; ahead of the master after an early return of another FMU.
        next_event: Time [s] of the next event that the FMU announced; infinity without one.
        asks: Whether the FMU asked for event mode.
        active: Clocks that tick at the current instant.

    Args:
        timings: Clock → times stated by the scenario.
        jumping: Inputs whose values jump, because their sources do.
    """

    clock_types = frozenset({"Clock"})
    steps = True  # whether time passes in steps
    instance: EventInstance

    def __init__(
        self,
        name: str,
        path: Path,
        description: Any,
        start: Mapping[str, Any],
        connected: frozenset[str],
        *,
        timings: Mapping[str, Timing] | None = None,
        jumping: frozenset[str] = frozenset(),
        **settings: Any,
    ) -> None:
        self.clocks = read_clocks(path, description)
        self.output_clocks = [c for c in self.clocks.values() if c.causality != "input"]
        self.timings, self._jumping = dict(timings or {}), jumping
        self.timers: dict[str, Timer] = {}
        self.mode, self.reached, self.next_event, self.asks = INITIALIZATION, 0.0, math.inf, False
        self.active: set[str] = set()
        self._changes: dict[str, Any] = {}  # values of the scenario's events, to set at the next instant
        self._given: dict[Exchange, list[Any]] = {}  # inputs as last set
        self._seen: list[list[Any]] = []
        self._places: dict[str, int] = {}  # places of the numbers of ticks
        super().__init__(name, path, description, start, connected, **settings)
        self.may_return = self.instance.may_return
        self._steady = [e for e in self._values.fed if not self._is_jumping(e.variables[0])]
        self._discrete = [e for e in self._values.fed if e not in self._steady and not e.clocks]

    # -- description ----------------------------------------------------------------------------

    def _instance_class(self, way: Way | None) -> type[Instance]:
        return EventInstance

    def _make_values(self, recorded: frozenset[str]) -> Values:
        inputs, others = list[Signal](), list[Signal]()
        for c in self.clocks.values():
            is_ticked_here = c.causality == "input" and c.kind == "triggered" and c.name not in self.timings
            clocks = inputs if is_ticked_here else others
            clocks.append(Signal(c.name, kind="Clock", local=c.causality not in {"input", "output"}))

        def part(variable: Any) -> tuple[frozenset[str], bool]:
            clocks = frozenset(clock.name for clock in variable.clocks or ())
            return clocks, variable.causality == "input" and self._is_jumping(variable)

        both = tuple(inputs), tuple(others)
        return Values(self.instance, self.connected, recorded, part=part, clocks=both)

    def _is_jumping(self, variable: Any) -> bool:
        """Return whether an input is discrete or clocked."""
        if variable.type not in ("Float64", "Float32") or variable.variability not in (None, "continuous"):
            return True
        return bool(variable.clocks) or not self._jumping.isdisjoint({variable.name, *element_names(variable)})

    def ask_for_small_steps(self) -> None:
        """Ask the FMU to return after each of its own steps, if it can."""
        about = self.instance.about
        self.instance.in_small_steps = about.providesIntermediateUpdate and about.canReturnEarlyAfterIntermediateUpdate

    def settles(self, name: str) -> bool:
        """Return whether values of an input are exchanged until they settle, at each instant."""
        variable = self._variables.get(name) or self._variables[name.rpartition("[")[0]]
        return not self.steps or self._is_jumping(variable)

    # -- initialization ----------------------------------------------------------------------------

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        super().bind(row, first, beside, first_beside)
        ends = first + len(self.inputs), first + len(self.inputs) + len(self.outputs)
        for clocks, end in zip((self._values.clock_inputs, self._values.clock_outputs), ends, strict=True):
            self._places |= {c.name: end - len(clocks) + k for k, c in enumerate(clocks)}

    def begin(self, start: float, stop: float) -> None:
        self.timers, self.mode, self.reached = {}, INITIALIZATION, start
        self.next_event, self.asks, self.active = math.inf, False, set()
        self._changes, self._given, self._seen = {}, {}, []
        super().begin(start, stop)
        self._values.show_outputs([e for e in self._values.read if e.clocks])

    def start(self) -> None:
        instance, start = self.instance, self.instance.start_time
        with instance.check_calls():
            for clock in self.clocks.values():
                timing = self.timings.get(clock.name)
                # The interval is the one that the scenario states, or that of the FMU.
                if clock.kind == "triggered":
                    if timing is not None:
                        first = start + (timing.shift or 0.0)
                        self.timers[clock.name] = Timer(first, interval=timing.interval, times=timing.at, is_set=True)
                    continue
                self.timers[clock.name] = timer = Timer()
                interval = clock.interval
                if timing is not None and timing.interval is not None:
                    interval = timing.interval
                    self._set_interval(clock, interval)
                if interval is not None:
                    timer.begin(start + clock.shift, interval)
                    continue
                qualifier, interval = self._interval(clock)
                if clock.kind in PERIODIC:
                    shift = (ctypes.c_double * 1)()
                    self.instance.fmu.getShiftDecimal((ctypes.c_uint * 1)(clock.reference), shift)
                    interval = math.nan if qualifier == NOT_YET_KNOWN else interval
                    timer.begin(start + float(shift[0]), self._checked(clock, interval))
                elif qualifier != NOT_YET_KNOWN:
                    timer.begin(start + self._checked(clock, interval))
            instance.leave()
        instance.initialized = True
        self.reached, self.mode, self.active = start, EVENT, set()
        if self.steps:
            self._do_step = instance.bare(STEPS[3], "DoStep")

    # -- values --------------------------------------------------------------------------------------

    def put(self) -> None:
        """Set changed inputs, as far as the mode allows."""
        for exchange in self._changed_inputs():
            self._values.put_in(exchange)

    def _changed_inputs(self) -> list[Exchange]:
        """Note the inputs, as far as the mode allows; return those to set."""
        changed = []
        for exchange in self._values.fed if self.mode != STEP else self._steady:
            if not exchange.clocks or exchange.clocks & self.active:
                content = self._values.content(exchange)
                if self.mode == INITIALIZATION or self._given.get(exchange) != content:
                    self._given[exchange] = content
                    changed.append(exchange)
        return changed

    def get(self) -> None:
        """Read outputs, as far as the mode allows."""
        for exchange in self._values.read:
            if not exchange.clocks or exchange.clocks & self.active:
                self._values.get_from(exchange)

    @property
    def has_jumped(self) -> bool:
        """Return whether a discrete input has a new value."""
        return any(self._values.content(e) != self._given.get(e) for e in self._discrete)

    def look(self) -> None:
        """Remember the inputs of this instant."""
        self._seen = self._inputs()

    @property
    def is_stirred(self) -> bool:
        """Return whether inputs have changed since `look`."""
        return self._inputs() != self._seen

    def _inputs(self) -> list[list[Any]]:
        return [self._values.content(e) for e in self._values.fed if not e.clocks]

    def change(self, values: Mapping[str, Any]) -> None:
        """Keep an event's values for the next instant."""
        self._changes |= values
        self.asks = True

    # -- steps ------------------------------------------------------------------------------------

    def go(self, target: float) -> float:
        """Step to a time [s]; return the time reached.

        Raises:
            EarlyEnd: The FMU ended the simulation.
        """
        instance = self.instance
        status = int(self._do_step(instance.component, self.reached, target - self.reached, True, *instance.flags))
        stop, instance.stop = instance.stop, None
        if stop is not None:
            raise stop
        if status:
            instance.time = self.reached
            instance.judge(instance.step_name, status)
        self.reached = min(target, instance.last.value) if instance.is_early.value else target
        instance.time = self.reached
        if instance.ends.value:
            raise end_of(self.name, self.reached)
        self.asks = self.asks or bool(instance.is_event.value)
        return self.reached

    def save_state(self) -> Any:
        return super().save_state(), self.reached, self.asks, dict(self._given)

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        fmu, self.reached, self.asks, given = state
        self._given = dict(given)
        super().restore_state(fmu, keep=True)
        self.instance.time = self.reached
        if not keep:
            self.free_state(state)

    def free_state(self, state: Any) -> None:
        super().free_state(state[0])

    # -- events -------------------------------------------------------------------------------------

    @property
    def due(self) -> float:
        """Return the time [s] of the next known event."""
        return min((self.next_event, *(timer.next for timer in self.timers.values())))

    def due_clocks(self, t: float, close: float) -> list[str]:
        """Return the clocks due at `t` [s] by priority."""
        due = [name for name, timer in self.timers.items() if timer.next <= t + close]
        return sorted(due, key=lambda name: self.clocks[name].priority)

    def enter(self) -> None:
        """Enter event mode; set the scenario's values."""
        if self.mode != EVENT:
            self.instance.call("enterEventMode")
            self.mode, self.active = EVENT, set()
        self.asks = False
        changes, self._changes = self._changes, {}
        for name in changes.keys() & self.clocks.keys():
            interval = changes.pop(name)
            with self.instance.check_calls():
                self._set_interval(self.clocks[name], interval)
            timer, t = self.timers[name], self.instance.time
            timer.begin(t, interval, 0 if timer.next <= t + TICK_NOW * interval else 1)
        if changes:
            with self.instance.check_calls():
                self._values.set(changes)
            self._values.show_changes(changes)

    def tick(self, names: Collection[str]) -> None:
        """Activate input clocks."""
        self.instance.call("setClock", [self.clocks[name].reference for name in names], [True] * len(names))
        self._count(names)

    def _count(self, names: Collection[str]) -> None:
        self.active |= set(names)
        self._forget(names)
        for name in names:
            self._values.row[self._places[name]] += 1.0
            if name in self.timers:
                self.timers[name].count += 1

    def _forget(self, clocks: Collection[str]) -> None:
        """Forget the inputs of clocks that tick: they are set at each tick, also with the value of the last one."""
        for exchange in self._values.fed:
            if not exchange.clocks.isdisjoint(clocks):
                self._given.pop(exchange, None)

    def fired(self) -> list[str]:
        """Return output clocks that tick since the last call."""
        idle = [c for c in self.output_clocks if c.name not in self.active]
        idle = [c for c in idle if not c.clocks or c.clocks & self.active]
        if not idle:
            return []
        states = self.instance.call("getClock", [c.reference for c in idle])
        names = [clock.name for clock, is_active in zip(idle, states, strict=True) if is_active]
        self._count(names)
        return names

    def update(self) -> bool:
        """Update discrete states; return whether to repeat.

        Raises:
            EarlyEnd: The FMU ended the simulation.
        """
        more, ends, _, _, is_announced, time = self.instance.call("updateDiscreteStates")
        if ends:
            raise end_of(self.name, self.instance.time)
        self.next_event = time if is_announced else math.inf
        self._read_intervals()
        self.active = set()
        return bool(more)

    def leave(self) -> None:
        """Return to step mode."""
        self.instance.call("enterStepMode")
        self.mode, self.active = STEP, set()

    # -- intervals ----------------------------------------------------------------------------------

    def _read_intervals(self) -> None:
        """Read intervals that may have changed."""
        t = self.instance.time
        for clock in self.clocks.values():
            if clock.interval is not None or clock.kind not in ("tunable", "changing", "countdown"):
                continue
            if clock.kind == "changing" and clock.name not in self.active:
                continue
            with self.instance.check_calls():
                qualifier, interval = self._interval(clock)
            timer = self.timers[clock.name]
            if clock.kind == "tunable":
                if qualifier == CHANGED:
                    timer.begin(t, self._checked(clock, interval), 1)
            elif qualifier == CHANGED or (clock.kind == "changing" and qualifier == UNCHANGED):
                timer.begin(t + self._checked(clock, interval))

    def _interval(self, clock: Clock) -> tuple[int, float]:
        """Return qualifier and interval [s] of a clock."""
        interval, qualifier = ctypes.c_double(), ctypes.c_int()
        self.instance.fmu.getIntervalDecimal(
            (ctypes.c_uint * 1)(clock.reference), ctypes.byref(interval), ctypes.byref(qualifier)
        )
        return qualifier.value, interval.value

    def _set_interval(self, clock: Clock, interval: float) -> None:
        self.instance.fmu.setIntervalDecimal((ctypes.c_uint * 1)(clock.reference), (ctypes.c_double * 1)(interval))

    def _checked(self, clock: Clock, interval: float) -> float:
        """Return an interval; raise SimulationError if invalid."""
        if math.isfinite(interval) and (interval > 0.0 or (interval == 0.0 and clock.kind not in PERIODIC)):
            return interval
        message = f"its interval is {interval:g} s; a periodic clock needs one above 0, another clock one of 0 or more"
        raise SimulationError(f"{self.name}.{clock.name}", self.instance.time, message)
