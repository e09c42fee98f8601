"""FMUs of FMI 3.0 for scheduled execution: model partitions that their clocks activate, in the order of priority.

Partitions run one after another and are never interrupted, so the FMU's locks against preemption are not needed.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from cosim.blocks.event_mode import INITIALIZATION, EventFmu, EventInstance
from cosim.blocks.instance import Instance
from cosim.fmi.description import Way


class ScheduledInstance(EventInstance):
    """An FMU instance for FMI 3.0 scheduled execution.

    Attributes:
        on_update: Function called when the FMU says that a clock has changed.
    """

    fmpy_class, way = "ScheduledExecution", "scheduled-execution"

    def __init__(self, name: str, path: Path, description: Any, **settings: bool) -> None:
        super().__init__(name, path, description, **settings)
        self.may_return = False
        self.on_update: Any = lambda: None

    def make_instance(self, logging: bool, **options: Any) -> None:
        from fmpy import fmi3

        fmu = self.fmu  # FMPy's own method drops the updates of clocks; the callbacks must live as long as the FMU.
        fmu.logMessage = fmi3.fmi3LogMessageCallback(lambda _, status, category, message: self.listen(status, message))
        fmu.clockUpdate = fmi3.fmi3ClockUpdateCallback(lambda _: self.on_update())
        fmu.lockPreemption = fmi3.fmi3LockPreemptionCallback(lambda: None)
        fmu.unlockPreemption = fmi3.fmi3UnlockPreemptionCallback(lambda: None)
        resources = os.path.join(fmu.unzipDirectory, "resources") + os.path.sep
        about = fmu.instanceName.encode(), fmu.guid.encode(), resources.encode(), False, logging, None
        callbacks = fmu.logMessage, fmu.clockUpdate, fmu.lockPreemption, fmu.unlockPreemption
        fmu.component = fmu.fmi3InstantiateScheduledExecution(*about, *callbacks)
        if not fmu.component:
            raise Exception("Failed to instantiate FMU")  # as FMPy does


class ScheduledFmu(EventFmu):
    """An FMU for scheduled execution."""

    steps = False
    has_jumped = is_stirred = False  # Inputs are taken by the partitions.
    instance: ScheduledInstance

    def _instance_class(self, way: Way | None) -> type[Instance]:
        return ScheduledInstance

    def start(self) -> None:
        super().start()
        self._fired: list[str] = []
        self._last: dict[str, float] = {}  # clock → time of its last activation [s]
        self._failure: BaseException | None = None
        self.instance.on_update = self._on_update

    def put(self) -> None:
        """Set the inputs during initialization only."""
        if self.mode == INITIALIZATION:
            super().put()

    def get(self) -> None:
        """Read the outputs during initialization only."""
        if self.mode == INITIALIZATION:
            super().get()

    def go(self, target: float) -> float:
        """Let time pass without a call of the FMU."""
        self.reached = self.instance.time = target
        return target

    def tick(self, names: Collection[str]) -> None:
        """Activate the partitions of clocks by priority.

        Clocks that a partition sets take their place among them.
        """
        t = self.instance.time
        waiting = [*names]
        while waiting:
            name = min(waiting, key=lambda clock: self.clocks[clock].priority)
            waiting.remove(name)
            self._activate(name, t)
            waiting = [*(c for c in self.due_clocks(t, 0.0) if c != name and c not in waiting), *waiting]

    def _activate(self, name: str, t: float) -> None:
        """Run a partition between its inputs and outputs."""
        if self._last.get(name, -math.inf) >= t:
            self.instance.remember(
                f"clock {name} was due twice at t = {t:.6g} s; FMI allows one activation at a time, so one is left out"
            )
            if name in self.timers:
                self.timers[name].count += 1
            return
        self._last[name] = t
        self.active = set()
        self._count([name])
        super().put()
        self.instance.call("activateModelPartition", self.clocks[name].reference, t)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        super().get()
        self._read_intervals()

    def _on_update(self) -> None:
        """Read the clocks that the partition has changed."""
        try:
            self._read_intervals()
            idle = [c for c in self.output_clocks if c.name not in self._fired]
            if idle:
                states = self.instance.call("getClock", [c.reference for c in idle])
                self._fired += [clock.name for clock, is_active in zip(idle, states, strict=True) if is_active]
        except BaseException as failure:  # Exceptions cannot pass through C.
            self._failure = failure

    def fired(self) -> list[str]:
        """Return output clocks activated since the last call."""
        names, self._fired = self._fired, []
        for name in names:
            self._values.row[self._places[name]] += 1.0
        return names

    def update(self) -> bool:
        """Return False: partitions leave nothing to be updated."""
        self.active = set()
        return False

    def leave(self) -> None:
        """Wait for the next clock."""
        self.active = set()
