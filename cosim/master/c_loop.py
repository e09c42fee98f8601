"""Stepping loop in C, for components that C can call. It returns to Python when Python must act.

The loop returns for events, progress, new values of sources, any status other than OK, and once a second for signals of
the operating system. Python then acts as in its own loop, so the rows have the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.blocks.component import without_step
from cosim.blocks.faults import LinkFunction
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import Loop, NotCompiled, Slot, StopReason, called_slot, library, transfer
from cosim.blocks.stepping import Transfer as CTransfer
from cosim.isolation.rows import CALLS, Rows
from cosim.system.event_blocks import is_exchange
from cosim.system.system import System
from cosim.system.wiring import Transfer

PREPARED_POINTS = 1000  # points of source values computed at a time


@dataclass(frozen=True)
class LoopData:
    """Data of a run that the stepping loop in C needs, after the first row is complete.

    Attributes:
        links: Conversions of a transfer's value, in order.
        calls: Functions called with each requested point, before its row is stored.
        next_call: Function returning the next requested point at or after a point, or `NEVER`.
        later: Function called with the last complete point, at least once a second.
        first: First point to make.
    """

    system: System
    components: Sequence[Any]
    steps: int
    h: float
    row: Any
    rows: Rows
    links: Callable[[Transfer], Sequence[LinkFunction]]
    calls: Sequence[Callable[[int], None]]
    next_call: Callable[[int], int]
    later: Callable[[int], None] = lambda k: None
    first: int = 1


def prepare_steps(run: LoopData) -> CompiledSteps:
    """Return the steps of a run, prepared for C; raise NotCompiled with the reason if C cannot make them."""
    if run.system.beside:
        raise NotCompiled(f"{run.system.beside[0]} is no number that a double holds")
    slots = []
    for number, component in enumerate(run.components):
        slot = component.slot() if hasattr(component, "slot") else f"{component.name} has a process of its own"
        if isinstance(slot, str) and is_exchange(component) and any(is_stepped_in_c(c) for c in run.components):
            # Solvers of model exchange are Python; beside FMUs that C steps, C calls them.
            announced = run.rows.doing, CALLS * number
            exchange = without_step(component, *announced)
            slot = called_slot(component.stepping(*announced), run.system.start, exchange)
        if isinstance(slot, str):
            raise NotCompiled(slot)
        slots.append(slot)
    library()  # compiled only if used
    return CompiledSteps(run, slots)


def is_stepped_in_c(component: Any) -> bool:
    """Return whether C steps a component as an FMU."""
    return isinstance(component, FmuBlock) and isinstance(component.slot(), Slot)


def compile_beforehand(system: System) -> None:
    """Compile the loop now, outside the time limits of calls."""
    fmus = (stage.component for stage in system.stages if not isinstance(stage.component, SourceBlock))
    if not system.beside and not any(fmu.nominal_step for fmu in fmus):  # Python steps FMUs made of Python.
        with suppress(NotCompiled):
            library()


class CompiledSteps:
    """All steps of a run after initialization, made in C."""

    def __init__(self, run: LoopData, slots: Sequence[Slot]) -> None:
        self.run, self.slots, system = run, slots, run.system
        every = {stage.component.name: stage.every for stage in system.stages}
        for k, (slot, stage) in enumerate(zip(slots, system.stages, strict=True)):
            slot.every, slot.doing = stage.every, CALLS * k
            slot.length = stage.every * run.h if stage.component.nominal_step else 0.0
        self.loop = Loop(
            [
                (slot, self._transfers(stage.pulls), self._transfers(stage.late))
                for slot, stage in zip(slots, system.stages, strict=True)
            ],
            self._transfers(system.held, every),
            run.row,
            run.rows.table,
            begin=system.start,
            h=run.h,
            counter=run.rows.made,
            doing=run.rows.doing,
            asked=run.rows.asked,
            first=run.first,
        )
        self.sources = {k: c for k, c in enumerate(run.components) if isinstance(c, SourceBlock)}
        self._values: list[Array] = []

    def make_all(self) -> None:
        """Make all steps; errors are those of the Python loop."""
        run, chunk = self.run, PREPARED_POINTS if self.sources else self.run.steps
        for first in range(run.first, run.steps + 1, max(1, chunk)):
            last = min(first + chunk - 1, run.steps)
            if self.sources:
                self._prepare(first, last)
            self._until(last)

    def _until(self, last: int) -> None:
        loop, run = self.loop, self.run
        pause = run.next_call(loop.plan.next)
        while True:
            try:
                why = loop.run(last, pause)
            finally:
                for component, slot in zip(run.components, loop.slots, strict=True):
                    component.set_time(slot.time)
            if why == StopReason.FINISHED:
                return
            if why == StopReason.PAUSED:
                for call in run.calls:
                    call(pause)
                loop.plan.place = loop.plan.slots  # Events may have changed outputs: the held transfers are made again.
                pause = run.next_call(pause + 1)
            elif why == StopReason.NO_ITEM:
                self._raise_no_item()
            elif why == StopReason.FAILED:  # without an error after Ctrl-C between C and Python
                raise next(iter(self.slots[loop.plan.place].failures), KeyboardInterrupt())
            elif why == StopReason.LATER:
                run.later(loop.plan.next - 1)
                pause = run.next_call(loop.plan.next)  # Steps may have become slower.
            else:
                run.components[loop.plan.place].raise_error(why, loop.plan, loop.slots[loop.plan.place])

    # -- internal -------------------------------------------------------------------------------

    def _transfers(
        self, transfers: Iterable[Transfer], every: Mapping[str, int] = MappingProxyType({})
    ) -> list[CTransfer]:
        """Return transfers in the form for C. A held value is transferred when its target steps."""
        c_transfers = []
        for t in transfers:
            links = [linked.link() for linked in self.run.links(t)]
            period = every.get(t.name.partition(".")[0], 1)
            c_transfers.append(transfer(self.run.row, t.source, t.target, links, period))
        return c_transfers

    def _prepare(self, first: int, last: int) -> None:
        """Prepare source values at the given points. Times are computed as by the sources themselves."""
        begin, h = self.run.system.start, self.run.h
        points = np.arange(first, last + 1, dtype=np.float64)
        self._values = []
        for k, source in self.sources.items():
            every = self.run.system.stages[k].every
            times = (begin + (points - every) * h) + every * h
            self._values.append(source.over(times))
            self.loop.prepare(k, self._values[-1], first)

    def _raise_no_item(self) -> None:
        """Raise SimulationError for a value that is no item of its target's enumeration."""
        system, plan = self.run.system, self.loop.plan
        stages = system.stages
        transfers = stages[plan.place].transfers if plan.place < len(stages) else system.held
        for t in transfers:
            t.check_item(self.run.row[t.target], system.start + plan.next * self.run.h)
        raise AssertionError("C met a value that is no item, and there is none")
