"""Stepping loop in C, for components that C can call. The loop returns when Python must act.

The loop returns for events, progress, new values of sources, any status other than OK, and once a second for signals of
the operating system. Python then does the same as in its own loop, so that the rows are equal bit for bit.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import (
    IN_PYTHON,
    Cell,
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
from cosim.fmi.fmi_types import FMI3
from cosim.master.observer import MOST_IN_C
from cosim.system.schedule import Stage, batches
from cosim.system.system import System
from cosim.system.wiring import Transfer

if TYPE_CHECKING:
    from cosim.master.master import Master

PREPARED_POINTS = 1000  # points for which source values are computed in advance


def compile_beforehand(system: System) -> None:
    """Compile the loop now, so that compilation does not count in the time limits of calls."""
    fmus = (stage.component for stage in system.stages if not isinstance(stage.component, SourceBlock))
    if not any(fmu.nominal_step for fmu in fmus):  # Python FMUs are stepped in Python
        with suppress(NotCompiled):
            library()


class CompiledSteps:
    """The steps of a run after initialization, in C: all steps at once, or single steps of any length.

    Args:
        stages: Stages of single steps of any length; None for all steps of the run.

    Raises:
        NotCompiled: The steps cannot be made in C; the message says why.
    """

    def __init__(self, master: Master, stages: Sequence[Stage] | None = None) -> None:
        self.master, system = master, master.system
        if not master.in_c:
            raise NotCompiled("asked for")
        if stages is not None and system.beside:
            raise NotCompiled(f"{system.beside[0]} has values that doubles cannot represent")
        self._types = [FMI3[system.signals[name].kind] for name in system.beside]
        self._cells = (Cell * len(self._types))(*(Cell(not kind.is_whole) for kind in self._types))
        self.in_python: dict[str, str] = {}  # component → why Python steps it
        self._begin, self._spent_in_python = time.perf_counter(), 0.0  # [s]
        slots: list[Slot] = []
        names = {stage.component.name for stage in stages or system.stages}
        # For steps of any length, source values cannot be computed in advance.
        self._sources = [s.component for s in stages or () if isinstance(s.component, SourceBlock)]
        made = [stage for stage in stages or system.stages if stage.component not in self._sources]
        closing = [stage for stage in system.closing if stage.component.name in names]
        self.stages = stages = [*made, *closing]
        self.components: list[Any] = [stage.component for stage in stages]
        for stage, component in zip(stages, self.components, strict=True):
            slot = self._slot(component)
            slot.every, slot.doing = stage.every, master.numbers[component.name]
            slots.append(slot)
        for slot in slots[len(made) :]:
            slot.step = None
        if any(system.courses):
            self._add_courses(slots)
        if self.in_python and not any(slot.version > 0 for slot in slots):
            raise NotCompiled(next(iter(self.in_python.values())))
        if self.in_python and system.beside:
            raise NotCompiled(
                f"{system.beside[0]} has values that doubles cannot represent, and Python steps a component"
            )
        self._library = library()  # compiled only if used
        self._keeping: list[Any] = [slots]  # references to memory that C uses
        for slot, stage in zip(slots, stages, strict=True):
            if slot.version == IN_PYTHON:
                continue
            (slot.pulls, slot.pull), (slot.lates, slot.late) = map(self._transfers, (stage.pulls, stage.late))
        together, first = [len(batch) for batch in batches(stages)], 0
        for count in together:
            slots[first].batch = count
            first += count
        self.slots, self._count = (Slot * len(slots))(*slots), len(made)
        self.plan = plan = Plan(system.start, master.h, slots=len(slots), width=len(master.row), next=master.done)
        plan.cells, plan.cell_count = ctypes.addressof(self._cells), len(self._cells)
        plan.threads = min(cores(), max(together, default=1)) - 1
        plan.slot = ctypes.addressof(self.slots)
        held = [t for t in system.held if t.name.partition(".")[0] in names]
        plan.holds, plan.hold = self._transfers(held, {stage.component.name: stage.every for stage in made})
        plan.row, plan.table = ctypes.addressof(master.row), master.table.ctypes.data
        plan.counter, plan.doing, plan.asked = map(address_of, (master.row_count, master.doing, master.asked))
        self._give_exact()
        master.together.append(self)

    def _slot(self, component: Any) -> Slot:
        """Return the slot of a component; raise NotCompiled if Python must step all components."""
        name = component.name
        if not hasattr(component, "slot"):
            raise NotCompiled(f"{name} has a process of its own")
        slot: Slot | str = component.slot(self._cells)
        if any(name in solver.names for solver in self.master.solvers):
            slot = "algebraic loops are solved"
        if isinstance(slot, Slot):
            return slot
        if getattr(component, "is_apart", False) or (isinstance(component, FmuBlock) and component.nominal_step):
            raise NotCompiled(slot)
        self.in_python[name] = slot
        return Slot(IN_PYTHON)

    def _step_in_python(self) -> None:
        """Step the component for which C has returned."""
        master, plan = self.master, self.plan
        stage, k, start = self.stages[plan.place], plan.next, master.system.start
        actives = master.actives if plan.place < self._count else master.closing
        active, t, until = actives[stage.component.name], start + (k - 1) * master.h, start + k * master.h
        if plan.length:
            active, t, until = active._replace(length=0.0), plan.since, self._until
        begin = time.perf_counter()
        master.advance((active,), k, t, until)
        self._spent_in_python += time.perf_counter() - begin
        plan.place += 1

    def _give_exact(self) -> None:
        """Copy the values beside the row from Python to C."""
        for cell, kind, value in zip(self._cells, self._types, self.master.beside, strict=True):
            cell.set(kind, value)

    def _add_courses(self, slots: Sequence[Slot]) -> None:
        """Pass the polynomials of extrapolated and interpolated inputs to C."""
        actives = self.master.actives
        for slot, stage in zip(slots, self.stages, strict=True):
            name = stage.component.name
            if slot.step is None or name not in actives or (step := self.master.courses.get(name)) is None:
                continue
            courses = step.in_c()
            if isinstance(courses, str):
                self.in_python[name], slot.version = courses, IN_PYTHON
                continue
            slot.past, slot.course = (ctypes.addressof(course) if course.inputs else None for course in courses)
            slot.again, slot.courses = step.answers, courses

    def _transfers(
        self, transfers: Iterable[Transfer], every: Mapping[str, int] = MappingProxyType({})
    ) -> tuple[int, int]:
        """Return the number and the address of transfers as C structures.

        Args:
            every: Component → its step in communication steps; a held value is copied when the target component steps.
        """
        first, made, signals = ctypes.addressof(self.master.row), [], self.master.system.signals
        for t in transfers:
            cells: Sequence[int | None] = (None, None)
            if any(t.beside):
                is_other = signals[t.origin].kind != signals[t.name].kind or bool(self.master.copying.links[t.name])
                if is_other or not all(t.beside):
                    raise NotCompiled(f"{t.name} has another value than {t.origin}, and no double holds them")
                cells = [ctypes.addressof(self._cells[k]) for k in (t.source, t.target)]
            links = [link.link() for link in self.master.copying.links[t.name]]
            chain = (ConvertedLink * len(links))(*links)
            ends = first + 8 * t.source, first + 8 * t.target
            made.append(
                CTransfer(*ends, every.get(t.name.partition(".")[0], 1), len(chain), ctypes.addressof(chain), *cells)
            )
            self._keeping += links, chain
        array = (CTransfer * len(made))(*made)
        self._keeping.append(array)
        return len(made), ctypes.addressof(array)

    @property
    def described(self) -> str:
        """Return `C`, or `C, but in Python: …` with the reasons why Python steps some components."""
        reasons = "; ".join(dict.fromkeys(self.in_python.values()))
        return f"C, but in Python: {reasons}" if reasons else "C"

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest: the components stepped in Python, and their share of the time."""
        return {"components": self.in_python, "share": self._spent_in_python / (time.perf_counter() - self._begin)}

    def close(self) -> None:
        """End the threads in which slow FMUs were stepped, and free texts in C's memory."""
        self._library.finish(ctypes.byref(self.plan))

    def advance(self, k: int, t: float, until: float) -> None:
        """Step once from t to `until` [s], towards point k."""
        plan = self.plan
        plan.next, plan.since, plan.length, self._until = k, t, until - t, until
        for source in self._sources:
            source.advance(t, until - t)
            source.get()
        while (why := self._call(self._library.step_once)) != StopReason.FINISHED:
            self._react(why)

    def _call(self, function: Any) -> StopReason:
        """Call a function of the library; return why it returned."""
        try:
            return StopReason(function(ctypes.byref(self.plan)))
        finally:
            for component, slot in zip(self.components[: self._count], self.slots, strict=False):
                if slot.version != IN_PYTHON:
                    component.set_time(slot.time)

    def _react(self, why: StopReason) -> None:
        """Do what C cannot do, or raise the error for which C returned. A warning of an FMU is only logged."""
        plan, place = self.plan, self.plan.place
        if why == StopReason.ASKED:
            self._step_in_python()
            return
        if why != StopReason.NO_ITEM:
            self.components[place].raise_error(why, self.slots[place])
            return
        system = self.master.system
        for t in self.stages[place].transfers if place < plan.slots else system.held:
            t.check_item(self.master.row[t.target], system.start + plan.next * self.master.h)
        raise AssertionError("C met a value that is no item, and there is none")

    def make_all(self) -> None:
        """Make all steps; errors are those of the Python loop. Source values are computed block by block."""
        master, plan, system = self.master, self.plan, self.master.system
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
                self.slots[k].prepared, self.slots[k].since = values[-1].ctypes.data, first
            # points at which C returns to Python
            plan.last, plan.pause = last, master.next_call(plan.next)
            while True:
                why = self._call(self._library.run)
                if why == StopReason.FINISHED:
                    break
                if why == StopReason.PAUSED:
                    cells = zip(self._cells, self._types, strict=True)
                    master.beside[:] = [cell.value(kind) for cell, kind in cells]
                    if plan.next == plan.pause:
                        master.change(plan.pause)
                        self._give_exact()
                        # Events may have changed outputs, so the held values are copied again.
                        plan.place = plan.slots
                        plan.pause = master.next_call(plan.pause + 1)
                    master.tell(plan.next)
                    plan.changed = False
                elif why == StopReason.LATER:
                    if master.asked[0] and master.keeper is not None:
                        master.keeper.look(master, plan.next - 1)
                    plan.pause = master.next_call(plan.next)  # Steps may have become slower.
                else:
                    self._react(why)
