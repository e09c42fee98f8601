"""Stepping loop in C, for components that C can call. It returns to Python when Python must act.

The loop returns for events, progress, new values of sources, any status other than OK, and once a second for signals of
the operating system. Python then acts as in its own loop, so the rows have the same bytes.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import (
    IN_PYTHON,
    ConvertedLink,
    NotCompiled,
    Plan,
    Slot,
    StopReason,
    address_of,
    cores,
    library,
)
from cosim.blocks.stepping import Transfer as CTransfer
from cosim.core.arrays import Array
from cosim.master.observer import MOST_IN_C
from cosim.system.schedule import batches
from cosim.system.system import System
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

PREPARED_POINTS = 1000  # points of source values computed at a time


def compile_beforehand(system: System) -> None:
    """Compile the loop now, outside the time limits of calls."""
    fmus = (stage.component for stage in system.stages if not isinstance(stage.component, SourceBlock))
    if not any(fmu.nominal_step for fmu in fmus):  # Python steps FMUs made of Python.
        with suppress(NotCompiled):
            library()


class CompiledSteps:
    """Equal steps of a run after initialization, made in C.

    Raises:
        NotCompiled: Reason against C.
    """

    def __init__(self, master: Master) -> None:
        self.master, system = master, master.system
        if not master.in_c:
            raise NotCompiled("asked for")
        if any(system.courses):
            raise NotCompiled("inputs follow polynomials")
        if system.beside:
            raise NotCompiled(f"{system.beside[0]} is no number that a double holds")
        self.in_python: dict[str, str] = {}  # component → why Python steps it
        self._begin, self._spent_in_python = time.perf_counter(), 0.0  # [s]
        slots: list[Slot] = []
        self.components: list[Any] = [stage.component for stage in system.stages]
        for stage, component in zip(system.stages, self.components, strict=True):
            slot = self._slot(component)
            slot.every, slot.doing = stage.every, master.numbers[component.name]
            slots.append(slot)
        if self.in_python and not any(slot.version > 0 for slot in slots):
            raise NotCompiled(next(iter(self.in_python.values())))
        self._library = library()  # compiled only if used
        self._keeping: list[Any] = [slots]  # memory that C uses
        for slot, stage in zip(slots, system.stages, strict=True):
            if slot.version == IN_PYTHON:
                continue
            (slot.pulls, slot.pull), (slot.lates, slot.late) = map(self._transfers, (stage.pulls, stage.late))
        together, first = [len(batch) for batch in batches(system.stages)], 0
        for count in together:
            slots[first].batch = count
            first += count
        self.slots = (Slot * len(slots))(*slots)
        self.plan = plan = Plan(system.start, master.h, slots=len(slots), width=len(master.row), next=master.done)
        plan.threads = min(cores(), max(together, default=1)) - 1
        plan.slot = ctypes.addressof(self.slots)
        plan.holds, plan.hold = self._transfers(system.held, {s.name: s.every for s in system.stages})
        plan.row, plan.table = ctypes.addressof(master.row), master.table.ctypes.data
        plan.counter, plan.doing, plan.asked = map(address_of, (master.row_count, master.doing, master.asked))
        master.together.append(self)

    def _slot(self, component: Any) -> Slot:
        """Return the slot of a component; raise NotCompiled where Python steps all components."""
        name = component.name
        if not hasattr(component, "slot"):
            raise NotCompiled(f"{name} has a process of its own")
        slot: Slot | str = component.slot()
        if any(name in solver.names for solver in self.master.solvers):
            slot = "algebraic loops are solved"
        if isinstance(slot, Slot):
            return slot
        if getattr(component, "is_apart", False) or (isinstance(component, FmuBlock) and component.nominal_step):
            raise NotCompiled(slot)
        self.in_python[name] = slot
        return Slot(IN_PYTHON)

    def _transfers(
        self, transfers: Iterable[Transfer], every: Mapping[str, int] = MappingProxyType({})
    ) -> tuple[int, int]:
        """Return the number and the address of transfers in the form for C.

        Args:
            every: Component → its step; a held value is transferred when its target steps.
        """
        first, made = ctypes.addressof(self.master.row), []
        for t in transfers:
            links = [link.link() for link in self.master.links[t.name]]
            chain = (ConvertedLink * len(links))(*links)
            ends = first + 8 * t.source, first + 8 * t.target
            made.append(CTransfer(*ends, every.get(t.receiver, 1), len(chain), ctypes.addressof(chain)))
            self._keeping += links, chain
        array = (CTransfer * len(made))(*made)
        self._keeping.append(array)
        return len(made), ctypes.addressof(array)

    @property
    def loop(self) -> str:
        """Return the kind of loop, with the components that Python steps."""
        reasons = "; ".join(dict.fromkeys(self.in_python.values()))
        return f"C, but in Python: {reasons}" if reasons else "C"

    def finish(self) -> None:
        """Record the components that Python has stepped, and their share of the time."""
        if self.in_python:
            share = self._spent_in_python / (time.perf_counter() - self._begin)
            self.master.details["in_python"] = {"components": self.in_python, "share": share}

    def close(self) -> None:
        """End the threads that have stepped slow FMUs, and free the texts."""
        self._library.finish(ctypes.byref(self.plan))

    def _react(self, why: StopReason) -> None:
        """Do what C cannot; raise the error behind a return. A warning of an FMU is only logged."""
        master, plan, place, begin = self.master, self.plan, self.plan.place, time.perf_counter()
        system, end = master.system, master.system.start + plan.next * master.h
        if why == StopReason.NO_ITEM:
            for t in system.stages[place].transfers if place < plan.slots else system.held:
                t.check_item(master.row[t.target], end)
            raise AssertionError("C met a value that is no item, and there is none")
        if why != StopReason.ASKED:
            self.components[place].raise_error(why, self.slots[place])
            return
        since = system.start + (plan.next - 1) * master.h
        master.advance((master.actives[self.components[place].name],), plan.next, since, end)
        self._spent_in_python += time.perf_counter() - begin
        plan.place += 1

    def make_all(self) -> None:
        """Make all steps; errors are those of the Python loop. Source values are prepared for some points at a time."""
        master, plan, system = self.master, self.plan, self.master.system
        master.is_compiled = True
        if master.inbox is not None:
            master.inbox.most = MOST_IN_C
        stages = enumerate(system.stages)
        sources = [(k, stage.every, c) for k, stage in stages if isinstance(c := stage.component, SourceBlock)]
        chunk = PREPARED_POINTS if sources else max(1, master.steps)
        for first in range(master.done, master.steps + 1, chunk):
            last, values = min(first + chunk - 1, master.steps), list[Array]()
            points = np.arange(first, last + 1 if sources else first, dtype=np.float64)
            for k, every, source in sources:  # Times are computed as by the sources themselves.
                values.append(source.over((system.start + (points - every) * master.h) + every * master.h))
                self.slots[k].prepared, self.slots[k].since = values[-1].ctypes.data, first
            # C returns at points where Python is to act.
            plan.last, plan.pause = last, master.next_call(plan.next)
            while True:
                try:
                    why = StopReason(self._library.run(ctypes.byref(plan)))
                finally:
                    for component, slot in zip(self.components, self.slots, strict=True):
                        if slot.version != IN_PYTHON:
                            component.set_time(slot.time)
                if why == StopReason.FINISHED:
                    break
                if why == StopReason.PAUSED:
                    master.change(plan.pause)
                    # Events may have changed outputs: the held transfers are made again.
                    plan.place = plan.slots
                    master.tell(plan.pause)
                    plan.pause = master.next_call(plan.pause + 1)
                elif why == StopReason.LATER:
                    if master.asked[0]:
                        master.keeper.look(master, plan.next - 1)
                    plan.pause = master.next_call(plan.next)  # Steps may have become slower.
                else:
                    self._react(why)
