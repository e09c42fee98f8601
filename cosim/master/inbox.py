"""Changes of parameters and inputs that arrive while a run is stepped, and pauses.

The caller sends changes through a `Control`; the master takes them through an `Inbox` at its next look, about
`LOOK` [s] later, and notes the communication point. An event at that point repeats the change.

Changes go through files in a folder and counters that both sides may share. A record is complete before a counter
counts it. The noted changes survive a crash of the master.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, refuse
from cosim.isolation.rows import WAITING, Progress
from cosim.system.events import Targets, Variable
from cosim.system.system import System

Values = Mapping[str, Mapping[str, Any]]  # component → variable → value
LOOK = 0.01  # [s] between looks
MOST_STEPS, MOST_IN_C = 50, 5000  # steps between looks; the loop in C returns after a second at the latest
LATE = 0.5  # [s] after which steps have become slower than expected
PAUSE = 0.01  # [s] between looks during a pause
SENT, NOTED = "sent", "noted"  # files of a folder


@dataclass(frozen=True)
class Change:
    """Values set at a communication point."""

    point: int
    values: Values


class Inbox:
    """Received changes for the master.

    Attributes:
        most: Most steps between looks.
        pause: Length of the pause at the last look [s].
        changes: Changes so far.
    """

    def __init__(self, folder: Path, counters: Progress) -> None:
        self._folder, self._counters, self._received = folder, counters, 0
        self.most, self.pause, self.changes = MOST_STEPS, 0.0, list[Change]()
        self._point, self._due, self._time = 0, 0, -1.0

    def next_look(self, k: int) -> int:
        """Return the next point, from k on, at which to look; sooner if steps take long."""
        now = time.perf_counter()
        if self._due < k or now - self._time > LATE:
            rate = (k - self._point) / max(now - self._time, 1e-9) if self._time >= 0.0 else 0.0  # [steps/s]
            self._point, self._time = k, now
            self._due = k - 1 + max(1, min(self.most, int(LOOK * rate)))
        return self._due

    def take(self, k: int, events: Values) -> Values:
        """Wait for the end of a pause; return the values to set at point k: those of events, then those received."""
        counters, self.pause = self._counters, 0.0
        if counters.hold[0]:
            since = time.perf_counter()
            doing, counters.doing[0] = counters.doing[0], WAITING
            while counters.hold[0] and not counters.stop[0]:
                time.sleep(PAUSE)
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
    """Control of a running simulation, for any thread; `paused` holds it at a communication point."""

    def __init__(self, system: System, folder: Path, counters: Progress) -> None:
        self._system, self._folder, self._counters = system, folder, counters
        self._changes: Sequence[Change] = ()  # also after the end, when the files are gone
        self._lock = threading.Lock()

    @property
    def paused(self) -> bool:
        """Return whether the run is to wait."""
        return bool(self._counters.hold[0])

    @paused.setter
    def paused(self, on: bool) -> None:
        self._counters.hold[0] = on

    @property
    def changes(self) -> Sequence[Change]:
        """Return all changes that the master has noted so far."""
        self._changes = _records(self._folder / NOTED) or self._changes
        return self._changes

    @cached_property
    def _targets(self) -> Targets:
        return targets_of(self._system)

    @cached_property
    def variables(self) -> Sequence[Variable]:
        """Tunable parameters and unconnected inputs, which `set` may change."""
        starts = {s.component.name: getattr(s.component, "start_values", {}) for s in self._system.stages}
        return self._targets.variables(starts)

    def set(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Set variables at the next communication point; a value may be text with a unit, such as `12 deg`.

        After the end of the run the values are lost.

        Returns:
            The values in the variables' own units and types.

        Raises:
            InputError: Every fault of the values; none is set then.
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
    """Return the complete records of a file."""
    records = []
    with suppress(FileNotFoundError, EOFError, pickle.UnpicklingError), path.open("rb") as stream:
        while True:
            records.append(pickle.load(stream))
    return records


def with_changes(events: Mapping[int, Values], changes: Sequence[Change]) -> Mapping[int, Values]:
    """Return events overlaid with changes."""
    merged = dict(events)
    for change in changes:
        merged[change.point] = _merge(merged.get(change.point, {}), change.values)
    return merged


def _merge(*every: Values) -> Values:
    """Return the values of all mappings; later ones take precedence."""
    merged: dict[str, dict[str, Any]] = {}
    for values in every:
        for component, changes in values.items():
            merged.setdefault(component, {}).update(changes)
    return merged


def targets_of(system: System) -> Targets:
    """Return the variables of a system that may be set during a run."""
    parts = system.held, *(stage.transfers for stage in system.stages), *(loop.transfers for loop in system.loops)
    names = {transfer.name for part in parts for transfer in part}
    return Targets({name: description for name, (_, description) in system.fmus.items()}, names)
