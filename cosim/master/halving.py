"""Each communication step made once whole and once in halves, to estimate the coupling error.

    e_k = |y(t_k; h) − y(t_k; h/2, h/2)|, both from the state at t_k−1

The FMUs must save and restore their state. The run continues from the whole step, so its course is unchanged.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from cosim.base.errors import SimulationError
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.isolation.rows import GET
from cosim.master.copying import copy_values
from cosim.master.initialization import is_settled
from cosim.master.master import Master, Round
from cosim.master.rollback import restore, save
from cosim.system.system import System


def rollback_objection(system: System) -> str:
    """Return the reason against repeating steps, or ""."""
    if system.beside or system.events or any(stage.every > 1 for stage in system.stages):
        return "values beside numbers, events or several rates are not taken back"
    for stage in system.stages:
        component = stage.component
        if isinstance(component, EventFmu):
            return f"{component.name} has event mode, so its steps end at its events"
        if isinstance(component, FmuBlock):
            if not component.instance.rolls_back:
                return f"{component.name} gives no state away, or takes no step of another length"
        elif not isinstance(component, SourceBlock):
            return f"{component.name} cannot be taken back"
    return ""


class Halved(Master):
    """A run with rows of differences between whole and halved steps, zero in the first row."""

    def _step_on(self) -> None:
        self.table[0] = 0.0
        parts = [c for c in self.components if isinstance(c, FmuBlock)]
        begin = self.system.start
        actives = self._cycle()[0]  # With a single rate, all rounds are equal.
        try:
            for k in range(1, self.steps + 1):
                t, end = begin + (k - 1) * self.h, begin + k * self.h
                before, row = save(self, parts), bytes(self.row)
                self._step_all(actives, k, t, end)
                whole, after, values = bytes(self.row), save(self, parts), list(self.row)
                restore(self, parts, before)
                ctypes.memmove(self.row, row, len(row))
                self._check_outputs(parts, row, t)
                for since, until in ((t, 0.5 * (t + end)), (0.5 * (t + end), end)):
                    self._step_all(actives, k, since, until)
                self.table[k] = [abs(a - b) for a, b in zip(values, self.row, strict=True)]
                restore(self, parts, after)
                ctypes.memmove(self.row, whole, len(whole))
                self.done = self.row_count[0] = k + 1
        finally:
            self.doing[0] = 0

    def _step_all(self, actives: Round, k: int, t: float, end: float) -> None:
        """Exchange the values once and make all steps."""
        for step, _, _, plain, noisy, others, late in actives:
            copy_values(self.row, (plain, noisy, others), k)
            step(t, end - t)
            if late is not None:
                late(k)

    def _check_outputs(self, parts: Sequence[FmuBlock], row: bytes, t: float) -> None:
        """Check that restoring the FMU state restores the outputs; raise SimulationError if it does not."""
        for part in parts:
            before = list(self.row)
            self.announce(part, GET)
            part.get()
            if not is_settled(before, self.row):
                raise SimulationError(
                    part.name,
                    t,
                    (
                        "its outputs differ after a saved state is restored; use an FMU that restores its state, or "
                        "one that does not declare that it can"
                    ),
                )
        ctypes.memmove(self.row, row, len(row))
