"""A component in a process of its own, beside the worker in which the others are stepped."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from cosim.blocks.interface import Component, Row, Signal
from cosim.errors import FmuError
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Watch, Worker, fmi_calls
from cosim.isolation.rows import ADVANCE, OTHER
from cosim.simulation.system import System

Build = tuple[Callable[..., System], tuple[Any, ...]]  # what puts the system together again, and its arguments

# -- in the process of the component ---------------------------------------------------------------

_held: dict[str, tuple[Component, Row]] = {}


def load(build: Build, name: str, start: float, stop: float) -> list[float]:
    """Open a component of a system; its signals, inputs first."""
    function, arguments = build
    component = next(s.component for s in function(*arguments).stages if s.component.name == name)
    row = (ctypes.c_double * (len(component.inputs) + len(component.outputs)))()
    _held[name] = component, row
    here.overheard(component)
    component.bind(row, 0)
    component.open(start, stop)
    return list(row)


def begin(name: str) -> None:
    """End initialization."""
    _held[name][0].start()


def exchange(name: str, inputs: Sequence[float], step: tuple[float, float] | None) -> list[float]:
    """Give it its inputs, step it where a time and a length are given [s]; its outputs."""
    component, row = _held[name]
    row[: len(inputs)] = [*inputs]
    component.put()
    if step is not None:
        component.advance(*step)
    component.get()
    return row[len(inputs) :]


def change(name: str, values: dict[str, Any]) -> None:
    """Give it an event's values."""
    component: Any = _held[name][0]
    component.change(values)


def close(name: str) -> list[str]:
    """Free it; what it said."""
    component, _ = _held.pop(name)
    component.close()
    return list(getattr(component, "log", ()))


# -- beside the others ------------------------------------------------------------------------------


class OwnProcess:
    """Stands for a component that is loaded in another process; a crash there is an error that names it."""

    def __init__(self, component: Component, build: Build, limits: Limits) -> None:
        self.name: str = component.name
        self.inputs: tuple[Signal, ...] = component.inputs
        self.outputs: tuple[Signal, ...] = component.outputs
        self.exact_inputs: tuple[Signal, ...] = component.exact_inputs
        self.exact_outputs: tuple[Signal, ...] = component.exact_outputs
        self.nominal_step: bool = component.nominal_step
        self.description = getattr(component, "description", None)
        self.log: deque[str] = deque(getattr(component, "log", ()))
        self._component, self._build, self._limits = component, build, limits
        self._worker = Worker(__name__)
        self._time = 0.0
        self._loaded = False

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        """As the component says."""
        return self._component.depends_on(name, outputs)

    def calls(self) -> tuple[Callable[[], None] | None, Callable[[float, float], None], Callable[[], None]]:
        """Put, advance and get."""
        return self.put, self.advance, self.get

    def change(self, values: Mapping[str, Any]) -> None:
        """An event's values."""
        self._call(OTHER, change, self.name, dict(values))

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Tell where its signals stand."""
        self._row, middle = row, first + len(self.inputs)
        self._in, self._out = slice(first, middle), slice(middle, middle + len(self.outputs))

    def open(self, start: float, stop: float) -> None:
        """Start the process and load the component in it."""
        self._time = start
        if self.exact_inputs or self.exact_outputs:
            raise FmuError(f"{self.name} exchanges text, binary data or 64-bit integers: not in a process of its own")
        self._worker.start()
        values = self._call(OTHER, load, self._build, self.name, start, stop)
        self._row[self._in.start : self._out.stop] = values
        self._loaded = True

    def start(self) -> None:
        """End initialization."""
        self._call(OTHER, begin, self.name)

    def put(self) -> None:
        """Inputs go along with what is asked next."""
        self._outputs: list[float] | None = None

    def advance(self, t: float, h: float) -> None:
        """Step; the outputs come back with it."""
        self._time = t
        self._outputs = self._call(ADVANCE, exchange, self.name, self._row[self._in], (t, h))
        self._time = t + h

    def get(self) -> None:
        """Write the outputs of the last step, or those that follow from the inputs now."""
        if self._outputs is None:
            self._outputs = self._call(ADVANCE, exchange, self.name, self._row[self._in], None)
        self._row[self._out] = [*self._outputs]

    def close(self) -> None:
        """Free the component and end its process."""
        try:
            if self._loaded and self._worker.running:
                self._loaded = False
                self.log.extend(self._call(OTHER, close, self.name))
        finally:
            self._worker.end()

    def _call(self, call: int, function: Callable[..., Any], *arguments: Any) -> Any:
        watch = Watch([self.name], [fmi_calls(self.description)], lambda made, doing: self._time, self._limits)
        return self._worker.call(function, *arguments, watch=watch, doing=call)


def in_own_processes(system: System, names: Mapping[str, bool], build: Build, limits: Limits | None) -> System:
    """The system, its components of these names each in a process of its own, and those that cannot share one."""
    seen: set[Any] = set()
    stages = []
    for stage in system.stages:
        about = getattr(getattr(stage.component, "description", None), "coSimulation", None)
        single = bool(getattr(about, "canBeInstantiatedOnlyOncePerProcess", False))
        path = getattr(stage.component, "path", None)
        if names.get(stage.component.name) or (single and path in seen):
            memory = Limits(memory=None if limits is None else limits.memory)
            stage = replace(stage, component=OwnProcess(stage.component, build, memory))
        elif single:
            seen.add(path)
        stages.append(stage)
    return replace(system, stages=tuple(stages))
