"""Stepping loop in C, for components that C can call. It returns to Python when Python must act.

The loop returns for events, progress, new values of sources, any status other than OK, and once a second for signals of
the operating system. Python then acts as in its own loop, so the rows have the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from cosim.blocks.component import without_step
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import Loop, NotCompiled, Slot, StopReason, called_slot, library, transfer
from cosim.blocks.stepping import Transfer as CTransfer
from cosim.core.arrays import Array
from cosim.master.inbox import MOST_IN_C
from cosim.system.events import is_exchange
from cosim.system.system import System
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

PREPARED_POINTS = 1000  # points of source values computed at a time


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
        self.master, system, h = master, master.system, master.h
        if not master.in_c:
            raise NotCompiled("asked for")
        if master.solvers:
            raise NotCompiled("algebraic loops are solved")
        if any(system.courses):
            raise NotCompiled("inputs follow polynomials during a step")
        if system.beside:
            raise NotCompiled(f"{system.beside[0]} is no number that a double holds")
        self.slots: list[Slot] = []
        for stage in system.stages:
            component, announced = stage.component, (master.doing, master.numbers[stage.component.name])
            slot = component.slot() if hasattr(component, "slot") else f"{component.name} has a process of its own"
            others = (c for c in master.components if isinstance(c, FmuBlock) and isinstance(c.slot(), Slot))
            if isinstance(slot, str) and is_exchange(component) and any(others):
                # Solvers of model exchange are Python; beside FMUs that C steps, C calls them.
                slot = called_slot(component.stepping(*announced), system.start, without_step(component, *announced))
            if not isinstance(slot, Slot):
                raise NotCompiled(slot)
            slot.every, slot.doing = stage.every, announced[1]
            self.slots.append(slot)
        library()  # compiled only if used
        every = {stage.component.name: stage.every for stage in system.stages}

        def transfers(each: Iterable[Transfer], every: Mapping[str, int] = MappingProxyType({})) -> list[CTransfer]:
            """Return transfers in the form for C. A held value is transferred when its target steps."""
            periods = [(t, every.get(t.name.partition(".")[0], 1)) for t in each]
            links = master.copying.links
            return [
                transfer(master.row, t.source, t.target, [link.link() for link in links[t.name]], period)
                for t, period in periods
            ]

        self.loop = Loop(
            [
                (slot, transfers(stage.pulls), transfers(stage.late))
                for slot, stage in zip(self.slots, system.stages, strict=True)
            ],
            transfers(system.held, every),
            master.row,
            master.table,
            begin=system.start,
            h=h,
            counter=master.row_count,
            doing=master.doing,
            asked=master.asked,
            first=master.done,
        )

    def make_all(self) -> None:
        """Make all steps; errors are those of the Python loop. Source values are prepared for some points at a time."""
        master, loop, system = self.master, self.loop, self.master.system
        if master.inbox is not None:
            master.inbox.most = MOST_IN_C
        stages = enumerate(system.stages)
        sources = [(k, stage.every, c) for k, stage in stages if isinstance(c := stage.component, SourceBlock)]
        chunk = PREPARED_POINTS if sources else max(1, master.last)
        for first in range(master.done, master.last + 1, chunk):
            last, values = min(first + chunk - 1, master.last), list[Array]()
            points = np.arange(first, last + 1 if sources else first, dtype=np.float64)
            for k, every, source in sources:  # Times are computed as by the sources themselves.
                values.append(source.over((system.start + (points - every) * master.h) + every * master.h))
                loop.prepare(k, values[-1], first)
            # C returns at points where Python is to act.
            pause = master.next_call(loop.plan.next)
            while True:
                try:
                    why = loop.run(last, pause)
                finally:
                    for component, slot in zip(master.components, loop.slots, strict=True):
                        component.set_time(slot.time)
                place = loop.plan.place
                if why == StopReason.FINISHED:
                    break
                if why == StopReason.PAUSED:
                    master.change(pause)
                    master.tell(pause)
                    # Events may have changed outputs: the held transfers are made again.
                    loop.plan.place = loop.plan.slots
                    pause = master.next_call(pause + 1)
                elif why == StopReason.NO_ITEM:
                    for t in system.stages[place].transfers if place < len(system.stages) else system.held:
                        t.check_item(master.row[t.target], system.start + loop.plan.next * master.h)
                    raise AssertionError("C met a value that is no item, and there is none")
                elif why == StopReason.FAILED:  # without an error after Ctrl-C between C and Python
                    raise next(iter(self.slots[place].failures), KeyboardInterrupt())
                elif why == StopReason.LATER:
                    if master.asked[0] and master.keeper is not None:
                        master.keeper.look(master, loop.plan.next - 1)
                    pause = master.next_call(loop.plan.next)  # Steps may have become slower.
                else:
                    master.components[place].raise_error(why, loop.plan, loop.slots[place])
