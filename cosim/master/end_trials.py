"""Trials of saved states beyond the end of the run that saved them.

An FMU may save the end of the run, which it was told, with its state, and then refuses to step beyond it. Such a state
is of no use to a longer run. Each state is restored in an instance of its own, which steps over that end with the
inputs of the last row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from cosim.base.arrays import far_beyond
from cosim.base.errors import Interrupted, Signalled, SimulationError
from cosim.blocks.fmu import FmuBlock
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import Rows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.checkpoint import Continuation
from cosim.master.initialization import Initialization
from cosim.master.master import Master
from cosim.master.own_process import in_own_processes
from cosim.storage.state_file import pack, unpack
from cosim.system.system import System

BEYOND = 2  # steps beyond the end


def without_ended_states(
    system: System,
    grid: tuple[int, float],
    start: Continuation,
    end: int,
    worker: Worker | None,
    limits: Limits,
) -> tuple[Continuation, list[str]]:
    """Return a continuation without the states of FMUs that refuse to step beyond an end, and these FMUs.

    Args:
        grid: Number of steps of the longer run, and their length [s].
        end: Communication point of the end of the run that saved the states.
        worker: Process for the FMUs; None for this one, without limits.

    Raises:
        FmuError: An FMU does not load.
    """
    state = {} if start.state is None else unpack(start.state)
    states = state.get("components", {})
    names = [
        s.component.name for s in system.stages if isinstance(s.component, FmuBlock) and states.get(s.component.name)
    ]
    if not names:
        return start, []
    job = system, grid, start.values[-1], {name: states[name] for name in names}, (start.count - 1, end)
    try:
        if worker is None:
            ended = refusing(*job, None)
        else:
            calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
            ended = worker.call(refusing, *job, limits, watch=Watch(system.names, calls, limits=limits))
    except (Interrupted, Signalled):
        raise
    except SimulationError:  # a crash or a limit: none of the states has proved its use
        ended = names
    if not ended:
        return start, []
    state = {**state, "components": {**states, **dict.fromkeys(ended)}}
    return replace(start, state=pack(state)), ended


@far_beyond
def refusing(
    system: System,
    grid: tuple[int, float],
    row: Sequence[float],
    states: dict[str, Any],
    points: tuple[int, int],
    limits: Limits | None,
) -> list[str]:
    """Return the FMUs whose restored states refuse to step beyond an end.

    Args:
        row: Last row.
        points: Communication points of the states and of the end.
    """
    if limits is not None:
        system = in_own_processes(system, limits)
    rows = Rows.in_memory(2, len(system.columns))
    if limits is not None:
        rows = replace(rows, doing=here.progress.doing)
    return _Trial(system, *grid, None, rows).refusing(row, states, points)


class _Trial(Master):
    """A master that steps restored FMUs apart from each other."""

    def refusing(self, row: Sequence[float], states: dict[str, Any], points: tuple[int, int]) -> list[str]:
        """Return the FMUs that refuse to step beyond an end."""
        try:
            self._open()
            data = self.system, self.components, self.row, self.beside, self.pulls, self.held
            Initialization(*data, self.doing, self.solvers).run()
            return [name for name in states if self._refuses(name, row, states[name], *points)]
        finally:
            for component in self.components:
                self.announce(component)
                component.close()

    def _refuses(self, name: str, row: Sequence[float], state: Any, last: int, end: int) -> bool:
        stage = next(stage for stage in self.system.stages if stage.component.name == name)
        component: Any = stage.component
        self.row[:] = [*row]
        self.announce(component)
        try:
            component.restore(state)
            step, every, length, *_ = self.active(stage)
            for k in range((last // every + 1) * every, min(end + BEYOND * every, self.steps) + 1, every):
                since = self.system.start + (k - every) * self.h
                step(since, length or float(self.time[k]) - since)
        except SimulationError:
            return True
        return False
