"""Replay of components in a resumed run: the recorded inputs give the state that was not saved.

At point k a component took the inputs of row k − 1, overwritten by the transfers right before its step, whose values
are in row k. Every step is compared with the recorded outputs, so a component that is not deterministic is found.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.component import EarlyEnd
from cosim.isolation.rows import OTHER
from cosim.master import messages
from cosim.master.copying import Copying, doubles
from cosim.master.inbox import Inbox
from cosim.system.schedule import Stage
from cosim.system.system import System

Copy = Callable[[int], None]


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
        exact_inputs: Places of inputs beside the row.
    """

    stage: Stage
    step: Callable[[float, float], None]
    length: float
    inputs: slice
    outputs: slice
    pulled: tuple[Sequence[int], Sequence[int]]
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
        master = self.master
        count, events = master.row_count, master.system.events
        for k in range(1, last + 1):
            for part in self.parts:
                if k % part.stage.every == 0:
                    self._step(part, k)
            for copy in self.copies:
                copy(k)
            for component in events.get(k, ()):
                self._change(component, events[k][component])
            count[0] = k  # Limits count from here; the row itself is there.

    # -- internal -------------------------------------------------------------------------------

    def _part(self, stage: Stage) -> Replayed:
        master, component = self.master, stage.component
        first, beside = master.first_places(component.name)
        inputs, outputs = len(component.inputs), len(component.outputs)
        pulled: tuple[list[int], list[int]] = ([], [])
        for transfer in stage.pulls:
            pulled[transfer.beside[1]].append(transfer.target)
        step, _, length, *_ = master.active(stage)
        return Replayed(
            stage,
            step,
            length,
            slice(first, first + inputs),
            slice(first + inputs, first + inputs + outputs),
            pulled,
            range(beside, beside + len(component.exact_inputs)),
        )

    def _step(self, part: Replayed, k: int) -> None:
        row, table, width, begin, h = self.row, self.table, self.width, self.master.system.start, self.master.h
        before, now = (k - 1) * width, k * width
        inputs, outputs = part.inputs, part.outputs
        row[inputs] = table[before + inputs.start : before + inputs.stop]
        for place in part.pulled[0]:
            row[place] = table[now + place]
        for place in part.exact_inputs:
            self.master.beside[place] = self.exact[k if place in part.pulled[1] else k - 1][place]
        since = begin + (k - part.stage.every) * h
        try:
            part.step(since, part.length or (begin + k * h) - since)
        except EarlyEnd as end:
            raise self._difference(part, end.reached) from None
        recorded = table[now + outputs.start : now + outputs.stop]
        if row[outputs].tobytes() != recorded.tobytes() and not is_same(row[outputs], recorded):
            raise self._difference(part, begin + k * h)

    def _difference(self, part: Replayed, time: float) -> SimulationError:
        return SimulationError(part.stage.component.name, time, messages.NOT_REPEATED())

    def _change(self, name: str, values: Any) -> None:
        for part in self.parts:
            if part.stage.component.name == name:
                part.stage.component.change(values)  # type: ignore[attr-defined]

    def _remembering(self) -> list[Copy]:
        """Return the remembering transfers as functions."""
        system, links = self.master.system, self.master.copying.links
        transfers = (*system.held, *(transfer for stage in system.stages for transfer in stage.pulls))
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
