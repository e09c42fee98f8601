"""Observers of a running simulation: a progress bar, a live plot, a recorder. They get the rows while they are made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError


@dataclass(frozen=True)
class Observed:
    """What an observer is told of a run before its first row.

    columns: names `component.variable`, one a column of the rows
    rows:    number of rows that the run makes unless it ends early
    start:   time of the first row [s]
    step:    communication step [s]
    """

    columns: Sequence[str]
    rows: int
    start: float
    step: float


class Observer:
    """Base of observers; each method may be overridden. An exception in one ends the run; its rows so far are kept."""

    def begin(self, run: Observed) -> None:
        """Get ready for the rows of a run."""

    def rows(self, time: Array, values: Array) -> bool | None:
        """Take rows that are new, shape (rows, columns), valid during this call; True asks the run to end.

        Rows that were made before the run heard of it still come.
        """

    def end(self) -> None:
        """Take note that there are no more rows, also where the run failed."""


Observers = Sequence[Observer]


class ProgressObserver(Observer):
    """An observer that tells a function how many rows there are, and of how many."""

    def __init__(self, progress: Callable[[int, int], None]) -> None:
        self._progress, self._done, self._steps = progress, 0, 0

    def begin(self, run: Observed) -> None:
        """Count from the first row."""
        self._done, self._steps = 0, run.rows - 1

    def rows(self, time: Array, values: Array) -> None:
        """Tell how many rows there are."""
        self._done += len(time)
        self._progress(min(self._done, self._steps), self._steps)


class Feed:
    """Gives the rows of a run to its observers, each row once, and remembers whether one wants the run to end.

    stop:    why the run is to end, "" while it goes on
    failure: the error of an observer
    """

    def __init__(self, observers: Sequence[Observer], run: Observed, time: Array) -> None:
        self._observers, self._time, self._given = observers, time, 0
        self.table: Array | None = None  # where the rows are made
        self.stop = ""
        self.failure: SimulationError | None = None
        for observer in observers:
            self._guarded(observer, lambda o=observer: o.begin(run))  # type: ignore[misc]

    @property
    def over(self) -> bool:
        """Whether the run is to end."""
        return bool(self.stop) or self.failure is not None

    def __call__(self, done: int) -> None:
        """Give the rows that are new of `done` rows."""
        first, self._given = self._given, max(self._given, done)
        if self.table is None or first >= done or self.failure is not None:
            return
        time, values = self._time[first:done], self.table[first:done]
        for observer in self._observers:
            self._guarded(observer, lambda o=observer: o.rows(time, values))  # type: ignore[misc]

    def end(self, table: Array) -> None:
        """Give the rest of the rows, and end."""
        self.table = table
        self(len(table))
        for observer in self._observers:
            self._guarded(observer, observer.end)

    def _guarded(self, observer: Observer, call: Callable[[], bool | None]) -> None:
        name = type(observer).__name__
        try:
            if call() and not self.stop:
                self.stop = f"{name} asked for it"
        except Exception as error:  # whatever the observer of a user does
            now = float(self._time[max(0, min(self._given, len(self._time)) - 1)])
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"
            self.failure = self.failure or SimulationError(f"the observer {name}", now, reason)
