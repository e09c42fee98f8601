"""Replay of components in a resumed run: the recorded inputs give the state that was not saved.

At point k a component took the inputs of row k − 1, overwritten by the transfers right before its step, whose values
are in row k; after the step it took the late values of row k. Every step is compared with the recorded outputs, so a
component that is not deterministic is found.
Components that C can step are replayed by its loop, as fast as in the run.
"""

from __future__ import annotations

import ctypes
import itertools
from array import array
from collections.abc import Callable, Collection, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.component import EarlyEnd, without_step
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.stepping import NEVER, Loop, NotCompiled, Slot, StopReason
from cosim.blocks.stepping import Transfer as CTransfer
from cosim.isolation.rows import CALLS, OTHER
from cosim.master.copying import Copying, doubles
from cosim.master.inbox import Inbox
from cosim.system.schedule import Stage
from cosim.system.system import System

Copy = Callable[[int], None]
POINTS = 1000  # points that C replays before their outputs are compared


class SteppedSystem(Protocol):
    """What checkpoints and replays use of a master: its system, signals, rows and counters."""

    system: System
    components: list[Any]
    h: float
    done: int
    time: Array
    row: Any
    view: memoryview[float]
    beside: list[Any]
    table: Array
    row_count: MutableSequence[int]
    doing: MutableSequence[int]
    copying: Copying
    inbox: Inbox | None
    in_c: bool

    @property
    def reruns(self) -> bool:
        """Return whether a resumed run repeats all steps."""

    def announce(self, component: Any, call: int = OTHER) -> None:
        """Store the next call."""

    def first_places(self, name: str) -> tuple[int, int]:
        """Return a component's first places, in and beside the row."""

    def active(self, stage: Stage) -> tuple[Any, ...]:
        """Return a component's step and its lengths."""


def is_same(one: Any, other: Any) -> bool:
    """Return whether values are equal; NaN equals NaN."""
    return bool(np.array_equal(np.asarray(one, float), np.asarray(other, float), equal_nan=True))


@dataclass(frozen=True)
class Replayed:
    """A component that is replayed, with its places in the row.

    Attributes:
        inputs: Places of its inputs, `outputs` those of its outputs.
        pulled: Places that transfers right before its step overwrite; the second part is beside the row.
        late: Places that transfers right after its step overwrite; the second part is beside the row.
        exchange: Function that puts these values and gets the outputs.
        exact_inputs: Places of inputs beside the row.
    """

    stage: Stage
    step: Callable[[float, float], None]
    length: float
    inputs: slice
    outputs: slice
    pulled: tuple[Sequence[int], Sequence[int]]
    late: tuple[Sequence[int], Sequence[int]]
    exchange: Callable[[], None]
    exact_inputs: range


class Replay:
    """Replay of components and of transfers with a memory, through the recorded rows of a master.

    Args:
        names: Components to replay.
        transfers: Whether transfers that remember values, such as delays, are replayed too.
    """

    def __init__(
        self, master: SteppedSystem, exact: Sequence[tuple[Any, ...]], names: Collection[str], transfers: bool
    ) -> None:
        self.master, self.exact = master, exact
        self.row, self.table, self.width = master.view, doubles(master.table), len(master.view)
        stages = [stage for stage in master.system.stages if stage.component.name in names]
        self.parts = [self._part(stage) for stage in stages]
        self.copies = [*self._remembering()] if transfers else []

    def run(self, last: int) -> None:
        """Replay up to a point; raise SimulationError for other outputs."""
        compiled = self._compiled(last) if self.master.in_c and last else ()
        self._run_in_python(last, [part for part in self.parts if part not in compiled])

    # -- internal -------------------------------------------------------------------------------

    def _run_in_python(self, last: int, parts: Sequence[Replayed]) -> None:
        """Replay components, and the remembering transfers, in Python."""
        if not parts and not self.copies:
            return
        master = self.master
        count, events = master.row_count, master.system.events
        for k in range(1, last + 1):
            for part in parts:
                if k % part.stage.every == 0:
                    self._step(part, k)
            for copy in self.copies:
                copy(k)
            for component in events.get(k, ()):
                self._change(component, events[k][component], parts)
            for part in parts:
                if k % part.stage.every == 0:
                    self._compare(part, k)
            count[0] = k  # Limits count from here; the row itself is there.

    def _compiled(self, last: int) -> Sequence[Replayed]:
        """Replay in C the components that C can step, and return these components."""
        slots = [(part, slot) for part in self.parts if isinstance(slot := self._slot(part), Slot)]
        if slots:
            try:
                CompiledReplay(self.master, slots).run(last)
            except NotCompiled:
                return ()
        return [part for part, _ in slots]

    def _slot(self, part: Replayed) -> Any:
        """Return the slot of a component for C, or None."""
        component = part.stage.component
        has_slot = isinstance(component, FmuBlock) and not (component.exact_inputs or component.exact_outputs)
        return component.slot() if has_slot and hasattr(component, "slot") else None

    def _part(self, stage: Stage) -> Replayed:
        master, component = self.master, stage.component
        first, beside = master.first_places(component.name)
        inputs, outputs = len(component.inputs), len(component.outputs)
        pulled: tuple[list[int], list[int]] = ([], [])
        late: tuple[list[int], list[int]] = ([], [])
        for places, transfers in ((pulled, stage.pulls), (late, stage.late)):
            for transfer in transfers:
                places[transfer.beside[1]].append(transfer.target)
        step, _, length, *_ = master.active(stage)
        return Replayed(
            stage,
            step,
            length,
            slice(first, first + inputs),
            slice(first + inputs, first + inputs + outputs),
            pulled,
            late,
            without_step(component, master.doing, CALLS * master.components.index(component)),
            range(beside, beside + len(component.exact_inputs)),
        )

    def _step(self, part: Replayed, k: int) -> None:
        row, table, width, begin, h = self.row, self.table, self.width, self.master.system.start, self.master.h
        before, now = (k - 1) * width, k * width
        inputs = part.inputs
        row[inputs] = table[before + inputs.start : before + inputs.stop]
        for place in part.pulled[0]:
            row[place] = table[now + place]
        for place in part.exact_inputs:
            self.master.beside[place] = self.exact[k if place in part.pulled[1] else k - 1][place]
        since = begin + (k - part.stage.every) * h
        try:
            part.step(since, part.length or (begin + k * h) - since)
            if part.stage.late:
                for place in part.late[0]:
                    row[place] = table[now + place]
                for place in part.late[1]:
                    self.master.beside[place] = self.exact[k][place]
                part.exchange()
        except EarlyEnd as end:
            raise difference(part, end.reached) from None

    def _compare(self, part: Replayed, k: int) -> None:
        """Raise SimulationError if outputs differ from those recorded."""
        outputs, now = part.outputs, k * self.width
        recorded = self.table[now + outputs.start : now + outputs.stop]
        if self.row[outputs].tobytes() != recorded.tobytes() and not is_same(self.row[outputs], recorded):
            raise difference(part, self.master.system.start + k * self.master.h)

    def _change(self, name: str, values: Any, parts: Sequence[Replayed]) -> None:
        for part in parts:
            if part.stage.component.name == name:
                part.stage.component.change(values)  # type: ignore[attr-defined]
                part.stage.component.get()

    def _remembering(self) -> list[Copy]:
        """Return the remembering transfers as functions."""
        system, links = self.master.system, self.master.copying.links
        transfers = (*system.held, *(transfer for stage in system.stages for transfer in stage.transfers))
        return [
            self._copy(transfer.source, transfer.beside[0], links[transfer.name])
            for transfer in transfers
            if any(hasattr(link, "restore") for link in links[transfer.name])
        ]

    def _copy(self, source: int, is_beside: bool, chain: Sequence[Any]) -> Copy:
        def copy(k: int) -> None:
            value = self.exact[k][source] if is_beside else self.table[k * self.width + source]
            for link in chain:
                value = link(k, value)

        return copy


def difference(part: Replayed, time: float) -> SimulationError:
    """Return the error of a component that gives other outputs than recorded."""
    return SimulationError(
        part.stage.component.name,
        time,
        (
            "its outputs differ from the recorded ones when its recorded inputs are replayed, so the run cannot go "
            "on; run the scenario again from its start"
        ),
    )


class CompiledReplay:
    """Replay of components by the stepping loop in C.

    Before each component slots write its recorded inputs into the row, and the late ones into cells of their own, from
    which they are transferred after its step. The outputs of many points are compared at once.
    """

    def __init__(self, master: SteppedSystem, slots: Sequence[tuple[Replayed, Slot]]) -> None:
        self.master, self.parts = master, [part for part, _ in slots]
        self.width = len(master.view)
        members: list[tuple[Slot, Sequence[Any], Sequence[Any]]] = []
        self._late_cells = (ctypes.c_double * max(1, sum(len(part.late[0]) for part in self.parts)))()
        first_late, place_of = ctypes.addressof(self._late_cells), itertools.count()
        for part, slot in slots:
            slot.every, slot.doing = part.stage.every, CALLS * master.components.index(part.stage.component)
            slot.length = part.length
            inputs = Slot(0, every=slot.every, time=slot.time, scalars=part.inputs.stop - part.inputs.start)
            inputs.row = ctypes.addressof(master.row) + 8 * part.inputs.start
            cells = [first_late + 8 * next(place_of) for _ in part.late[0]]
            to = [ctypes.addressof(master.row) + 8 * place for place in part.late[0]]
            late = Slot(0, every=slot.every, time=slot.time, scalars=len(cells))
            late.row = cells[0] if cells else first_late
            copies = [CTransfer(cell, place, 1, 0, None) for cell, place in zip(cells, to, strict=True)]
            members += [(inputs, (), ()), (late, (), ()), (slot, (), copies)]
        self.rows = np.zeros((POINTS, self.width))
        counters: dict[str, Any] = {"counter": master.row_count, "doing": master.doing, "asked": array("q", [0])}
        self.loop = Loop(members, (), master.row, self.rows, begin=master.system.start, h=master.h, **counters)
        self._values: list[Array] = []

    def run(self, last: int) -> None:
        """Replay up to a point; raise SimulationError for other outputs."""
        for first in range(1, last + 1, POINTS):
            end = min(first + POINTS - 1, last)
            self._prepare(first, end)
            try:
                self._until(end)
            finally:
                for part, slot in zip(self.parts, self.loop.slots[2::3], strict=True):
                    part.stage.component.set_time(slot.time)  # type: ignore[attr-defined]
            for part in self.parts:
                self._compare(part, first, end)

    # -- internal -------------------------------------------------------------------------------

    def _prepare(self, first: int, end: int) -> None:
        """Prepare the recorded inputs of points; rows of the loop begin at the first of them."""
        table, self._values = self.master.table, []
        for k, part in enumerate(self.parts):
            values = table[first - 1 : end, part.inputs].copy()
            for place in part.pulled[0]:
                values[:, place - part.inputs.start] = table[first : end + 1, place]
            late = table[first : end + 1, part.late[0]].copy()
            self._values += [values, late]
            self.loop.prepare(3 * k, values, first)
            self.loop.prepare(3 * k + 1, late, first)
        self.loop.plan.table = self.rows.ctypes.data - 8 * self.width * first

    def _until(self, end: int) -> None:
        loop, events = self.loop, self.master.system.events
        names = {part.stage.component.name for part in self.parts}
        pauses = iter([*sorted(k for k in events if loop.plan.next <= k <= end and names & events[k].keys()), NEVER])
        pause = next(pauses)
        while (why := loop.run(end, pause)) != StopReason.FINISHED:
            if why == StopReason.PAUSED:
                for part in self.parts:
                    if (component := part.stage.component).name in events[pause]:
                        component.change(events[pause][component.name])  # type: ignore[attr-defined]
                        component.get()
                pause = next(pauses)
            elif why != StopReason.LATER:
                part = self.parts[loop.plan.place // 3]
                try:
                    part.stage.component.raise_error(why, loop.plan, loop.slots[loop.plan.place])
                except EarlyEnd as stop:
                    raise difference(part, stop.reached) from None

    def _compare(self, part: Replayed, first: int, end: int) -> None:
        """Raise SimulationError if outputs differ from those recorded."""
        made, recorded = self.rows[: end + 1 - first, part.outputs], self.master.table[first : end + 1, part.outputs]
        if made.tobytes() == recorded.tobytes():
            return
        same = (made == recorded) | (np.isnan(made) & np.isnan(recorded))
        if not same.all():
            k = first + int(np.argmin(same.all(axis=1)))
            raise difference(part, self.master.system.start + k * self.master.h)
