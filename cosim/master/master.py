"""The master, which steps all components of a system and records a row per communication point.

All systems are stepped by one loop. `Master.advance` steps each component once, in the order of the coupling algorithm.
A policy divides the interval between two communication points into one or more such steps: equal steps, steps
controlled by their error (`policies`), or steps from event to event (`instants`). At the communication point, the
master then applies changes of parameters and inputs, handles events, calls observers, records the row, and writes a
checkpoint if it is due. Equal steps can be made in C, which is faster.

Coupling algorithms differ in the order of stages, in the transfers just before a stage (`Stage.pulls`) and in the
transfers at the end of the step (`System.held`). Values of known signals with direct feedthrough are set just after the
step (`Stage.late`), and the outputs are read again. A component with a longer step of its own is stepped when this step
ends; until then, its outputs are held.
"""

from __future__ import annotations

import bisect
import ctypes
import errno
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from cosim.blocks.component import GET, EarlyEnd, without_step
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.stepping import NEVER, NotCompiled, cores
from cosim.core.arrays import Array
from cosim.core.drafts import is_full
from cosim.core.errors import CallFailed, DiskFull, NotFinite, SimulationError, Terminated, stop_error
from cosim.core.messages import Note
from cosim.files.files import hold_stops
from cosim.files.results import Results
from cosim.isolation.rows import CALLS, OTHER, Rows
from cosim.master.c_loop import CompiledSteps
from cosim.master.checkpoint import Keeper
from cosim.master.extrapolation import CourseStep, read_again
from cosim.master.initialization import Initialization
from cosim.master.instants import Instants
from cosim.master.loops import LoopSolver
from cosim.master.observer import Inbox
from cosim.master.pacing import Pacer
from cosim.master.policies import (
    Active,
    ControlledSteps,
    EqualSteps,
    Policy,
    Round,
    SavedPoint,
    Together,
)
from cosim.system.control import rollback_obstacle
from cosim.system.schedule import Stage, batches
from cosim.system.system import System
from cosim.system.wiring import Copying

Progress = Callable[[int], None]  # receives the current communication point
PROGRESS_EVERY_STEPS = 50


class StoppedRun(Exception):
    """A run that stopped early, with its error and the rows so far."""

    def __init__(self, error: SimulationError, results: Results) -> None:
        super().__init__(str(error))
        self.error, self.results = error, results


def simulate(
    system: System,
    steps: int,
    h: float,
    progress: Progress | None = None,
    rows: Rows | None = None,
    *,
    in_c: bool = True,
    inbox: Inbox | None = None,
) -> Results:
    """Run `steps` communication steps of `h` [s].

    If an FMU ends the simulation, the results have fewer rows and a note.

    Args:
        rows: Storage of the rows, shape (steps + 1, columns); by default in memory.
        in_c: Use the C loop if possible; `Results.loop` says if it was used.
        inbox: Changes of parameters and inputs that arrive during the run.

    Raises:
        StoppedRun: A component failed.
    """
    room = rows or Rows.in_memory(steps + 1, len(system.columns))
    master = Master(system, steps, h, progress, room, in_c=in_c, inbox=inbox)
    results = master.results()
    if master.failure is not None:
        raise StoppedRun(master.failure, results)
    return results


class Master:
    """A run from the opening to the closing of its components, with its signals and its table of rows.

    Attributes:
        row: Signals of the run as a C array; `values` shares its memory.
        beside: Values that doubles cannot represent.
        last: Last communication point for which the table has room.
        done: Number of complete rows.
        failure: Error because of which the run stopped early, if any.
    """

    failure: SimulationError | None = None
    is_compiled = False  # True if C makes all steps
    in_python: dict[str, Any] | None = None  # manifest entry on components stepped in Python beside C

    def __init__(
        self,
        system: System,
        steps: int,
        h: float,
        progress: Progress | None,
        rows: Rows,
        *,
        in_c: bool = True,
        inbox: Inbox | None = None,
    ) -> None:
        self.system, self.steps, self.h = system, steps, h
        self.components: list[Any] = [stage.component for stage in system.stages]
        self.numbers = {component.name: CALLS * k for k, component in enumerate(self.components)}
        self.row = (ctypes.c_double * len(system.columns))()
        self.values = np.ctypeslib.as_array(self.row)
        self.beside: list[Any] = [None] * len(system.beside)
        self.first_places: tuple[dict[str, int], dict[str, int]] = {}, {}  # component → index, in the row and beside
        for columns, first_places in zip((system.columns, system.beside), self.first_places, strict=True):
            for k, column in enumerate(columns):
                first_places.setdefault(column.partition(".")[0], k)
        self.rows, self.progress, self.in_c, self.loop = rows, progress, in_c, "none"
        self.table, self.row_count, self.doing, self.asked = rows.table, rows.made, rows.doing, rows.asked
        self.time = system.start + h * np.arange(steps + 1, dtype=np.float64)  # counted, not summed
        self.last, self.done = min(steps, len(rows.table) - 1), 0
        self.keeper: Keeper | None = rows.keeper
        self.instants: Instants | None = None
        self.controlled: ControlledSteps | None = None
        self.courses: dict[str, CourseStep] = {}  # component → step in which inputs follow polynomials
        self.together: list[Together | CompiledSteps] = []  # objects that may have threads
        self._exact: tuple[Any, ...] = ()
        self._exact_rows = rows.given if system.beside else 0
        self._rounds: dict[tuple[Any, ...], Round] = {}
        self.notes: list[str] = []
        self.events, self.inbox = sorted(system.events), inbox
        self.pacer = None if system.pace is None else Pacer(system.pace, steps, h, rows.doing, progress)
        for stage in system.stages:
            if isinstance(stage.component, FmuBlock):
                points = [k for k, changes in system.events.items() if stage.component.name in changes]
                stage.component.await_inputs([float(self.time[k]) for k in points if k], always=bool(stage.late))
        self.copying = Copying(self.row, self.beside, (system.seed, system.start, h, steps + 1))
        self.solvers = [LoopSolver(loop, self) for loop in system.loops]

    # -- call sequence -----------------------------------------------------------------------------

    def results(self) -> Results:
        """Run from beginning to end; return the rows. After a failure, return the rows so far."""
        try:
            self.open()
            Initialization(self, self.solvers).run()
            for solver in self.solvers:
                self.notes += solver.begin()
            self.change(0)
            if any(isinstance(component, EventFmu) for component in self.components):
                self.instants = Instants(self)
                self.instants.settle(0)
            for transfer in self.system.transfers:
                values = self.beside if transfer.beside[1] else self.row
                transfer.check_item(values[transfer.target], self.system.start)
            self.tell(0)
            self.table[0] = self.values
            self.done = self.row_count[0] = 1
            if self.keeper is not None:
                self.keeper.begin(self)
            self._step_on()
            if self.keeper is not None:
                self.keeper.compare_rows(self, self.done)
                if self.keeper.interval is not None:
                    self.keeper.save(self, self.done - 1)
            hold_stops()  # a signal must not interrupt saving the rows
        except EarlyEnd as end:
            if not self.done:  # before the first row
                self.failure = end
                return self._rows_so_far()
            self.notes.append(Note(f"{end.component} ended the simulation at t = {end.reached:.6g} s: {end.reason}"))
            # A single FMU gets a last row at this time. With several components, the others would have no values then.
            alone = len(self.system.fmus) == 1
            k = self.done
            if k <= self.last and end.readable and alone and end.reached > self.time[k - 1]:
                for component in self.components:
                    component.get()
                if self.instants is None:
                    self.change(k)
                self.tell(k)
                self.time[k] = end.reached
                self.table[k] = self.values
                self.done = self.row_count[0] = k + 1
        except (SimulationError, KeyboardInterrupt, Terminated) as stop:
            self.failure = self._explain(stop_error(stop, float(self.time[max(0, self.done - 1)])))
        except OSError as error:
            if not is_full(error):
                raise
            reason = f"the disk is full: it has room for only {self.done} of {self.steps + 1} rows"
            self.failure = DiskFull("the run", float(self.time[max(0, self.done - 1)]), reason)
        finally:
            if self.keeper is not None:
                self.keeper.is_over.set()
            for together in self.together:
                together.close()
            for component in self.components:
                self.announce(component).close()
        return self._rows_so_far()

    def open(self) -> None:
        """Open all components."""
        for component in self.components:
            first, first_beside = (places.get(component.name, 0) for places in self.first_places)
            component.bind(self.row, first, self.beside, first_beside)
        for component in self.components:
            self.announce(component).open(self.system.start, float(self.time[-1]))

    def _step_on(self) -> None:
        """Make all steps, in C if possible, otherwise in Python."""
        system = self.system
        if system.control is not None:
            self.controlled = ControlledSteps(self, system.control)
        policy: Policy | CompiledSteps | None = self.instants or self.controlled
        if policy is None:
            if system.courses[0] > 1:
                self._estimate_slopes()
            try:
                policy = CompiledSteps(self)
            except NotCompiled as reason:
                policy = EqualSteps(self, str(reason))
        self.is_compiled = isinstance(policy, CompiledSteps)
        self.loop = policy.described if isinstance(policy, CompiledSteps) else f"Python: {policy.reason}"
        self.rows.tell_loop(self.loop)
        if self.pacer is not None:  # preparing the loop does not delay the first step
            self.pacer.begin = self.pacer.clock()
        self._exact = tuple(self.beside)
        try:
            if isinstance(policy, CompiledSteps):
                policy.make_all()
            else:
                # Calls in this loop and in `advance` determine the run time, so they are few.
                values, table, row_count, asked = self.values, self.table, self.row_count, self.asked
                advance_to, settle = policy.advance_to, None if self.instants is None else self.instants.settle
                call_point = self.next_call(self.done)
                for k in range(self.done, self.last + 1):
                    advance_to(k)
                    if k == call_point:
                        self.change(k)
                    if settle is not None:
                        settle(k)
                    if k == call_point:
                        self.tell(k)
                        call_point = self.next_call(k + 1)
                    table[k] = values
                    row_count[0] = k + 1
                    if asked[0] and self.keeper is not None:
                        self.keeper.look(self, k)
        finally:
            self.done = self.row_count[0]
            if isinstance(policy, Policy):
                policy.finish()
            elif policy.in_python:
                self.in_python = policy.record()
            if self.beside:
                self._repeat_exact(self.done)
        if self.done <= self.steps:
            raise OSError(errno.ENOSPC, "no room for further rows")

    def advance(self, actives: Iterable[Active], k: int, t: float, until: float) -> None:
        """Step components once, in their order, towards point k.

        Args:
            t: Start of the step [s] of components without a step of their own.
            until: End of the step [s].
        """
        for copy, step, every, length, late in actives:
            copy(k)
            if every == 1:
                step(t, length or until - t)
            else:
                step(since := self.system.start + (k - every) * self.h, length or until - since)
            if late is not None:
                late(k)

    def _explain(self, error: SimulationError) -> SimulationError:
        """Return an error; if an open algebraic loop of its component may be the cause, with a sentence on the loop.

        Such a loop may cause values that do not settle or grow without bound, and calls that an FMU refuses during
        initialization.
        """
        loop = next((loop for loop in self.system.opened if error.component.partition(".")[0] in loop.members), None)
        kinds = NotFinite if self.done else (NotFinite, CallFailed)
        if loop is None or not isinstance(error, kinds):
            return error
        return SimulationError(error.component, error.time, f"{error.reason}. {loop.left_open}")

    # -- communication points ------------------------------------------------------------------

    def next_call(self, k: int) -> int:
        """Return the next communication point, from k on, at which the C loop must return to Python, or `NEVER`."""
        if self.pacer is not None or (self.beside and not self.is_compiled):  # C returns when exact values change
            return k
        place = bisect.bisect_left(self.events, k)
        points = self.events[place : place + 1]
        if self.keeper is not None and self.keeper.repeated >= k:
            points.append(self.keeper.repeated)
        if self.inbox is not None:  # progress is reported when the inbox is read
            points.append(self.inbox.next_look(k))
        elif self.progress is not None:
            points.append(-(-k // PROGRESS_EVERY_STEPS) * PROGRESS_EVERY_STEPS)
        return min(points, default=NEVER)

    def change(self, k: int) -> None:
        """Wait until point k is due, and change parameters and inputs."""
        changes: Mapping[str, Mapping[str, Any]] = self.system.events.get(k, {})
        if self.pacer is not None:
            self.pacer.wait(k)
        if self.inbox is not None:
            changes = self.inbox.take(k, changes)
            if self.pacer is not None:
                self.pacer.begin += self.inbox.pause
        changed = [component for component in self.components if component.name in changes]
        for component in changed:
            component.change(changes[component.name])
            if not isinstance(component, EventFmu):  # EventFmu is read at the instant
                self.announce(component, GET).get()
        if changed:
            due = [stage.component.name for stage in self.system.stages if k % stage.every == 0]
            held = [t for name in due for t in self.system.held_of[name]]
            # C then repeats its transfers within the row.
            self.copying.of(t for t in held if not self.is_compiled or any(t.beside))(k)

    def tell(self, k: int) -> None:
        """Record exact values, compare repeated rows and report progress, before the row of point k is stored."""
        if self.beside and k >= self.rows.given:
            self._repeat_exact(k)
            self._exact = tuple(self.beside)
            self._repeat_exact(k + 1)
        if self.keeper is not None:
            self.keeper.compare_rows(self, k)
        if self.progress is not None and k and (self.inbox is not None or k % PROGRESS_EVERY_STEPS == 0):
            self.progress(k)

    def _repeat_exact(self, rows: int) -> None:
        """Repeat the last recorded exact values up to a number of rows, in which they have not changed."""
        for _ in range(self._exact_rows, rows):
            self.rows.beside.append(self._exact)
        self._exact_rows = max(self._exact_rows, rows)

    # -- parts --------------------------------------------------------------------------------

    def announce(self, component: Any, call: int = OTHER) -> Any:
        """Store the next call, so that a message on a crash or a hang names its component; return the component."""
        self.doing[0] = self.numbers[component.name] + call
        return component

    def round(self, stages: Sequence[Stage], k: int, held: Collection[str] = (), *, nominal: bool = True) -> Round:
        """Return the steps that are due at point k, and the copies at their end.

        Args:
            held: Components whose held values are copied at every point.
            nominal: True if components with nominal steps are stepped by the nominal length.
        """
        due = tuple(stage.component.name for stage in stages if k % stage.every == 0)
        key = nominal, tuple(held), due
        if key not in self._rounds:
            copies = self.copying.of(t for name in (*due, *held) for t in self.system.held_of[name])
            actives = list[Active]()
            for batch in batches([stage for stage in stages if stage.component.name in due]):
                some = [self.actives[stage.component.name] for stage in batch]
                some = some if nominal else [active._replace(length=0.0) for active in some]
                in_threads = [self._steps_in_threads(stage) for stage in batch]
                if sum(in_threads) > 1 and cores() > 1 and all(stage.every == 1 for stage in batch):
                    self.together.append(together := Together(some, in_threads))
                    some = [Active(together.copy, together, late=together.late)]
                actives += some
            closing = [active for name, active in self.closing.items() if name in due]
            self._rounds[key] = (*actives, *closing, Active(copies, lambda t, h: None))
        return self._rounds[key]

    @cached_property
    def actives(self) -> dict[str, Active]:
        """Return component → its step with the copies around it, after all components have started."""
        return {stage.component.name: self._active(stage) for stage in self.system.stages}

    def _steps_in_threads(self, stage: Stage) -> bool:
        """Return True if a step runs without Python: in another process, or in the library of an FMU."""
        component: Any = stage.component
        if any(component.name in solver.names for solver in self.solvers):
            return False
        is_library = isinstance(component, FmuBlock) and not (component.changes_by_events or component.nominal_step)
        return is_library or getattr(component, "is_apart", False)

    @cached_property
    def closing(self) -> dict[str, Active]:
        """Return the stages whose outputs are read again at the end of a step."""

        def reading(component: Any) -> Callable[[float, float], None]:
            return lambda t, h: read_again(self.announce(component, GET))

        return {
            stage.component.name: Active(self.copying.of(stage.pulls), reading(stage.component))
            for stage in self.system.closing
        }

    def _estimate_slopes(self) -> None:
        """Measure the slopes of inputs by a step that is taken back, so that the first step can extrapolate them.

        A held input would cause an error of second order in the first step, too much for a coupling of third order.
        """
        stages = self.system.stages
        if any(stage.every > 1 for stage in stages) or rollback_obstacle({c.name: c for c in self.components}):
            return
        start, values = self.system.start, self.values.copy()
        point = SavedPoint(self, [c for c in self.components if isinstance(c, FmuBlock)])
        self.advance(self.round(stages, 1), 1, start, start + self.h)
        before = 2.0 * values - self.values
        point.restore()
        for course in self.courses.values():
            course.past.add(start - self.h, before[course.old])

    def _active(self, stage: Stage) -> Active:
        component, name, pulls = stage.component, stage.component.name, self.copying.of(stage.pulls)
        solver = next((solver for solver in self.solvers if name in solver.names), None)
        if solver is not None:  # the last component of a loop steps all
            return Active(pulls, solver.step if name == solver.last else lambda t, h: None)
        step, late = component.stepping(self.doing, self.numbers[name]), None
        if any(self.system.courses):
            course = CourseStep(step, self, stage)
            if course.old or course.new:
                self.courses[name] = step = course
        if stage.late:
            copies, exchange = self.copying.of(stage.late), without_step(component, self.doing, self.numbers[name])

            def late(k: int) -> None:
                """Set known values after the step, and read the outputs again."""
                copies(k)
                exchange()

        return Active(pulls, step, stage.every, stage.every * self.h if component.nominal_step else 0.0, late)

    def _rows_so_far(self) -> Results:
        beside = self.rows.beside if isinstance(self.rows.beside, list) else []
        notes, details = [*self.notes, *(note for s in self.solvers for note in s.notes())], dict[str, Any]()
        if self.solvers:
            details["loops"] = [solver.record() for solver in self.solvers]
        if self.controlled is not None:
            details["steps"] = self.controlled.record()
        if self.in_python is not None:
            details["in_python"] = self.in_python
        if self.pacer is not None:
            notes += self.pacer.notes(self.system.start)
            details["pacing"] = self.pacer.record(self.system.start)
        time, table = self.time[: self.done], self.table[: self.done]
        results = results_of(self.system, time, table, beside, self.loop)
        results = replace(results, notes=tuple(notes), details=details)
        if self.instants is None:
            return results
        counts = {name: dict(sorted(causes.items())) for name, causes in sorted(self.instants.counts.items())}
        return replace(results, events=tuple(self.instants.events), event_counts=counts)


def results_of(system: System, time: Array, table: Array, beside: Sequence[Any], loop: str) -> Results:
    """Return the results of a run from its table of rows."""
    exact = {name: [row[k] for row in beside[: len(time)]] for k, name in enumerate(system.beside)}
    whole = frozenset(c for c in system.columns if system.signals[c].is_whole)
    return Results(time, system.columns, table, system.units, exact, whole, loop=loop)
