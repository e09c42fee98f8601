"""Observers of a running simulation, and changes of parameters and inputs that arrive while it is stepped.

An observer is, e.g., a progress bar, a live plot, a recorder, or a set of functions that set inputs. It sends changes
and pauses through a `Control`; the master takes them through an `Inbox` at its next look, about `LOOK_INTERVAL_S`
later, and notes the communication point. An event at that point repeats the change.

Changes are passed by files in a folder and by counters in shared memory. A counter counts a record only when it is
complete. The recorded changes survive a crash of the master.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import Fault, SimulationError, refuse
from cosim.core.text import DisplayUnits
from cosim.isolation.rows import WAITING, Progress
from cosim.system.events import Targets, Variable
from cosim.system.system import System

Values = Mapping[str, Mapping[str, Any]]  # component → variable → value
LOOK_INTERVAL_S = 0.01  # [s] between looks
MOST_STEPS, MOST_IN_C = 50, 5000  # steps between looks; the loop in C returns after a second at the latest
LATE_LOOK_S = 0.5  # [s] after which steps have become slower than expected
PAUSE_LOOK_INTERVAL_S = 0.01  # [s] between looks during a pause
SENT, NOTED = "sent", "noted"  # files of a folder
MAX_CHARACTERS = 500  # of an error message


@dataclass(frozen=True)
class Change:
    """Values set at a communication point."""

    point: int
    values: Values


class Inbox:
    """Changes of parameters and inputs that the master receives.

    Attributes:
        most: Largest number of steps between two reads.
        pause: Length of the pause during the last read [s].
        changes: Changes so far.
    """

    def __init__(self, folder: Path, counters: Progress) -> None:
        self._folder, self._counters, self._received = folder, counters, 0
        self.most, self.pause, self.changes = MOST_STEPS, 0.0, list[Change]()
        self._point, self._due, self._time = 0, 0, -1.0

    def next_look(self, k: int) -> int:
        """Return the next point, from k on, at which to read the inbox; sooner if steps take long."""
        now = time.perf_counter()
        if self._due < k or now - self._time > LATE_LOOK_S:
            rate = (k - self._point) / max(now - self._time, 1e-9) if self._time >= 0.0 else 0.0  # [steps/s]
            self._point, self._time = k, now
            self._due = k - 1 + max(1, min(self.most, int(LOOK_INTERVAL_S * rate)))
        return self._due

    def take(self, k: int, events: Values) -> Values:
        """Wait for the end of a pause; return the values to set at point k: values of events, then received ones."""
        counters, self.pause = self._counters, 0.0
        if counters.hold[0]:
            since = time.perf_counter()
            doing, counters.doing[0] = counters.doing[0], WAITING
            while counters.hold[0] and not counters.stop[0]:
                time.sleep(PAUSE_LOOK_INTERVAL_S)
            counters.doing[0] = doing
            self.pause = time.perf_counter() - since
        count = counters.sent[0]
        if count == self._received:
            return events
        change = Change(k, _merge(*_records(self._folder / SENT)[self._received : count]))
        self._received = count
        self.changes.append(change)
        _append(self._folder / NOTED, change)
        return _merge(events, change.values)


class Control:
    """Control of a running simulation, usable in any thread; `paused = True` stops it at a communication point."""

    def __init__(self, system: System, folder: Path, counters: Progress) -> None:
        self._system, self._folder, self._counters = system, folder, counters
        self._changes: Sequence[Change] = ()  # still available after the end, when the files are removed
        self._lock = threading.Lock()

    @property
    def paused(self) -> bool:
        """Return True if the run is paused."""
        return bool(self._counters.hold[0])

    @paused.setter
    def paused(self, on: bool) -> None:
        self._counters.hold[0] = on

    @property
    def changes(self) -> Sequence[Change]:
        """Return all changes that the master has applied so far."""
        self._changes = _records(self._folder / NOTED) or self._changes
        return self._changes

    @cached_property
    def _targets(self) -> Targets:
        return targets_of(self._system)

    @cached_property
    def variables(self) -> Sequence[Variable]:
        """Return the tunable parameters and unconnected inputs, which `set` may change."""
        starts = {s.component.name: getattr(s.component, "start_values", {}) for s in self._system.stages}
        return self._targets.variables(starts)

    def set(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Set variables at the next communication point; a value may be text with a unit, such as `12 deg`.

        Values that are set after the end of the run have no effect.

        Returns:
            The values in the units and types of the variables.

        Raises:
            InputError: Values are wrong. The error names all faults, and no value is set.
        """
        converted, faults = dict[str, Any](), []
        for target, value in values.items():
            try:
                converted[target] = self._targets.value(target, value)
            except ValueError as error:
                faults.append(Fault(Path(target), 0, 0, str(error)))
        refuse(faults)
        parts = [(*target.split(".", 1), value) for target, value in converted.items()]
        with self._lock, suppress(FileNotFoundError):
            _append(self._folder / SENT, _merge(*({owner: {name: value}} for owner, name, value in parts)))
            self._counters.sent[0] += 1
        return converted


def _append(path: Path, record: Any) -> None:
    with path.open("ab", buffering=0) as stream:
        stream.write(pickle.dumps(record))


def _records(path: Path) -> list[Any]:
    """Return the complete records in a file."""
    records = []
    with suppress(FileNotFoundError, EOFError, pickle.UnpicklingError), path.open("rb") as stream:
        while True:
            records.append(pickle.load(stream))
    return records


def with_changes(events: Mapping[int, Values], changes: Sequence[Change]) -> Mapping[int, Values]:
    """Return the events of communication points, with changes added; a change replaces an event's value."""
    merged = dict(events)
    for change in changes:
        merged[change.point] = _merge(merged.get(change.point, {}), change.values)
    return merged


def _merge(*every: Values) -> Values:
    """Return all values in one mapping; later mappings take precedence."""
    merged: dict[str, dict[str, Any]] = {}
    for values in every:
        for component, changes in values.items():
            merged.setdefault(component, {}).update(changes)
    return merged


def targets_of(system: System) -> Targets:
    """Return the variables of a system that can be set during a run."""
    names = {transfer.name for transfer in system.transfers}
    return Targets({name: description for name, (_, description) in system.fmus.items()}, names)


@dataclass(frozen=True)
class ObservedRun:
    """Description of a run, which observers get before its first row.

    Attributes:
        columns: Names `component.variable` of the columns.
        rows: Number of rows, unless the run ends early.
        start: Time of the first row [s].
        step: Communication step [s].
        units: Column → unit, "" without unit.
        control: Control of the run: changes of parameters and inputs, and pauses.
        display: Unit → name of its display unit, factor and offset to its values.
    """

    columns: Sequence[str]
    rows: int
    start: float
    step: float
    units: Mapping[str, str] = field(default_factory=dict)
    control: Control | None = None
    display: DisplayUnits = field(default_factory=dict)


class Observer:
    """Base class of observers; methods are optional. An exception ends the run but keeps its rows."""

    def begin(self, run: ObservedRun) -> None:
        """Prepare for the rows of a run."""

    def rows(self, time: Array, values: Array) -> bool | None:
        """Receive new rows: time [s] and values of shape (rows, columns), valid only during this call.

        Return True to request an early end of the run; rows that are already computed still follow.
        """

    def end(self) -> None:
        """Finish after the last row, also of a failed run."""


Observers = Sequence[Observer]


class ProgressObserver(Observer):
    """An observer that reports the number of finished steps to a function."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress = progress

    def begin(self, run: ObservedRun) -> None:
        """Set the count of steps to zero."""
        self._done, self._steps = 0, run.rows - 1

    def rows(self, time: Array, values: Array) -> None:
        """Report the number of finished steps."""
        self._done += len(time)
        self._progress(min(self._done, self._steps), self._steps)


class Feed:
    """Distribution of new rows to observers, which may request an early end.

    Attributes:
        table: Storage of the rows; without it no rows are distributed.
        stop: True if an observer has requested an early end.
        failure: Error of an observer.
    """

    def __init__(
        self,
        observers: Observers,
        system: System,
        steps: int,
        h: float,
        control: Control | None,
        table: Array | None,
    ) -> None:
        self._observers, self._time, self._delivered = observers, system.start + h * np.arange(steps + 1), 0
        self.table, self.stop = table, False
        self.failure: SimulationError | None = None
        run = ObservedRun(system.columns, steps + 1, system.start, h, system.units, control, system.display)
        self._call("begin", run)

    def __call__(self, done: int) -> None:
        """Pass to the observers those of the first `done` rows that they have not received yet."""
        first, self._delivered = self._delivered, max(self._delivered, done)
        if self.table is not None and first < done and self.failure is None:
            self._call("rows", self._time[first:done], self.table[first:done])

    def end(self, table: Array) -> None:
        """Pass the remaining rows to observers, then call their `end`."""
        self.table = table
        self(len(table))
        self._call("end")

    def _call(self, method: str, *arguments: Any) -> None:
        """Call a method of all observers."""
        for observer in self._observers:
            try:
                self.stop |= bool(getattr(observer, method)(*arguments))
            except Exception as error:  # a user's observer may raise any error
                now = float(self._time[max(0, min(self._delivered, len(self._time)) - 1)])
                message = f"{type(error).__name__}: {' '.join(str(error).split())[:MAX_CHARACTERS]}"
                self.failure = self.failure or SimulationError(f"the observer {type(observer).__name__}", now, message)


InputFunction = Callable[[float, Mapping[str, float]], Any]  # time [s], signals → value, None to hold the last
NamedFunctions = Mapping[str, InputFunction]  # `component.input` → function


class InputFunctions(Observer):
    """Functions of time and signals that return values of inputs, called whenever there are new rows."""

    def __init__(self, functions: NamedFunctions) -> None:
        self._functions, self._last = dict(functions), dict[str, Any]()

    def check(self, system: System) -> None:
        """Raise InputError for names that cannot be set, and for objects that are not functions."""
        targets = targets_of(system)
        reasons = []
        for name, function in self._functions.items():
            try:
                targets.variable(name)
            except ValueError as error:
                reasons.append(str(error))
            if not callable(function):
                reasons.append(f"{name} is of type {type(function).__name__}; give a function of time and signals")
        refuse([Fault(Path("inputs"), 0, 0, reason) for reason in reasons])

    def begin(self, run: ObservedRun) -> None:
        """Store the names of the run's signals."""
        self._columns, self._control = run.columns, run.control

    def rows(self, time: Array, values: Array) -> None:
        """Call the functions with the last new row, and set those values that have changed."""
        signals = dict(zip(self._columns, values[-1].tolist(), strict=True))
        given = {name: function(float(time[-1]), signals) for name, function in self._functions.items()}
        new = {n: v for n, v in given.items() if v is not None and (n not in self._last or self._last[n] != v)}
        if new and self._control is not None:
            self._control.set(new)
            self._last |= new
