"""Stepping of systems with event mode and clocks: from instant to instant instead of from row to row.

An instant is a communication point, a tick of a clock, or an event at which an FMU returned early from its step. All
components are stepped to it. Then the FMUs concerned enter event mode, and values and clocks are exchanged in
superdense time until nothing changes:

    enter, [tick, (put, get, fired)* until settled, update]* until no FMU needs another round, leave

Rows belong to communication points only and hold the values after the instant.

An early return ends the step of all. Components that have gone further go back by restoring their state. Therefore
components that can go back step first, then those that may return early, then all others. Where two may return early
and cannot go back, the one that did so last steps first; the other may be ahead of an event, which a note tells. A
component that takes only steps of one length gets an event within a step at the end of the step.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.component import Component
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.model_exchange import AT_ONCE, CLOSE, MOST_EVENTS, ULPS, ModelExchange2
from cosim.blocks.sources import SourceBlock
from cosim.isolation.rows import ADVANCE, CALLS, GET, OTHER, PUT
from cosim.master.copying import Copies, Copying, copy_values, doubles
from cosim.master.initialization import EXACT_SWEEPS, is_settled
from cosim.master.loops import LoopSolver
from cosim.master.step_control import ControlledSteps
from cosim.storage.results import Results
from cosim.system.event_blocks import is_exchange, takes_part_of_step
from cosim.system.system import System

MOST_SWEEPS = 1000  # exchanges of values at one instant of superdense time
MOST_RECORDED = 1000  # events that the record of a run holds
SOURCES, REPEATABLE, EARLY, LAST = range(4)  # ranks of the order within a step


class EventRun(Protocol):
    """The part of a `Master` that the stepping uses."""

    system: System
    components: list[Component]
    steps: int
    h: float
    row: Any
    view: memoryview[float]
    beside: list[Any]
    copying: Copying
    pulls: Mapping[str, Copies]
    table: Array
    row_count: MutableSequence[int]
    doing: MutableSequence[int]
    done: int
    notes: list[str]
    controlled: ControlledSteps | None
    solvers: tuple[LoopSolver, ...]
    calls: tuple[Callable[[int], None], ...]

    def _next_call(self, k: int) -> int: ...

    def _apply_events(self, k: int) -> None: ...

    def look(self, k: int) -> None:
        """Make a due checkpoint after point k."""


@dataclass(eq=False)
class Part:
    """A component in the order of a step.

    Attributes:
        number: Number of the component among all, for observers.
        pulls: Copies before its step.
        time: Time [s] to which it has come.
        has_late: Whether known values are set after its step.
        rank: SOURCES, REPEATABLE, EARLY (may return early, cannot go back) or LAST.
        lead: Longest time [s] by which it was ahead of an event.
        late: Number of such events.
    """

    component: Any
    number: int
    pulls: Copies
    every: int
    is_flexible: bool
    time: float
    has_late: bool = False
    rank: int = LAST
    lead: float = 0.0
    late: int = 0

    def __post_init__(self) -> None:
        if isinstance(self.component, SourceBlock):
            self.rank = SOURCES
        elif isinstance(self.component, FmuBlock) and self.component.instance.rolls_back:
            self.rank = REPEATABLE
        elif self.exchange is not None:
            self.exchange.stops_at_events = True
            self.rank = REPEATABLE if self.exchange.goes_back else EARLY
        elif self.may_return:
            self.rank = EARLY

    @property
    def may_return(self) -> bool:
        """Return whether its steps may end early."""
        if isinstance(self.component, EventFmu):
            return self.is_flexible and self.component.may_return
        return self.exchange is not None

    @property
    def exchange(self) -> ModelExchange2 | None:
        """Return the calls of model exchange, if any."""
        calls = self.component.calls if self.is_flexible and isinstance(self.component, FmuBlock) else None
        return calls if isinstance(calls, ModelExchange2) else None

    def save(self) -> Any:
        """Return the state, None if not restorable."""
        if self.rank == SOURCES:
            return self.time
        if self.rank != REPEATABLE:
            return None
        if isinstance(self.component, EventFmu):
            return self.component.save()
        if self.exchange is not None:
            return self.exchange.save()
        return self.time, self.component.instance.save_state()

    def go_back(self, state: Any) -> None:
        """Take back a state."""
        if self.rank == SOURCES:
            self.time = state
        elif isinstance(self.component, EventFmu):
            self.component.go_back(state)
            self.time = self.component.reached
        elif self.exchange is not None:
            self.exchange.go_back(state)
            self.time = self.component.instance.time = self.exchange.time
        else:
            self.time, fmu = state
            self.component.instance.restore_state(fmu)

    def forget(self, state: Any) -> None:
        """Free a state that is not needed."""
        if self.rank == REPEATABLE and self.exchange is None:
            fmu = state[0] if isinstance(self.component, EventFmu) else state[1]
            self.component.instance.free_state(fmu)


@dataclass
class EventRecord:
    """Handled events and ticks of a run.

    Attributes:
        events: (time [s], component, cause), the first MOST_RECORDED.
        counts: (component, cause) → number.
    """

    events: list[tuple[float, str, str]] = field(default_factory=list)
    counts: dict[tuple[str, str], int] = field(default_factory=dict)

    def add_to(self, results: Results) -> Results:
        """Return results with the events."""
        counts: dict[str, dict[str, int]] = {}
        for (component, cause), count in sorted(self.counts.items()):
            counts.setdefault(component, {})[cause] = count
        return replace(results, events=tuple(self.events), event_counts=counts)

    def add(self, time: float, component: str, cause: str) -> None:
        """Add an event."""
        self.counts[component, cause] = self.counts.get((component, cause), 0) + 1
        if len(self.events) < MOST_RECORDED:
            self.events.append((time, component, cause))


class Instants:
    """The stepping of a run with event mode."""

    def __init__(self, master: EventRun) -> None:
        self.master, self.begin, self.h = master, master.system.start, master.h
        self.record = EventRecord()
        self.close = CLOSE * self.h
        parts = self._parts()
        self.flexible = [part for part in parts if part.is_flexible]
        self.rigid = [part for part in parts if not part.is_flexible]
        self.looped = {name for loop in master.system.loops for name in loop.members}
        self.events = [part for part in parts if isinstance(part.component, EventFmu)]
        self.exchanges = [part for part in parts if is_exchange(part.component)]
        self.by_name = {part.component.name: part for part in self.events}
        self.wires = self._clock_wires()
        self.ticked: dict[str, list[str]] = {}  # component → clocks that tick others as soon as outputs are read
        self.pending: dict[str, list[str]] = {}  # component → clocks to tick when it has come to the time
        self._times: deque[float] = deque(maxlen=MOST_EVENTS)
        self._apply_events = master._apply_events
        master.calls = tuple(call for call in master.calls if call != self._apply_events)
        self._sort()
        self._ask_for_small_steps()

    def _parts(self) -> list[Part]:
        """Return the components in the schedule's order."""
        master, stages = self.master, self.master.system.stages
        self.all = master.copying.of((*master.system.held, *(t for stage in stages for t in stage.transfers)))
        return [
            Part(
                stage.component,
                k,
                master.copying.of(stage.pulls),
                stage.every,
                takes_part_of_step(stage, master.system.loops),
                self.begin,
                has_late=bool(stage.late),
            )
            for k, stage in enumerate(stages)
        ]

    def _clock_wires(self) -> dict[tuple[str, str], list[tuple[str, str]]]:
        """Return clock → connected input clocks."""
        wires: dict[tuple[str, str], list[tuple[str, str]]] = {}
        for origin, target in self.master.system.clock_wires:
            owner, _, clock = origin.partition(".")
            goal, _, name = target.partition(".")
            wires.setdefault((owner, clock), []).append((goal, name))
        return wires

    def _sort(self) -> None:
        """Sort components by their rank."""
        if any(part.may_return for part in self.flexible):
            self.flexible.sort(key=lambda part: (part.rank, not self._ticks_others(part)))
        self.last_early = max((k for k, part in enumerate(self.flexible) if part.may_return), default=-1)

    @staticmethod
    def _ticks_others(part: Part) -> bool:
        """Return whether a component has output clocks."""
        return isinstance(part.component, EventFmu) and bool(part.component.output_clocks)

    def _ask_for_small_steps(self) -> None:
        """Bound the lead of FMUs that cannot go back."""
        alone = [part for part in self.flexible if part.rank == EARLY and isinstance(part.component, EventFmu)]
        if len(alone) > 1:
            for part in alone:
                part.component.ask_for_small_steps()

    # -- course ----------------------------------------------------------------------------------------

    def at_start(self) -> None:
        """Handle the instant at the start of the run."""
        t = self.begin
        for part in self.events:
            part.time = t
        self._apply_events(0)
        self._copy_all(0)
        for part in self.events:
            part.component.look()
        self._handle(t, 0, self.events, list(self.events))

    def run(self) -> None:
        """Make all steps."""
        master, row, width = self.master, self.master.view, len(self.master.view)
        table = doubles(master.table)
        call_point = master._next_call(1)
        try:
            for k in range(1, master.steps + 1):
                self._step_to_point(k, has_calls=k == call_point)
                if k == call_point:
                    for call in master.calls:
                        call(k)
                    call_point = master._next_call(k + 1)
                table[k * width : k * width + width] = row
                master.done = master.row_count[0] = k + 1
                master.look(k)
        finally:
            master.done = master.row_count[0]
            self._note_leads()
            if master.controlled is not None:
                master.controlled.note()

    def _advance_controlled(self, t: float, end: float, k: int) -> float:
        """Advance towards the next instant, no further than the control of the steps allows; return the time."""
        control, target = self.master.controlled, self._target(t, end)
        if control is None:
            return self._advance(target, k)
        reached = self._advance(control.limit(t, target, end), k)
        control.judge_step(t, reached)
        return reached

    def _step_to_point(self, k: int, *, has_calls: bool) -> None:
        begin, end = self.begin + (k - 1) * self.h, self.begin + k * self.h
        t = begin
        self.close = CLOSE * self.h + 2 * ULPS * math.ulp(max(abs(t), abs(end)))
        for part in self.rigid:
            if part.component.name in self.looped:
                copy_values(self.master.row, part.pulls, k)
            elif (k - 1) % part.every == 0:
                self._put(part, k)
        while True:
            t = self._advance_controlled(t, end, k)
            if t >= end - self.close:
                break
            self._instant(t, k - 1, [part for part in self.events if part.is_flexible])
        for part in self.rigid:
            if k % part.every == 0 and part.component.name not in self.looped:
                self._step_rigid(part, k, end)
        for solver in self.master.solvers:
            solver.step(begin, end - begin, k)
        if has_calls:
            self._apply_events(k)
        self._instant(end, k, self.events)

    def _target(self, t: float, end: float) -> float:
        """Return the time [s] of the next instant."""
        times = [end, *(part.time for part in self.flexible)]  # of components that are ahead
        times += [part.component.due for part in self.events if part.is_flexible]
        target = min(time for time in times if time > t + self.close)
        return end if target > end - self.close else target

    # -- steps ---------------------------------------------------------------------------------------

    def _advance(self, target: float, k: int) -> float:
        """Step to a time [s] or the first early return."""
        saved: dict[int, Any] = {}  # place in the order → state before the step
        while True:
            early: Part | None = None
            for place, part in enumerate(self.flexible):
                if target - part.time <= self.close:
                    continue
                if place <= self.last_early and self.last_early and (state := part.save()) is not None:
                    saved[place] = state
                if self._step(part, target, k) < target - self.close:
                    early = part
                    break
            if early is None:
                for place, state in saved.items():
                    self.flexible[place].forget(state)
                return target
            target = early.time
            self._take_back(saved, target, early)

    def _step(self, part: Part, target: float, k: int) -> float:
        self._put(part, k)
        component, doing = part.component, self.master.doing
        doing[0] = CALLS * part.number + ADVANCE
        if isinstance(component, EventFmu):
            part.time = component.go(target)
        else:
            component.advance(part.time, target - part.time)
            part.time = target
            if part.exchange is not None and part.exchange.cause:
                part.time = component.instance.time = part.exchange.time
        doing[0] = CALLS * part.number + GET
        component.get()
        return part.time

    def _step_rigid(self, part: Part, k: int, end: float) -> None:
        component, doing = part.component, self.master.doing
        since = self.begin + (k - part.every) * self.h
        doing[0] = CALLS * part.number + ADVANCE
        if isinstance(component, EventFmu):
            component.go(end)
        else:
            component.advance(since, part.every * self.h if component.nominal_step else end - since)
        part.time = end
        doing[0] = CALLS * part.number + GET
        component.get()

    def _put(self, part: Part, k: int) -> None:
        copy_values(self.master.row, part.pulls, k)
        self.master.doing[0] = CALLS * part.number + PUT
        part.component.put()

    def _take_back(self, saved: dict[int, Any], target: float, early: Part) -> None:
        """Take back components beyond an early return."""
        for place in [place for place in saved if self.flexible[place].time > target + self.close]:
            part = self.flexible[place]
            self.master.doing[0] = CALLS * part.number + OTHER
            part.go_back(saved.pop(place))
        ahead = [part for part in self.flexible if part.time > target + self.close]
        for part in ahead:
            part.lead, part.late = max(part.lead, part.time - target), part.late + 1
        if ahead and early.rank == EARLY:
            self.flexible.remove(early)
            self.flexible.insert(min(map(self.flexible.index, ahead)), early)

    def _note_leads(self) -> None:
        for part in self.flexible:
            if part.lead:
                note = (
                    f"{part.component.name} was up to {part.lead:.3g} s ahead of an event of another FMU, "
                    f"because both may return early from a step and it cannot go back: it got {part.late} such "
                    "events that much later. A shorter step of the scenario shortens this"
                )
                self.master.notes.append(note)

    # -- checkpoints -------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the schedule of the run as plain data."""
        return {
            "order": [part.component.name for part in self.flexible],
            "parts": {p.component.name: [p.time, p.lead, p.late] for p in (*self.flexible, *self.rigid)},
            "clocks": {part.component.name: part.component.schedule() for part in self.events},
            "pending": {name: list(clocks) for name, clocks in self.pending.items()},
            "times": list(self._times),
            "events": [list(event) for event in self.record.events],
            "counts": [[*key, count] for key, count in self.record.counts.items()],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a schedule after signals and states."""
        by_name = {part.component.name: part for part in (*self.flexible, *self.rigid)}
        self.flexible[:] = [by_name[name] for name in state["order"]]
        for name, (time, lead, late) in state["parts"].items():
            part = by_name[name]
            part.time, part.lead, part.late = time, lead, late
        for part in self.events:
            part.component.restore_schedule(state["clocks"][part.component.name])
        self.pending = {name: list(clocks) for name, clocks in state["pending"].items()}
        self._times = deque(state["times"], maxlen=MOST_EVENTS)
        self.record = EventRecord(
            [(time, component, cause) for time, component, cause in state["events"]],
            {(component, cause): count for component, cause, count in state["counts"]},
        )

    # -- instants --------------------------------------------------------------------------------

    def _instant(self, t: float, k: int, events: Sequence[Part]) -> None:
        """Exchange values and handle events at a time."""
        here = [part for part in events if abs(part.time - t) <= self.close or not part.is_flexible]
        self._copy_all(k)
        self._read_late(t, k)
        for part in here:
            part.component.look()
        self._handle_exchanges(t, k)
        asked = []
        for part in here:
            fmu = part.component
            is_due = fmu.asks or fmu.due <= t + self.close or fmu.name in self.pending
            if is_due or fmu.has_jumped or fmu.is_stirred:
                asked.append(part)
        if asked:
            self._check_progress(t)
            self._handle(t, k, here, asked)

    def _read_late(self, t: float, k: int) -> None:
        """Set the known values of a time, and read the outputs that follow them."""
        late = [p for p in (*self.flexible, *self.rigid) if p.has_late and abs(p.time - t) <= self.close]
        for part in late:
            self._announce(part, PUT)
            part.component.put()
            self._announce(part, GET)
            part.component.get()
        if late:
            self._copy_all(k)

    def _handle_exchanges(self, t: float, k: int) -> None:
        """Handle the events of model exchange."""
        for part in self.exchanges:
            calls = part.exchange
            if calls is not None and calls.cause and abs(part.time - t) <= self.close:
                self.record.add(t, part.component.name, f"{calls.cause} event")
                self._announce(part)
                with part.component.instance.check_calls():
                    calls.handle_event(self.h)
                self._announce(part, GET)
                part.component.get()
                self._copy_all(k)

    def _handle(self, t: float, k: int, here: Sequence[Part], asked: Sequence[Part]) -> None:
        """Iterate until no FMU needs another round."""
        joined: list[Part] = []
        for part in asked:
            self._record_cause(part, t)
        for update in range(MOST_EVENTS):
            before = bytes(self.master.row)
            for part in asked:
                if update and part not in joined:
                    self.record.add(t, part.component.name, "input")
                self._join(part, joined)
                self._tick(part, t)
            self._settle(t, k, here, joined)
            again = self._update(joined, k)
            asked = [p for p in here if p in again or p.component.is_stirred or self._ticks(p, t)]
            if not asked:
                self._leave(joined)
                return
        self._raise_restless(t, before, asked)

    def _update(self, joined: Iterable[Part], k: int) -> list[Part]:
        """Update discrete states; return components to repeat."""
        again = []
        for part in joined:
            self._announce(part)
            if part.component.update():
                again.append(part)
        for part in joined:
            self._announce(part, GET)
            part.component.get()
        self._propagate(k)
        return again

    def _leave(self, joined: Iterable[Part]) -> None:
        for part in joined:
            self._announce(part)
            part.component.leave()

    def _settle(self, t: float, k: int, here: Sequence[Part], joined: list[Part]) -> None:
        """Exchange values and clocks until they settle."""
        master = self.master
        for sweep in range(1, MOST_SWEEPS + 1):
            before, row, beside = bytes(master.row), list(master.row), list(master.beside)
            is_quiet = True
            for part in tuple(joined):
                self._announce(part, PUT)
                part.component.put()
                part.component.look()
                self._announce(part, GET)
                part.component.get()
                for clock in part.component.fired():
                    is_quiet = False
                    self.record.add(t, part.component.name, f"clock {clock}")
                    self._trigger(part.component.name, clock, t, here, joined)
                for clock in self.ticked.pop(part.component.name, ()):
                    is_quiet = False
                    self._trigger(part.component.name, clock, t, here, joined)
                copy_values(master.row, self.all, k)
            self._propagate(k)
            for part in here:
                if part not in joined and part.component.is_stirred:
                    is_quiet = False
                    self.record.add(t, part.component.name, "input")
                    self._join(part, joined)
            settled = bytes(master.row) == before or (sweep > EXACT_SWEEPS and is_settled(row, master.row))
            if is_quiet and settled and list(master.beside) == beside:
                return
        name = self._changed(before) or joined[-1].component.name
        raise SimulationError(
            name,
            t,
            (
                f"it still changes after {MOST_SWEEPS} exchanges of values at one event: an algebraic loop between "
                "FMUs in event mode that exchanging values does not settle"
            ),
        )

    def _propagate(self, k: int) -> None:
        """Copy all values, also through model exchange."""
        self._copy_all(k)
        for part in self.exchanges:
            self._announce(part, PUT)
            part.component.put()
            self._announce(part, GET)
            part.component.get()
        if self.exchanges:
            self._copy_all(k)

    def _join(self, part: Part, joined: list[Part]) -> None:
        if part not in joined:
            joined.append(part)
            self._announce(part)
            part.component.enter()

    def _ticks(self, part: Part, t: float) -> list[str]:
        """Return the clocks of a component that are due."""
        return [*part.component.due_clocks(t, self.close), *self.pending.get(part.component.name, ())]

    def _tick(self, part: Part, t: float) -> None:
        names = self._ticks(part, t)
        if names:
            self.pending.pop(part.component.name, None)
            self._announce(part)
            part.component.tick(names)
            for name in names:
                self.record.add(t, part.component.name, f"clock {name}")
            wired = [name for name in names if (part.component.name, name) in self.wires]
            self.ticked |= {part.component.name: wired} if wired else {}
            self._check_periods(part, names, t)

    def _check_periods(self, part: Part, names: Iterable[str], t: float) -> None:
        """Raise SimulationError for a clock that is too fast."""
        for name in names:
            timer = part.component.timers.get(name)
            if timer is not None and timer.interval is not None and timer.next <= t + self.close:
                message = (
                    f"the clock ticks every {timer.interval:g} s, but its FMU takes only steps of {self.h:g} s; "
                    "shorten the step of the scenario"
                )
                raise SimulationError(f"{part.component.name}.{name}", t, message)

    def _trigger(self, owner: str, clock: str, t: float, here: Sequence[Part], joined: list[Part]) -> None:
        """Tick the clocks connected to a clock."""
        for name, target in self.wires.get((owner, clock), ()):
            part = self.by_name[name]
            if part not in here:
                self.pending.setdefault(name, []).append(target)
                continue
            self._join(part, joined)
            self._announce(part)
            part.component.tick([target])
            self.record.add(t, name, f"clock {target}")

    def _copy_all(self, k: int) -> None:
        copy_values(self.master.row, self.all, k)

    def _announce(self, part: Part, call: int = OTHER) -> None:
        self.master.doing[0] = CALLS * part.number + call

    def _record_cause(self, part: Part, t: float) -> None:
        fmu = part.component
        if fmu.asks:
            self.record.add(t, fmu.name, "event")
        elif fmu.next_event <= t + self.close:
            self.record.add(t, fmu.name, "time event")
        elif fmu.has_jumped or fmu.is_stirred:
            self.record.add(t, fmu.name, "input")

    # -- failures -----------------------------------------------------------------------------------

    def _check_progress(self, t: float) -> None:
        """Raise SimulationError for crowded events."""
        self._times.append(t)
        if len(self._times) == self._times.maxlen and t - self._times[0] <= AT_ONCE * self.h:
            names = ", ".join(sorted({part.component.name for part in self.events if part.component.asks}))
            message = f"{len(self._times)} events within {AT_ONCE * self.h:.2g} s, so that time stands still"
            raise SimulationError(names or "the run", t, message)

    def _changed(self, before: bytes) -> str:
        """Return the first changed signal, or ""."""
        old = memoryview(before).cast("d")
        pairs = zip(self.master.system.columns, old, self.master.row, strict=True)
        return next((column for column, a, b in pairs if a != b), "")

    def _raise_restless(self, t: float, before: bytes, asked: Sequence[Part]) -> None:
        name = self._changed(before) or asked[0].component.name
        names = ", ".join(part.component.name for part in asked)
        raise SimulationError(
            name,
            t,
            (
                f"it still changes after {MOST_EVENTS} updates of discrete states at one time; these FMUs ask for "
                f"another one: {names}"
            ),
        )
