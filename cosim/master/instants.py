"""Step policy with event mode and clocks: components are stepped from instant to instant.

An instant is a communication point, a tick of a clock, or an event at which an FMU returned early from its step. All
components are stepped to the instant. Then the FMUs concerned enter event mode, and values and clocks are exchanged in
superdense time until nothing changes:

    enter, [tick, (put, get, fired)* until settled, update]* until no FMU needs another round, leave

Rows are recorded at communication points only, with the values after the instant.

If one component returns early, the step ends there for all components. A component that was stepped further restores
its state and repeats the step. Therefore components that can restore their state step first, then components that may
return early, then all others with the components that need their outputs. If two components may return early and cannot
restore their state, the one with the last early return steps first; the other may be ahead of an event, which is
reported in a note. A component that accepts only whole steps gets an event within a step at the end of the step.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from cosim.blocks.component import ADVANCE, GET, PUT
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.model_exchange import CHATTERING_SHARE, MOST_EVENTS, ModelExchange
from cosim.blocks.sources import SourceBlock
from cosim.core.errors import SimulationError
from cosim.core.times import TIME_TOLERANCE_SHARE, TIME_TOLERANCE_ULPS
from cosim.master.initialization import EXACT_SWEEPS, is_settled
from cosim.master.policies import Policy
from cosim.system.events import can_end_step_at_event, is_exchange
from cosim.system.schedule import Stage
from cosim.system.wiring import Copies

if TYPE_CHECKING:
    from cosim.master.master import Master

MOST_SWEEPS = 1000  # exchanges of values at one instant
MOST_RECORDED = 1000  # recorded events of a run
SOURCES, REPEATABLE, EARLY, LAST, WHOLE = range(5)  # ranks for the order within a step


class Part:
    """A component in the order of a step.

    Attributes:
        active: Step of the component, without the known values at its end, which `late` sets.
        time: Time [s] up to which the component has been stepped.
        exchange: Instance for model exchange, if the component can stop at any event.
        rank: SOURCES, REPEATABLE, EARLY (may return early, cannot go back), LAST, or WHOLE (makes whole steps only).
        lead: Longest time [s] by which the component was ahead of an event.
        ahead: Number of events that the component was ahead of.
        wires: Clock → connected input clocks, with their components.
        ticked: Clocks that have ticked and trigger connected clocks after outputs are read.
        pending: Clocks to tick when the component has been stepped to the instant.
    """

    def __init__(self, master: Master, stage: Stage) -> None:
        component: Any = stage.component
        active, takes_parts = master.actives[component.name], can_end_step_at_event(stage, master.system.loops)
        self.component, self.every, self.late = component, stage.every, active.late
        self.active = active._replace(late=None, length=0.0 if takes_parts else active.length)
        first = master.first_places[0].get(component.name, 0)
        self.row, self.inputs = master.row, slice(first, first + len(component.inputs))
        self.time, self.lead, self.ahead = master.system.start, 0.0, 0
        self.wires: dict[str, list[tuple[Part, str]]] = {}
        self.ticked: list[str] = []
        self.pending: list[str] = []
        self.has_events = isinstance(component, EventFmu)
        self.exchange: ModelExchange | None = component.instance if takes_parts and is_exchange(component) else None
        self.state_owner = component if self.exchange is None else self.exchange
        self.may_return: bool = component.may_return if self.has_events else self.exchange is not None
        self.rank = LAST
        if not takes_parts:
            self.rank = WHOLE
        elif isinstance(component, SourceBlock):
            self.rank = SOURCES
        elif isinstance(component, FmuBlock) and component.rolls_back:
            self.rank = REPEATABLE
        elif self.exchange is not None:
            self.exchange.stops_at_events = True
            # An FMU that needs no calls of completedIntegratorStep changes only its continuous states up to its first
            # event.
            self.rank = EARLY if self.exchange.needs_completed_steps else REPEATABLE
        elif self.may_return:
            self.rank = EARLY

    def save(self) -> Any:
        """Return the state, None if it cannot be restored."""
        if self.rank not in (SOURCES, REPEATABLE):
            return None
        return self.time, self.row[self.inputs], self.state_owner.save_state() if self.rank == REPEATABLE else None

    def go_back(self, state: Any) -> None:
        """Restore a saved state."""
        self.time, self.row[self.inputs], saved = state
        if self.rank == REPEATABLE:
            self.state_owner.restore_state(saved)
            self.component.instance.time = self.time

    def forget(self, state: Any) -> None:
        """Free a saved state that is not needed."""
        if self.rank == REPEATABLE and self.exchange is None:
            self.component.free_state(state[-1])


class Instants(Policy):
    """Step policy of a run with event mode.

    Attributes:
        copies: Copies to the components of the current instant, with noise and faults of communication point `point`.
        here: FMUs with event mode that have been stepped to the instant; FMUs in `joined` are in event mode.
        events: First MOST_RECORDED events and ticks: time [s], component, cause.
        counts: Component → cause → number of all events and ticks.
    """

    reason = "event mode"

    def __init__(self, master: Master) -> None:
        self.master, self.begin, self.h, self.call = master, master.system.start, master.h, master.announce
        self.close = TIME_TOLERANCE_SHARE * self.h
        self.events: list[tuple[float, str, str]] = []
        self.counts: dict[str, Counter[str]] = {}
        self.time, self.point, self.copies = self.begin, 0, master.copying.of(())
        self.here: Sequence[Part] = ()
        self.joined: list[Part] = []
        self._times: deque[float] = deque(maxlen=MOST_EVENTS)
        self._copies: dict[tuple[str, ...], Copies] = {}
        self.parts = [Part(master, stage) for stage in master.system.stages]
        self.fmus = [part for part in self.parts if part.has_events]
        self.exchanges = [part for part in self.parts if part.exchange is not None]
        by_name = {part.component.name: part for part in self.parts}
        for origin, target in master.system.clock_wires:
            owner, _, clock = origin.partition(".")
            goal, _, name = target.partition(".")
            by_name[owner].wires.setdefault(clock, []).append((by_name[goal], name))
        returning = [part for part in self.parts if part.rank != WHOLE and part.may_return]
        if returning:
            last = set[str]()  # components to step after all that may return early, and their targets
            for part, stage in zip(self.parts, master.system.stages, strict=True):
                if part.rank == REPEATABLE and any(t.origin.partition(".")[0] in last for t in stage.pulls):
                    part.rank = LAST
                if part.rank >= LAST:
                    last.add(part.component.name)
            has_clocks = {part for part in self.fmus if part.component.output_clocks}
            self.parts.sort(key=lambda part: (min(part.rank, LAST), part not in has_clocks))
        self.last_early = max(map(self.parts.index, returning), default=-1)
        alone = [part for part in self.fmus if part.rank == EARLY]
        if len(alone) > 1:  # leads of these components are limited
            for part in alone:
                part.component.ask_for_small_steps()

    # -- course ----------------------------------------------------------------------------------------

    def advance_to(self, k: int) -> None:
        """Step to communication point k, and handle the events before it."""
        t, end, control = self.begin + (k - 1) * self.h, self.begin + k * self.h, self.master.controlled
        self.close = TIME_TOLERANCE_SHARE * self.h + 2 * TIME_TOLERANCE_ULPS * math.ulp(max(abs(t), abs(end)))
        while True:
            flexible = [part for part in self.parts if part.rank != WHOLE]
            times = [end, *(part.time for part in flexible)]  # includes times of components that are ahead
            times += [part.component.due for part in self.fmus if part.rank != WHOLE]
            target = min(time for time in times if time > t + self.close)
            target = end if target > end - self.close else target
            if control is None:
                t = self._advance(self._due(k) if target == end else flexible, target, k)
            else:
                begin, target = t, control.limit(t, target, end)
                t = self._advance(flexible, target, k)
                control.judge_step(begin, t)
            if t >= end - self.close:
                break
            self._instant(t, k - 1, flexible)
        if control is not None:
            self._advance([part for part in self._due(k) if part.rank == WHOLE], end, k)

    def settle(self, k: int) -> None:
        """Handle the instant at communication point k, with changes of parameters and inputs there."""
        t = self.begin + k * self.h
        if k:
            self._instant(t, k, self._due(k))
            return
        self._begin_instant(t, 0, self.parts, self.fmus)
        self._handle(self.fmus)

    def finish(self) -> None:
        """Record notes on components that were ahead of events, and notes of the step control."""
        for part in self.parts:
            if part.lead:
                self.master.notes.append(
                    f"{part.component.name} was already up to {part.lead:.3g} s past an event of another FMU and "
                    f"cannot go back, so {part.ahead} events took effect there late, by at most this time. Use a "
                    "shorter step of the scenario to reduce the delay"
                )
        if self.master.controlled is not None:
            self.master.controlled.finish()

    # -- steps ---------------------------------------------------------------------------------------

    def _due(self, k: int) -> list[Part]:
        """Return the components whose step ends at communication point k."""
        return [part for part in self.parts if part.rank != WHOLE or k % part.every == 0]

    def _advance(self, parts: Sequence[Part], target: float, k: int) -> float:
        """Step components to a time [s] or to the first early return; return the time reached."""
        saved: dict[Part, Any] = {}  # state before the step
        end = self.begin + k * self.h
        while True:
            early: Part | None = None
            for place, part in enumerate(parts):
                if target - part.time > self.close:
                    if 0 < self.last_early >= place and (state := part.save()) is not None:
                        saved[part] = state
                    self._step(part, target, k)
                    if part.time < target - self.close:
                        early = part
                        break
                if part.late is not None and part.time <= target + self.close:
                    part.late(k if target == end else k - 1)
            if early is None:
                for part, state in saved.items():
                    part.forget(state)
                return target
            target = early.time
            for part in [part for part in saved if part.time > target + self.close]:
                self.call(part.component)
                part.go_back(saved.pop(part))
            parts = [part for part in self.parts if part.rank != WHOLE]
            ahead = [part for part in parts if part.time > target + self.close]
            for part in ahead:
                part.lead, part.ahead = max(part.lead, part.time - target), part.ahead + 1
            if ahead and early.rank == EARLY:
                self.parts.remove(early)
                self.parts.insert(min(map(self.parts.index, ahead)), early)
                parts = [part for part in self.parts if part.rank != WHOLE]

    def _step(self, part: Part, target: float, k: int) -> None:
        component = part.component
        if not part.has_events:
            self.master.advance((part.active,), k, part.time, target)
            part.time = target
            if part.exchange is not None and part.exchange.cause:
                part.time = component.instance.time = part.exchange.reached
            return
        part.active.copy(k)
        self.call(component, PUT).put()
        part.time = self.call(component, ADVANCE).go(target)
        self.call(component, GET).get()

    # -- instants --------------------------------------------------------------------------------

    def _instant(self, t: float, k: int, parts: Sequence[Part]) -> None:
        """Exchange values and handle events of components that have been stepped to time t [s]."""
        here = [part for part in self.fmus if part in parts and abs(part.time - t) <= self.close]
        self._begin_instant(t, k, parts, here)
        for part in self.exchanges:
            calls = part.component.instance
            if calls.cause and abs(part.time - t) <= self.close:
                self._record(part, f"{calls.cause} event")
                with self.call(part.component).instance.check_calls():
                    calls.handle_event(self.h)
                self.call(part.component, GET).get()
                self.copies(self.point)
        asked = []
        for part in here:
            fmu = part.component
            is_due = fmu.asks or fmu.due <= t + self.close or part.pending
            if is_due or fmu.has_jumped or fmu.is_stirred:
                asked.append(part)
        if not asked:
            return
        self._times.append(t)
        if len(self._times) == self._times.maxlen and t - self._times[0] <= CHATTERING_SHARE * self.h:
            names = ", ".join(sorted({part.component.name for part in self.fmus if part.component.asks}))
            raise SimulationError(
                names or "the run",
                t,
                f"{len(self._times)} events within {CHATTERING_SHARE * self.h:.2g} s, so that time stands still",
            )
        self._handle(asked)

    def _begin_instant(self, t: float, k: int, parts: Iterable[Part], here: Sequence[Part]) -> None:
        """Copy all values to components, and record the inputs of FMUs with event mode."""
        self.time, self.point, self.here, self.joined = t, k, here, []
        names = tuple(part.component.name for part in parts)
        if names not in self._copies:
            stages = {stage.component.name: stage for stage in self.master.system.stages}
            transfers = (t for name in names for t in (*self.master.system.held_of[name], *stages[name].transfers))
            self._copies[names] = self.master.copying.of(transfers)
        self.copies = self._copies[names]
        self.copies(self.point)
        for part in here:
            part.component.look()

    def _handle(self, asked: Sequence[Part]) -> None:
        """Exchange values and update discrete states until no FMU needs another round."""
        for part in asked:
            fmu = part.component
            if fmu.asks:
                self._record(part, "event")
            elif fmu.next_event <= self.time + self.close:
                self._record(part, "time event")
            elif fmu.has_jumped or fmu.is_stirred:
                self._record(part, "input")
        for update in range(MOST_EVENTS):
            before = bytes(self.master.row)
            for part in asked:
                if update and part not in self.joined:
                    self._record(part, "input")
                self._join(part)
                self._tick(part)
            self._settle()
            again = [part for part in self.joined if self.call(part.component).update()]
            for part in self.joined:
                self.call(part.component, GET).get()
            self._propagate()
            asked = [part for part in self.here if part in again or part.component.is_stirred or self._ticks(part)]
            if not asked:
                for part in self.joined:
                    self.call(part.component).leave()
                return
        names = ", ".join(part.component.name for part in asked)
        raise self._unsettled(
            before,
            asked[0],
            f"{MOST_EVENTS} updates of discrete states at one time, and these FMUs request another: {names}",
        )

    def _settle(self) -> None:
        """Exchange values and clocks until they no longer change."""
        master = self.master
        for sweep in range(1, MOST_SWEEPS + 1):
            before, row, beside = bytes(master.row), list(master.row), list(master.beside)
            is_quiet = True
            for part in tuple(self.joined):
                self.call(part.component, PUT).put()
                part.component.look()
                self.call(part.component, GET).get()
                fired = part.component.fired()
                for clock in fired:
                    self._record(part, f"clock {clock}")
                    self._trigger(part, clock)
                ticked, part.ticked = part.ticked, []
                for clock in ticked:
                    self._trigger(part, clock)
                is_quiet = is_quiet and not (fired or ticked)
                self.copies(self.point)
            self._propagate()
            for part in self.here:
                if part not in self.joined and part.component.is_stirred:
                    is_quiet = False
                    self._record(part, "input")
                    self._join(part)
            settled = bytes(master.row) == before or (sweep > EXACT_SWEEPS and is_settled(row, master.row))
            if is_quiet and settled and list(master.beside) == beside:
                return
        raise self._unsettled(
            before,
            self.joined[-1],
            f"{MOST_SWEEPS} exchanges of values at one event: an algebraic loop between FMUs in event mode, which "
            "these exchanges do not solve",
        )

    def _unsettled(self, before: bytes, part: Part, reason: str) -> SimulationError:
        """Return the error for values that do not settle; it names the first changed signal or a component."""
        old = memoryview(before).cast("d")
        pairs = zip(self.master.system.columns, old, self.master.row, strict=True)
        name = next((column for column, a, b in pairs if a != b), part.component.name)
        return SimulationError(name, self.time, f"it still changes after {reason}")

    def _propagate(self) -> None:
        """Copy all values, also from inputs to outputs of FMUs for model exchange."""
        self.copies(self.point)
        for part in self.exchanges:
            self.call(part.component, PUT).put()
            self.call(part.component, GET).get()
        if self.exchanges:
            self.copies(self.point)

    def _join(self, part: Part) -> None:
        """Let an FMU enter event mode, unless it has done so in this instant."""
        if part not in self.joined:
            self.joined.append(part)
            self.call(part.component).enter()

    def _ticks(self, part: Part) -> list[str]:
        """Return the clocks of a component that are due."""
        return [*part.component.due_clocks(self.time, self.close), *part.pending]

    def _tick(self, part: Part) -> None:
        """Tick the clocks of a component that are due; raise SimulationError if a clock ticks too fast."""
        if not (names := self._ticks(part)):
            return
        part.pending = []
        self.call(part.component).tick(names)
        part.ticked = [name for name in names if name in part.wires] or part.ticked
        for name in names:
            self._record(part, f"clock {name}")
            timer = part.component.timers.get(name)
            if timer is not None and timer.interval is not None and timer.next <= self.time + self.close:
                raise SimulationError(
                    f"{part.component.name}.{name}",
                    self.time,
                    f"the clock ticks every {timer.interval:g} s, but its FMU takes only steps of {self.h:g} s; "
                    "shorten the step of the scenario",
                )

    def _trigger(self, part: Part, clock: str) -> None:
        """Tick the clocks connected to a clock."""
        for other, target in part.wires.get(clock, ()):
            if other in self.here:
                self._join(other)
                self.call(other.component).tick([target])
                self._record(other, f"clock {target}")
            else:
                other.pending.append(target)

    def _record(self, part: Part, cause: str) -> None:
        event = self.time, part.component.name, cause
        self.counts.setdefault(part.component.name, Counter())[cause] += 1
        if len(self.events) < MOST_RECORDED:
            self.events.append(event)
