"""Stepping loop in C, for components that C can call. It returns to Python when Python must act.

The loop returns for events, progress, new values of sources, any status other than OK, and once a second for signals of
the operating system. Python then acts as in its own loop, so the rows have the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.base.arrays import Array
from cosim.blocks.component import without_step
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import Loop, NotCompiled, Slot, StopReason, called_slot, library, transfer
from cosim.blocks.stepping import Transfer as CTransfer
from cosim.isolation.rows import CALLS
from cosim.system.event_blocks import is_exchange
from cosim.system.schedule import Stage
from cosim.system.system import System
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

PREPARED_POINTS = 1000  # points of source values computed at a time


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
    """All steps of a run after initialization, made in C.

    Raises:
        NotCompiled: Reason against C.
    """

    def __init__(self, master: Master) -> None:
        self.master, system = master, master.system
        if not master.in_c:
            raise NotCompiled("asked for")
        if master.solvers:
            raise NotCompiled("algebraic loops are solved")
        if any(system.courses):
            raise NotCompiled("inputs follow polynomials during a step")
        if system.beside:
            raise NotCompiled(f"{system.beside[0]} is no number that a double holds")
        self.slots = [self._slot(k, stage) for k, stage in enumerate(system.stages)]
        library()  # compiled only if used
        every = {stage.component.name: stage.every for stage in system.stages}
        self.loop = Loop(
            [
                (slot, self._transfers(stage.pulls), self._transfers(stage.late))
                for slot, stage in zip(self.slots, system.stages, strict=True)
            ],
            self._transfers(system.held, every),
            master.row,
            master.table,
            begin=system.start,
            h=master.h,
            counter=master.row_count,
            doing=master.doing,
            asked=master.asked,
            first=master.done,
        )
        self.sources = {k: c for k, c in enumerate(master.components) if isinstance(c, SourceBlock)}
        self._values: list[Array] = []

    def _slot(self, k: int, stage: Stage) -> Slot:
        """Return the slot of a component; raise NotCompiled if C cannot step it."""
        master, component, announced = self.master, stage.component, (self.master.doing, CALLS * k)
        slot = component.slot() if hasattr(component, "slot") else f"{component.name} has a process of its own"
        if isinstance(slot, str) and is_exchange(component) and any(map(is_stepped_in_c, master.components)):
            # Solvers of model exchange are Python; beside FMUs that C steps, C calls them.
            exchange = without_step(component, *announced)
            slot = called_slot(component.stepping(*announced), master.system.start, exchange)
        if not isinstance(slot, Slot):
            raise NotCompiled(slot)
        slot.every, slot.doing = stage.every, CALLS * k
        slot.length = stage.every * master.h if component.nominal_step else 0.0
        return slot

    def make_all(self) -> None:
        """Make all steps; errors are those of the Python loop."""
        steps = self.master.steps
        chunk = PREPARED_POINTS if self.sources else steps
        for first in range(self.master.done, steps + 1, max(1, chunk)):
            last = min(first + chunk - 1, steps)
            if self.sources:
                self._prepare(first, last)
            self._until(last)

    def _until(self, last: int) -> None:
        loop, master = self.loop, self.master
        pause = master.next_call(loop.plan.next)
        while True:
            try:
                why = loop.run(last, pause)
            finally:
                for component, slot in zip(master.components, loop.slots, strict=True):
                    component.set_time(slot.time)
            if why == StopReason.FINISHED:
                return
            if why == StopReason.PAUSED:
                master.make_calls(pause)
                loop.plan.place = loop.plan.slots  # Events may have changed outputs: the held transfers are made again.
                pause = master.next_call(pause + 1)
            elif why == StopReason.NO_ITEM:
                self._raise_no_item()
            elif why == StopReason.FAILED:  # without an error after Ctrl-C between C and Python
                raise next(iter(self.slots[loop.plan.place].failures), KeyboardInterrupt())
            elif why == StopReason.LATER:
                master.look(loop.plan.next - 1)
                pause = master.next_call(loop.plan.next)  # Steps may have become slower.
            else:
                master.components[loop.plan.place].raise_error(why, loop.plan, loop.slots[loop.plan.place])

    # -- internal -------------------------------------------------------------------------------

    def _transfers(
        self, transfers: Iterable[Transfer], every: Mapping[str, int] = MappingProxyType({})
    ) -> list[CTransfer]:
        """Return transfers in the form for C. A held value is transferred when its target steps."""
        c_transfers = []
        for t in transfers:
            links = [linked.link() for linked in self.master.copying.links[t.name]]
            period = every.get(t.name.partition(".")[0], 1)
            c_transfers.append(transfer(self.master.row, t.source, t.target, links, period))
        return c_transfers

    def _prepare(self, first: int, last: int) -> None:
        """Prepare source values at the given points. Times are computed as by the sources themselves."""
        begin, h = self.master.system.start, self.master.h
        points = np.arange(first, last + 1, dtype=np.float64)
        self._values = []
        for k, source in self.sources.items():
            every = self.master.system.stages[k].every
            times = (begin + (points - every) * h) + every * h
            self._values.append(source.over(times))
            self.loop.prepare(k, self._values[-1], first)

    def _raise_no_item(self) -> None:
        """Raise SimulationError for a value that is no item of its target's enumeration."""
        system, plan = self.master.system, self.loop.plan
        stages = system.stages
        transfers = stages[plan.place].transfers if plan.place < len(stages) else system.held
        for t in transfers:
            t.check_item(self.master.row[t.target], system.start + plan.next * self.master.h)
        raise AssertionError("C met a value that is no item, and there is none")
