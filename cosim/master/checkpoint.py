"""Checkpoints of a run, and runs that continue from a checkpoint.

A checkpoint contains the state of every component that can save its state, the memory of the connections, and a hash of
the rows so far. The rows themselves are in the file to which the run writes them. If a component cannot save its state,
a resumed run repeats all steps and compares them with the rows. Every object with `save` and `restore`, as in
`cosim.blocks.component`, is included.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.component import GET
from cosim.core.arrays import Array
from cosim.core.errors import Interrupted, SimulationError
from cosim.core.messages import Note
from cosim.files.state_file import pack, sync, unpack, write_durable
from cosim.isolation import worker as here
from cosim.isolation.rows import NO_CALL, exact_line, read_exact
from cosim.master.observer import Change
from cosim.system.system import System

if TYPE_CHECKING:
    from cosim.master.master import Master

ROWS_FILE, BESIDE_FILE, STATE_FILE = "rows", "beside", "state"  # files of a run, in one folder
HASHED = 1 << 20  # values hashed at a time
NOT_RESTORED = (
    "its outputs differ after a saved state is restored; use an FMU that restores its state, or one that does not "
    "declare that it can"
)


@dataclass(frozen=True)
class Continuation:
    """The rows and the state from which a run continues.

    Attributes:
        exact: For each row, the values that doubles cannot represent.
        state: Content of a state file, if any.
        changes: Changes by observers so far, which have been added to the events of the system.
    """

    values: Array
    exact: Sequence[tuple[Any, ...]] = ()
    state: bytes | None = None
    changes: Sequence[Change] = ()

    @property
    def count(self) -> int:
        """Return the number of rows."""
        return len(self.values)

    def unsaved(self, system: System) -> Sequence[str]:
        """Return the components without a saved state; if there are any, all steps are repeated."""
        states = {} if self.state is None else unpack(self.state)["components"]
        return [name for name in system.names if states.get(name) is None]


@dataclass(frozen=True)
class Keeping:
    """Settings of the checkpoints of a run.

    Attributes:
        folder: Folder for rows and state during the run; None if a checkpoint is written only when the run is stopped.
        interval: Wall time [s] between two checkpoints.
        start: Rows and state from which the run continues; None for a new run.
    """

    folder: Path | None = None
    interval: float | None = None
    start: Continuation | None = None


class RowsHash:
    """SHA-256 of the first rows of a run; each call continues from the previous one."""

    def __init__(self) -> None:
        self._rows, self._lines, self._count = hashlib.sha256(), hashlib.sha256(), 0

    def of(self, values: Array, exact: Sequence[tuple[Any, ...]], count: int) -> str:
        """Return the hash of the first `count` rows."""
        part_size = max(1, HASHED // max(1, values.shape[1]))
        for first in range(self._count, count, part_size):
            part = values[first : min(count, first + part_size)] + 0.0
            part[np.isnan(part)] = np.nan
            self._rows.update(part.tobytes())
        for row in exact[self._count : count]:
            self._lines.update(exact_line(row))
        self._count = count
        return f"{self._rows.hexdigest()}{self._lines.hexdigest()}"


@dataclass
class Keeper:
    """Writer of checkpoints, in the process that steps the run.

    Attributes:
        place: Folder of the files.
        asked: [True if the loop must call `look`]; `ending` is true if the caller also requests the end of the run.
        interval: Wall time [s] between two checkpoints; None if a checkpoint is written only when the run is stopped.
        start: Rows and state from which the run continues, if any.
        repeated: Number of rows whose steps are repeated; 0 if all states are restored.
    """

    place: Path
    asked: MutableSequence[int]
    ending: MutableSequence[int]
    interval: float | None = None
    start: Continuation | None = None
    repeated: int = 0
    hash: RowsHash = field(default_factory=RowsHash)
    is_over: threading.Event = field(default_factory=threading.Event)

    def begin(self, master: Master) -> None:
        """Continue from `start`, and begin to write checkpoints."""
        if self.start is not None:
            if _first_difference(master.table[:1], self.start.values[:1]) is not None:
                raise SimulationError(
                    "the run",
                    float(master.time[0]),
                    "the components start with other values than in the stopped run; run the scenario again from "
                    "its start",
                )
            if self.start.unsaved(master.system):
                self.repeated = self.start.count
            else:
                self._restore(master, self.start)
        self._last = time.monotonic()
        if self.interval is not None:
            threading.Thread(target=self._tick, args=(self.interval,), daemon=True).start()

    def _tick(self, interval: float) -> None:
        while not self.is_over.wait(interval):
            self.asked[0] = 1

    def _restore(self, master: Master, start: Continuation) -> None:
        """Restore the states of all components at the last row of a stopped run.

        Raises:
            SimulationError: The state belongs to another system, or a component's outputs differ from the last row.
        """
        assert start.state is not None
        state, last = unpack(start.state), start.count - 1
        master.done, master.table[: start.count] = start.count, start.values
        try:
            for name, memories in state.get("links", {}).items():
                for link, memory in zip(master.copying.links[name], memories, strict=True):
                    link.restore(memory)
            for component in master.components:
                master.announce(component)
                component.restore(state["components"][component.name])
                if last == 0 or component.name in master.system.events.get(last, {}):
                    continue  # An event may change outputs after they are recorded.
                first = master.first_places[0].get(component.name, 0) + len(component.inputs)
                outputs = slice(first, first + len(component.outputs))
                master.announce(component, GET)
                component.get()
                if _first_difference(np.array([master.row[outputs]]), start.values[last:, outputs]) is not None:
                    raise SimulationError(component.name, float(master.time[last]), NOT_RESTORED)
        except (ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:  # other system
            raise SimulationError(
                "the run",
                float(master.time[last]),
                f"the checkpoint has no state of these components ({error}); run the scenario again from its start",
            ) from None
        master.values[:] = start.values[last]
        if start.exact:
            master.beside[:] = start.exact[last]
        master.row_count[0] = start.count

    def look(self, master: Master, k: int) -> None:
        """Write a checkpoint after point k if it is due; raise Interrupted if the caller requests an end."""
        self.asked[0] = 0
        if self.ending[0]:
            self.save(master, k)
            raise Interrupted("the run", float(master.time[k]), Note("stopped after a checkpoint"))
        if self.interval is not None and time.monotonic() - self._last >= 0.5 * self.interval:
            self.save(master, k)

    def save(self, master: Master, k: int) -> None:
        """Write the checkpoint of point k."""
        if self.start is not None and k + 1 < self.start.count:
            return
        self.compare_rows(master, k + 1)
        components, changes = {}, [] if self.start is None else [*self.start.changes]
        for component in master.components:
            master.announce(component)
            can_save = hasattr(component, "checkpoint") and not master.system.reruns
            components[component.name] = component.checkpoint() if can_save else None
        master.doing[0] = NO_CALL
        links = {name: [link.save(k) for link in chain] for name, chain in master.copying.links.items()}
        if master.inbox is not None:
            changes += master.inbox.changes
        for name in (ROWS_FILE, BESIDE_FILE):
            sync(self.place / name)
        content = {
            "point": k,
            "time": float(master.time[k]),
            "rows": self.hash.of(master.table, read_exact(self.place / BESIDE_FILE, k + 1), k + 1),
            "components": components,
            "links": links,
            "changes": [[c.point, c.values] for c in changes],
        }
        here.hold_if_abandoned()
        write_durable(self.place / STATE_FILE, pack(content))
        self._last = time.monotonic()

    def compare_rows(self, master: Master, k: int) -> None:
        """Raise SimulationError if repeated rows, up to point k, differ from the recorded ones."""
        if self.start is None or not 0 < self.repeated <= k:
            return
        self.repeated = 0
        place = _first_difference(master.table[: self.start.count], self.start.values)
        if place is not None:
            reason = (
                "its outputs differ from the recorded outputs when its steps are repeated, so the run cannot continue; "
                "run the scenario again from its start"
            )
            component = master.system.columns[place[1]].partition(".")[0]
            raise SimulationError(component, float(master.time[place[0]]), reason)


def _first_difference(values: Array, recorded: Array) -> tuple[int, int] | None:
    """Return row and column of the first difference, or None; NaN counts as equal to NaN."""
    differs = (values != recorded) & ~(np.isnan(values) & np.isnan(recorded))
    return divmod(int(np.argmax(differs)), differs.shape[1]) if differs.any() else None
