"""Observers of a running simulation, e.g. a progress bar, a live plot, a recorder, or functions that set inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import Fault, SimulationError, refuse
from cosim.core.text import DisplayUnits
from cosim.master.inbox import Control, targets_of
from cosim.system.system import System

MAX_CHARACTERS = 500  # of an error message


@dataclass(frozen=True)
class ObservedRun:
    """Description of a run, given to observers before its first row.

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
        """Take new rows, shape (rows, columns), valid during this call.

        Returning True requests an early end; rows already made still follow.
        """

    def end(self) -> None:
        """Finish after the last row, also of a failed run."""


Observers = Sequence[Observer]


class ProgressObserver(Observer):
    """An observer that reports the number of finished steps to a function."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress = progress

    def begin(self, run: ObservedRun) -> None:
        """Start to count at the first row of a run."""
        self._done, self._steps = 0, run.rows - 1

    def rows(self, time: Array, values: Array) -> None:
        """Report the number of finished steps."""
        self._done += len(time)
        self._progress(min(self._done, self._steps), self._steps)


class Feed:
    """Distribution of rows to observers, each row once, with requests for an early end.

    Attributes:
        table: Storage of the rows; without it no rows are distributed.
        stop: Whether an observer requested an early end.
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
        """Deliver to the observers those of the first `done` rows that they have not received yet."""
        first, self._delivered = self._delivered, max(self._delivered, done)
        if self.table is not None and first < done and self.failure is None:
            self._call("rows", self._time[first:done], self.table[first:done])

    def end(self, table: Array) -> None:
        """Give observers the remaining rows, then end."""
        self.table = table
        self(len(table))
        self._call("end")

    def _call(self, method: str, *arguments: Any) -> None:
        """Call a method of all observers."""
        for observer in self._observers:
            try:
                self.stop |= bool(getattr(observer, method)(*arguments))
            except Exception as error:  # A user's observer may raise any error.
                now = float(self._time[max(0, min(self._delivered, len(self._time)) - 1)])
                message = f"{type(error).__name__}: {' '.join(str(error).split())[:MAX_CHARACTERS]}"
                self.failure = self.failure or SimulationError(f"the observer {type(observer).__name__}", now, message)


InputFunction = Callable[[float, Mapping[str, float]], Any]  # time [s], signals → value, None to hold the last
NamedFunctions = Mapping[str, InputFunction]  # `component.input` → function


class InputFunctions(Observer):
    """Functions that are called with new rows and return values of inputs."""

    def __init__(self, functions: NamedFunctions) -> None:
        self._functions, self._last = dict(functions), dict[str, Any]()

    def check(self, system: System) -> None:
        """Raise InputError for names that cannot be set, and for what is no function."""
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
        """Note the signals of a run."""
        self._columns, self._control = run.columns, run.control

    def rows(self, time: Array, values: Array) -> None:
        """Call the functions with the last of new rows, and set values that are new."""
        signals = dict(zip(self._columns, values[-1].tolist(), strict=True))
        given = {name: function(float(time[-1]), signals) for name, function in self._functions.items()}
        new = {n: v for n, v in given.items() if v is not None and (n not in self._last or self._last[n] != v)}
        if new and self._control is not None:
            self._control.set(new)
            self._last |= new
