"""FMUs of FMI 3.0 that are stepped with event mode and clocks.

Between events such an FMU is in step mode. It may return early from a step, because of an event or on request. At each
communication point and each event, the master calls

    enter, (tick)*, (put, get, fired)*, update, [(tick)*, (put, get, fired)*, update]*, leave

on every FMU concerned. Discrete inputs and clocked variables are set and read only there; clocked variables only while
one of their clocks ticks.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from cosim.blocks.component import Row, Signal
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.instance import Instance, end_of
from cosim.core.errors import FmuError, SimulationError, Terminated
from cosim.files.archive import description_of
from cosim.fmi.description import takes_any_step
from cosim.fmi.fmi_types import Exchange, element_names

ClockKind = Literal["constant", "fixed", "tunable", "changing", "countdown", "triggered"]
PERIODIC = ("constant", "fixed", "tunable")
CLOCK_NUMBERS = {"intervalDecimal", "intervalCounter", "resolution", "shiftDecimal", "shiftCounter", "priority"}
LOWEST = 2**31  # priority of a clock without one: after all others


@dataclass(frozen=True)
class Clock:
    """A clock that an FMU declares.

    Attributes:
        interval: Declared interval [s]; None if the FMU computes it.
        priority: Order of model partitions that are due at the same time; the smallest number is first.
        clocks: Names of the clocks that trigger this clock.
    """

    name: str
    reference: int
    kind: ClockKind
    causality: str
    interval: float | None = None
    shift: float = 0.0
    priority: int = LOWEST
    clocks: frozenset[str] = frozenset()


def read_clocks(path: Path, description: Any) -> dict[str, Clock]:
    """Return the clocks of an FMU by name.

    The description is read here, because FMPy reads neither intervals nor priorities.

    Raises:
        FmuError: An interval, a shift or a priority is not a number, or a period is not above 0.
    """
    variables = {v.name: v for v in description.modelVariables if v.type == "Clock"}
    if not variables:
        return {}
    root = ElementTree.fromstring(description_of(path))
    types = {node.get("name"): node.attrib for node in root.iter("ClockType")}
    clocks = {}
    for node in root.iter("Clock"):
        if (variable := variables.get(node.get("name"))) is None:
            continue
        attributes = {**types.get(node.get("declaredType"), {}), **node.attrib}
        kind, interval, shift = attributes.get("intervalVariability", "triggered"), None, math.nan
        with suppress(ValueError, ArithmeticError):  # text, or a resolution of 0
            numbers = {key: float(attributes[key]) for key in CLOCK_NUMBERS & attributes.keys()}
            resolution, interval = numbers.get("resolution", 1.0), numbers.get("intervalDecimal")
            if interval is None and "intervalCounter" in numbers:
                interval = numbers["intervalCounter"] / resolution
            priority = int(numbers.get("priority", LOWEST))
            shift = numbers.get("shiftDecimal") or numbers.get("shiftCounter", 0.0) / resolution
        if not math.isfinite(shift) or (kind in PERIODIC and interval is not None and not 0.0 < interval < math.inf):
            reason = f"interval, shift and priority of clock {variable.name} must be numbers, a period above 0 s"
            raise FmuError(f"{path} is not a valid FMU: {reason}")
        clocks[variable.name] = Clock(
            variable.name,
            variable.valueReference,
            kind,  # type: ignore[arg-type]  # checked by FMPy against the schema
            variable.causality,
            interval if kind in PERIODIC else None,
            shift,
            priority,
            frozenset(clock.name for clock in variable.clocks or ()),
        )
    return clocks


@dataclass
class Timer:
    """Times of a clock's ticks, computed as base + count·interval.

    Attributes:
        base: Time [s] of tick 0 of the current interval; infinity if unknown.
        count: Number of ticks since `base`.
        interval: Current interval [s]; None: only the tick at `base` is known.
        times: Times of all ticks [s], if the scenario lists them.
    """

    base: float = math.inf
    count: int = 0
    interval: float | None = None
    times: Sequence[float] = ()

    @property
    def next(self) -> float:
        """Return the time [s] of the next tick, or infinity if there is none."""
        if self.times:
            return self.times[self.count] if self.count < len(self.times) else math.inf
        if self.interval is None and self.count > 0:
            return math.inf
        return self.base + self.count * (self.interval or 0.0)

    def begin(self, base: float, interval: float | None = None, count: int = 0) -> None:
        """Start the timer: a single tick at `base` [s], or a tick every `interval` [s] from number `count` on."""
        self.base, self.count, self.interval = base, count, interval


NOT_YET_KNOWN, UNCHANGED, CHANGED = range(3)  # fmi3IntervalQualifier
TICK_NOW = 1e-9  # share of an interval; a tick that is closer in time is due
INITIALIZATION, EVENT, STEP = "initialization", "event", "step"


class EventInstance(Instance):
    """An FMU instance for FMI 3.0 co-simulation with event mode.

    Attributes:
        may_return: True if early return is allowed; the FMU must accept variable communication step sizes.
        in_small_steps: True if the FMU is asked to return after each of its internal steps.
        stop: Interruption of the run that occurred during a step.
    """

    in_small_steps = False
    stop: BaseException | None = None

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self.may_return = takes_any_step(description)

    def make_instance(self, logging: bool, **options: Any) -> None:
        options |= {"eventModeUsed": True, "earlyReturnAllowed": self.may_return}
        if self.about.providesIntermediateUpdate:
            options["intermediateUpdate"] = self._update_between
        super().make_instance(logging, **options)

    def _update_between(self, *arguments: Any) -> None:
        """Request an early return from a step, after an interruption or after each internal step of the FMU.

        No values are set or read, since inputs are constant during a step and rows are recorded at communication
        points.

        Args:
            arguments: Arguments of fmi3IntermediateUpdateCallback.
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
        output_clocks: Clocks whose ticks the FMU determines.
        timers: Timers of the clocks that tick at known times.
        reached: Time [s] up to which the FMU has been stepped; later than the master's time if another FMU returned
            early.
        next_event: Time [s] of the next event that the FMU announced; infinity without one.
        asks: True if the FMU has requested event mode.
        active: Clocks that tick at the current event or communication point.

    Args:
        timings: Clock → `interval`, `shift` and `at` of its ticks [s], from the scenario.
        jumping: Inputs whose sources change discontinuously.
    """

    clock_types = frozenset({"Clock"})
    instance_class = EventInstance
    steps = True  # False if the FMU is not stepped (scheduled execution)
    instance: EventInstance

    def __init__(
        self,
        name: str,
        path: Path,
        description: Any,
        start: Mapping[str, Any],
        connected: frozenset[str],
        *,
        timings: Mapping[str, Any] | None = None,
        jumping: frozenset[str] = frozenset(),
        **settings: Any,
    ) -> None:
        self.clocks = read_clocks(path, description)
        self.output_clocks = [c for c in self.clocks.values() if c.causality != "input"]
        self.timings, self._jumping = dict(timings or {}), jumping
        self._places: dict[str, int] = {}  # clock → index of its number of ticks
        self._reset(0.0)
        super().__init__(name, path, description, start, connected, **settings)
        self.may_return = self.instance.may_return
        self._steady = [e for e in self.fed if not self._is_jumping(e.variables[0])]
        self._discrete = [e for e in self.fed if e not in self._steady and not e.clocks]

    def _reset(self, start: float) -> None:
        self.timers: dict[str, Timer] = {}
        self.mode, self.reached, self.next_event, self.asks = INITIALIZATION, start, math.inf, False
        self.active: set[str] = set()
        self._changes: dict[str, Any] = {}  # values from the scenario's events, to be set at the next instant
        self._given: dict[Exchange, list[Any]] = {}  # last values set of each input
        self._seen: list[list[Any]] = []

    # -- description ----------------------------------------------------------------------------

    def _choose_variables(self, recorded: frozenset[str]) -> None:
        inputs, others = list[Signal](), list[Signal]()
        for c in self.clocks.values():
            is_ticked_here = c.causality == "input" and c.kind == "triggered" and c.name not in self.timings
            clocks = inputs if is_ticked_here else others
            clocks.append(Signal(c.name, kind="Clock", local=c.causality not in {"input", "output"}))

        def part(variable: Any) -> tuple[frozenset[str], bool]:
            clocks = frozenset(clock.name for clock in variable.clocks or ())
            return clocks, variable.causality == "input" and self._is_jumping(variable)

        self.list_variables(self.connected, recorded, part=part, clocks=(tuple(inputs), tuple(others)))

    def _is_jumping(self, variable: Any) -> bool:
        """Return True if an input is discrete or clocked."""
        if variable.type not in ("Float64", "Float32") or variable.variability not in (None, "continuous"):
            return True
        return bool(variable.clocks) or not self._jumping.isdisjoint({variable.name, *element_names(variable)})

    def ask_for_small_steps(self) -> None:
        """Ask the FMU to return after each of its internal steps, if the FMU supports this."""
        about = self.instance.about
        self.instance.in_small_steps = about.providesIntermediateUpdate and about.canReturnEarlyAfterIntermediateUpdate

    def settles(self, name: str) -> bool:
        """Return True if values of an input are exchanged at each instant until they no longer change."""
        variable = self.variables.get(name) or self.variables[name.rpartition("[")[0]]
        return not self.steps or self._is_jumping(variable)

    # -- initialization ----------------------------------------------------------------------------

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        super().bind(row, first, beside, first_beside)
        ends = first + len(self.inputs), first + len(self.inputs) + len(self.outputs)
        for clocks, end in zip((self.clock_inputs, self.clock_outputs), ends, strict=True):
            self._places |= {c.name: end - len(clocks) + k for k, c in enumerate(clocks)}

    def begin(self, start: float, stop: float) -> None:
        self._reset(start)
        super().begin(start, stop)
        self.show([e for e in self.read if e.clocks], {}, completed=True)

    def start(self) -> None:
        instance, start = self.instance, self.instance.start_time
        with instance.check_calls():
            for clock in self.clocks.values():
                timing = self.timings.get(clock.name)
                # The interval of the scenario, otherwise that of the FMU, applies.
                if clock.kind == "triggered":
                    if timing is not None:
                        first = start + (timing.shift or 0.0)
                        self.timers[clock.name] = Timer(first, interval=timing.interval, times=timing.at)
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
            self._do_step = instance.step_function()

    # -- values --------------------------------------------------------------------------------------

    def put(self) -> None:
        """Set changed inputs that may be set in the current mode."""
        for exchange in self._changed_inputs():
            self.put_in(exchange)

    def _changed_inputs(self) -> list[Exchange]:
        """Return the changed inputs that may be set in the current mode, and record their values."""
        changed = []
        for exchange in self.fed if self.mode != STEP else self._steady:
            if not exchange.clocks or exchange.clocks & self.active:
                content = self.content(exchange)
                if self.mode == INITIALIZATION or self._given.get(exchange) != content:
                    self._given[exchange] = content
                    changed.append(exchange)
        return changed

    def get(self) -> None:
        """Read the outputs that may be read in the current mode."""
        for exchange in self.read:
            if not exchange.clocks or exchange.clocks & self.active:
                self.get_from(exchange)

    @property
    def has_jumped(self) -> bool:
        """Return True if a discrete input has a new value."""
        return any(self.content(e) != self._given.get(e) for e in self._discrete)

    def look(self) -> None:
        """Record the inputs of this instant, for `is_stirred`."""
        self._seen = self._inputs()

    @property
    def is_stirred(self) -> bool:
        """Return True if inputs have changed since `look`."""
        return self._inputs() != self._seen

    def _inputs(self) -> list[list[Any]]:
        return [self.content(e) for e in self.fed if not e.clocks]

    def change(self, values: Mapping[str, Any]) -> None:
        """Store values from an event of the scenario, to be set at the next instant."""
        self._changes |= values
        self.asks = True

    # -- steps ------------------------------------------------------------------------------------

    def go(self, target: float) -> float:
        """Step towards a time [s]; return the time reached, which is earlier after an early return.

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
        """Return the time [s] of the next event or tick that is known in advance."""
        return min((self.next_event, *(timer.next for timer in self.timers.values())))

    def due_clocks(self, t: float, close: float) -> list[str]:
        """Return the clocks with a tick at `t` [s], within the tolerance `close` [s], ordered by priority."""
        due = [name for name, timer in self.timers.items() if timer.next <= t + close]
        return sorted(due, key=lambda name: self.clocks[name].priority)

    def enter(self) -> None:
        """Enter event mode, and set the values from events of the scenario."""
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
                self.set_variables(changes)
            self.show_changes(changes)

    def tick(self, names: Collection[str]) -> None:
        """Activate input clocks by name."""
        self.instance.call("setClock", [self.clocks[name].reference for name in names], [True] * len(names))
        self._count(names)

    def _count(self, names: Collection[str]) -> None:
        self.active |= set(names)
        self._forget(names)
        for name in names:
            self._row[self._places[name]] += 1.0
            if name in self.timers:
                self.timers[name].count += 1

    def _forget(self, clocks: Collection[str]) -> None:
        """Mark the inputs of ticking clocks as changed, since they must be set at each tick, even if unchanged."""
        for exchange in self.fed:
            if not exchange.clocks.isdisjoint(clocks):
                self._given.pop(exchange, None)

    def fired(self) -> list[str]:
        """Return the output clocks that have ticked since the last call."""
        idle = [c for c in self.output_clocks if c.name not in self.active]
        idle = [c for c in idle if not c.clocks or c.clocks & self.active]
        names = self._ticking(idle)
        self._count(names)
        return names

    def _ticking(self, clocks: Sequence[Clock]) -> list[str]:
        """Return the names of the clocks in `clocks` that tick now, asked of the FMU."""
        states = self.instance.call("getClock", [c.reference for c in clocks]) if clocks else []
        return [clock.name for clock, is_active in zip(clocks, states, strict=True) if is_active]

    def update(self) -> bool:
        """Update discrete states; return True if another update is needed.

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
        """Read the intervals of clocks whose interval may have changed."""
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
        """Return the interval qualifier and the interval [s] of a clock."""
        interval, qualifier = ctypes.c_double(), ctypes.c_int()
        self.instance.fmu.getIntervalDecimal(
            (ctypes.c_uint * 1)(clock.reference), ctypes.byref(interval), ctypes.byref(qualifier)
        )
        return qualifier.value, interval.value

    def _set_interval(self, clock: Clock, interval: float) -> None:
        self.instance.fmu.setIntervalDecimal((ctypes.c_uint * 1)(clock.reference), (ctypes.c_double * 1)(interval))

    def _checked(self, clock: Clock, interval: float) -> float:
        """Return an interval [s]; raise SimulationError unless it is finite and above 0, or 0 and not periodic."""
        if math.isfinite(interval) and (interval > 0.0 or (interval == 0.0 and clock.kind not in PERIODIC)):
            return interval
        message = f"its interval is {interval:g} s; it must be above 0 s for a periodic clock, at least 0 s for others"
        raise SimulationError(f"{self.name}.{clock.name}", self.instance.time, message)


# Clocks activate model partitions in the order of priority. Partitions run one after another and are never interrupted,
# so the FMU's locks against preemption are not needed.


class ScheduledInstance(EventInstance):
    """An FMU instance for FMI 3.0 scheduled execution.

    Attributes:
        on_update: Function called when the FMU reports that a clock has changed.
    """

    fmpy_class, way = "ScheduledExecution", "scheduled-execution"

    on_update: Any = staticmethod(lambda: None)

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self.may_return = False

    def make_instance(self, logging: bool, **options: Any) -> None:
        from fmpy.fmi3 import fmi3ClockUpdateCallback

        self._update = fmi3ClockUpdateCallback(lambda _: self.on_update())  # kept as long as the FMU exists
        instantiate = self.fmu.fmi3InstantiateScheduledExecution

        def with_updates(*arguments: Any) -> Any:  # argument 7 is the callback; that of FMPy ignores updates of clocks
            return instantiate(*arguments[:7], self._update, *arguments[8:])

        self.fmu.fmi3InstantiateScheduledExecution = with_updates
        Instance.make_instance(self, logging, **options)  # the options of EventInstance are for co-simulation only


class ScheduledFmu(EventFmu):
    """An FMU for scheduled execution."""

    instance_class = ScheduledInstance
    steps = False
    has_jumped = is_stirred = False  # The partitions read the inputs when they run.
    instance: ScheduledInstance

    def start(self) -> None:
        super().start()
        self._fired: list[str] = []
        self._last: dict[str, float] = {}  # clock → time of its last activation [s]
        self._failure: BaseException | None = None
        self.instance.on_update = self._on_update

    def put(self) -> None:
        """Set the inputs during initialization only."""
        if self.mode == INITIALIZATION:
            super().put()

    def get(self) -> None:
        """Read the outputs during initialization only."""
        if self.mode == INITIALIZATION:
            super().get()

    def go(self, target: float) -> float:
        """Return the target time; the FMU is not called."""
        self.reached = self.instance.time = target
        return target

    def tick(self, names: Collection[str]) -> None:
        """Run the partitions of clocks in the order of priority.

        Clocks that a partition activates are inserted by their priority.
        """
        t = self.instance.time
        waiting = [*names]
        while waiting:
            name = min(waiting, key=lambda clock: self.clocks[clock].priority)
            waiting.remove(name)
            self._activate(name, t)
            waiting = [*(c for c in self.due_clocks(t, 0.0) if c != name and c not in waiting), *waiting]

    def _activate(self, name: str, t: float) -> None:
        """Set the inputs of a partition, run the partition, and read its outputs."""
        if self._last.get(name, -math.inf) >= t:
            self.instance.remember(
                f"clock {name} was due twice at t = {t:.6g} s; FMI allows one activation at a time, so one was omitted"
            )
            if name in self.timers:
                self.timers[name].count += 1
            return
        self._last[name] = t
        self.active = set()
        self._count([name])
        super().put()
        self.instance.call("activateModelPartition", self.clocks[name].reference, t)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        super().get()
        self._read_intervals()

    def _on_update(self) -> None:
        """Read which clocks the partition has changed."""
        try:
            self._read_intervals()
            self._fired += self._ticking([c for c in self.output_clocks if c.name not in self._fired])
        except BaseException as failure:  # Exceptions cannot pass through C.
            self._failure = failure

    def fired(self) -> list[str]:
        """Return the output clocks activated since the last call."""
        names, self._fired = self._fired, []
        for name in names:
            self._row[self._places[name]] += 1.0
        return names

    def update(self) -> bool:
        """Return False: after a partition, no update of discrete states follows."""
        self.active = set()
        return False

    def leave(self) -> None:
        """Do nothing: scheduled execution has no step mode."""
        self.active = set()
