"""A component in a process of its own, separate from the worker with the other components."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, MutableSequence
from dataclasses import replace
from itertools import count
from typing import Any

from cosim.blocks.component import ADVANCE, GET, PUT, Component, Row
from cosim.blocks.event_mode import INITIALIZATION, EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Remote, Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.system.events import is_exchange
from cosim.system.system import System

Signals = tuple[list[float], list[Any]]  # values in the row, and values beside the row
Request = tuple[Any, ...]  # name of a method of the component or of `HostedComponent`, and its arguments
COPIED = {
    *("name", "inputs", "outputs", "exact_inputs", "exact_outputs", "nominal_step"),
    *("description", "log", "saves", "depends_on"),
}
MIRRORED = "mode", "reached", "next_event", "asks", "active", "timers"  # copied from EventFmu


class HostedComponent:
    """A component in its own process, with its signals and saved states."""

    def __init__(self, component: Component) -> None:
        self.component: Any = component
        self.row = (ctypes.c_double * (len(component.inputs) + len(component.outputs)))()
        self.beside: list[Any] = [None] * (len(component.exact_inputs) + len(component.exact_outputs))
        component.bind(self.row, 0, self.beside, 0)
        here.share_log(component)
        self._mirrored = MIRRORED if isinstance(component, EventFmu) else ()
        self._states: dict[int, Any] = {}
        self._numbers = count()

    def do(self, signals: Signals, *requests: Request) -> tuple[Any, Signals, dict[str, Any]]:
        """Set all signals and call methods.

        Returns:
            The result of the last method, all signals, and the attributes that the proxy copies.
        """
        self.row[:], self.beside[:] = [*signals[0]], signals[1]
        result = None
        for method, *arguments in requests:
            owner = self if hasattr(self, method) else self.component
            result = getattr(owner, method)(*arguments)
        return result, (self.row[:], self.beside), {name: getattr(self.component, name) for name in self._mirrored}

    def save_state(self) -> int:
        """Save the state of the component; return its number."""
        number = next(self._numbers)
        self._states[number] = self.component.save_state()
        return number

    def restore_state(self, number: int, keep: bool) -> None:
        """Restore a saved state, and free it unless `keep` is True."""
        self.component.restore_state(self._states[number] if keep else self._states.pop(number), keep=keep)

    def free_state(self, number: int) -> None:
        """Free a saved state."""
        self.component.free_state(self._states.pop(number))

    def close(self) -> list[str]:
        """Free the component; return its messages."""
        self.component.close()
        return list(getattr(self.component, "log", ()))


def _there(method: str, doing: int = OTHER) -> Any:
    """Return a method that calls the component's method of this name by `OwnProcess.act`."""
    return lambda self, *arguments: self.act((method, *arguments), doing=doing)


class OwnProcess:
    """Proxy of a component in another process; a crash of that process becomes an error that names the component."""

    start, change, checkpoint, restore = map(_there, ("start", "change", "checkpoint", "restore"))
    put, get = _there("put", PUT), _there("get", GET)
    is_apart = True

    def __init__(self, component: FmuBlock, limits: Limits) -> None:
        self._component, self._limits = component, limits
        self._remote = Remote(Worker(__name__), HostedComponent, component)
        self.reached = 0.0  # time [s] for messages

    def __getattr__(self, name: str) -> Any:
        """Return an attribute from the local copy of the component."""
        if name not in COPIED:
            raise AttributeError(name)
        return getattr(self._component, name)

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the indices of the component's signals in the row and in the list of exact values."""
        counts = len(self.inputs) + len(self.outputs), len(self.exact_inputs) + len(self.exact_outputs)
        self._row, self._beside = row, [] if beside is None else beside
        self._own, self._own_beside = slice(first, first + counts[0]), slice(first_beside, first_beside + counts[1])

    def open(self, start: float, stop: float) -> None:
        """Start the process and load the component."""
        self.reached = start
        self.act(("open", start, stop))

    def advance(self, t: float, h: float) -> None:
        """Step the component in its process."""
        self._step(t, h, ("advance", t, h))

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        """Return a function that puts, advances and gets with a single message."""

        def step(t: float, h: float) -> None:
            doing[0] = first + ADVANCE
            self._step(t, h, ("put",), ("advance", t, h), ("get",))

        return step

    def _step(self, t: float, h: float, *requests: Request) -> None:
        self.reached = t
        self.act(*requests, doing=ADVANCE)
        self.reached = t + h

    def close(self) -> None:
        """Free the component and end its process."""
        try:
            if self._remote.is_made:
                self.log.first.extend(self.act(("close",)))
        finally:
            self._remote.worker.end()

    def slot(self, cells: Any) -> str:
        """Return the reason why C cannot step the component."""
        return f"{self.name} has a process of its own"

    def act(self, *requests: Request, doing: int = OTHER) -> Any:
        """Set all signals and call methods in the process; copy signals and attributes back, return the last result."""
        watch = Watch([self.name], [fmi_calls(self.description)], lambda row, doing: self.reached, self._limits)
        signals = self._row[self._own], self._beside[self._own_beside]
        result, (row, beside), mirrored = self._remote.call("do", signals, *requests, watch=watch, doing=doing)
        self._row[self._own], self._beside[self._own_beside] = row, beside
        self.__dict__ |= mirrored
        return result


class OwnFmu(OwnProcess, FmuBlock):
    """An FMU for co-simulation in another process, whose steps can be repeated; saved states stay in that process."""

    try_inputs, slopes = _there("put", PUT), _there("slopes")
    save_state, free_state = _there("save_state"), _there("free_state")

    def __init__(self, component: FmuBlock, limits: Limits) -> None:
        self.__dict__ |= component.__dict__
        OwnProcess.__init__(self, component, limits)
        self.instance.fmu = self  # a crash loses the FMU, and ends the run

    def step_by_derivatives(self, names: Any, orders: Any, t: float, h: float) -> None:
        """Put inputs with derivatives, advance and get, in the process."""
        self._step(t, h, ("step_by_derivatives", names, orders, t, h))

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        """Restore a saved state in the process, and free it unless `keep` is True."""
        self.act(("restore_state", state, keep))


class OwnEvents(OwnFmu, EventFmu):
    """An FMU with event mode in another process.

    After each call, the times of its events and clocks are copied to this process, which also tracks changed inputs. An
    FMU that is not concerned by an instant therefore needs no message.
    """

    enter, go, update, leave = _there("enter"), _there("go", ADVANCE), _there("update"), _there("leave")
    ask_for_small_steps = _there("ask_for_small_steps")

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the indices of the component's signals."""
        OwnProcess.bind(self, row, first, beside, first_beside)
        super(OwnProcess, self).bind(row, first, beside, first_beside)

    def open(self, start: float, stop: float) -> None:
        """Start the process and load the FMU."""
        self._given, self._seen = {}, []
        super().open(start, stop)

    def put(self) -> None:
        """Set changed inputs that may be set in the current mode."""
        if (self.steps or self.mode == INITIALIZATION) and self._changed_inputs():
            self.act(("put",), doing=PUT)

    def tick(self, names: Collection[str]) -> None:
        """Activate input clocks."""
        self.act(("tick", [*names]))
        self._forget(names)

    def fired(self) -> list[str]:
        """Return the output clocks that have ticked since the last call."""
        names: list[str] = self.act(("fired",)) if self.output_clocks else []
        self._forget(names)
        return names

    def save_state(self) -> Any:
        """Return the number of the saved state, and the last values of the inputs."""
        return OwnFmu.save_state(self), dict(self._given)

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        """Restore a saved state in the process, and the inputs in this one."""
        number, given = state
        OwnFmu.restore_state(self, number, keep=keep)
        self._given = dict(given)

    def free_state(self, state: Any) -> None:
        """Free a saved state in the process."""
        OwnFmu.free_state(self, state[0])

    def act(self, *requests: Request, doing: int = OTHER) -> Any:
        """Call methods as `OwnProcess.act`, and copy the attributes of event mode."""
        result = super().act(*requests, doing=doing)
        self.instance.time = self.reached
        return result


def in_own_processes(system: System, limits: Limits) -> System:
    """Return the system with components moved to own processes.

    These are components for which the scenario requests a process, and FMUs that allow only one instance per process.
    """
    paths: set[Any] = set()
    stages = []
    for stage in system.stages:
        component: Any = stage.component
        about = getattr(getattr(component, "description", None), "coSimulation", None)
        single = bool(getattr(about, "canBeInstantiatedOnlyOncePerProcess", False))
        path = getattr(component, "path", None)
        if component.name in system.apart or (single and path in paths):
            kind: Any = OwnProcess
            if isinstance(component, FmuBlock) and not is_exchange(component):
                kind = OwnEvents if isinstance(component, EventFmu) else OwnFmu
                kind = type(kind.__name__, (kind, type(component)), {})
            stage = replace(stage, component=kind(component, Limits(memory=limits.memory)))
        elif single:
            paths.add(path)
        stages.append(stage)
    return replace(system, stages=tuple(stages))
