"""A component in its own process, apart from the worker of the others."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Collection, Mapping, MutableSequence, Sequence
from dataclasses import replace
from typing import Any

from cosim.blocks.component import Component, Row, Signal, in_turn
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import ADVANCE, GET, OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.system.system import System

Values = tuple[list[float], list[Any]]  # in the row, and beside the row

# -- in the process of the component ---------------------------------------------------------------


class _LoadedComponent:
    """The component of this process with its signals."""

    def __init__(self, component: Component) -> None:
        self.component: Any = component
        self.row = (ctypes.c_double * (len(component.inputs) + len(component.outputs)))()
        self.beside: list[Any] = [None] * (len(component.exact_inputs) + len(component.exact_outputs))
        component.bind(self.row, 0, self.beside, 0)

    def inputs(self) -> Values:
        return self.row[: len(self.component.inputs)], self.beside[: len(self.component.exact_inputs)]

    def outputs(self) -> Values:
        return self.row[len(self.component.inputs) :], self.beside[len(self.component.exact_inputs) :]


_components: dict[str, _LoadedComponent] = {}


def load(component: Component, start: float, stop: float) -> tuple[Values, Values]:
    """Open a component; return its inputs and outputs."""
    loaded = _components[component.name] = _LoadedComponent(component)
    here.share_log(component)
    component.open(start, stop)
    return loaded.inputs(), loaded.outputs()


def begin(name: str) -> None:
    """End initialization."""
    _components[name].component.start()


def exchange(name: str, inputs: Values | None, step: tuple[float, float] | None) -> Values:
    """Set inputs and step, each if not None; return the outputs.

    Args:
        step: Time and length of the step [s].
    """
    loaded = _components[name]
    if inputs is not None:
        loaded.row[: len(inputs[0])], loaded.beside[: len(inputs[1])] = [*inputs[0]], inputs[1]
        loaded.component.put()
    if step is not None:
        loaded.component.advance(*step)
    loaded.component.get()
    return loaded.outputs()


def change(name: str, values: dict[str, Any]) -> Values:
    """Set the values of an event in component `name`; return all its inputs after that."""
    _components[name].component.change(values)
    return _components[name].inputs()


def checkpoint(name: str) -> Any:
    """Return the state of a component."""
    return _components[name].component.checkpoint()


def restore(name: str, state: Any) -> None:
    """Restore the state of a component."""
    _components[name].component.restore(state)


def close(name: str) -> list[str]:
    """Free the component; return its messages."""
    component = _components.pop(name).component
    component.close()
    return list(getattr(component, "log", ()))


# -- in the worker of the others ------------------------------------------------------------------------------


class OwnProcess:
    """Proxy of a component in another process; a crash there becomes an error naming the component."""

    def __init__(self, component: Component, limits: Limits) -> None:
        self.name: str = component.name
        self.inputs: tuple[Signal, ...] = component.inputs
        self.outputs: tuple[Signal, ...] = component.outputs
        self.exact_inputs: tuple[Signal, ...] = component.exact_inputs
        self.exact_outputs: tuple[Signal, ...] = component.exact_outputs
        self.nominal_step: bool = component.nominal_step
        self.description = getattr(component, "description", None)
        self.log: deque[str] = deque(getattr(component, "log", ()))
        self._component, self._limits = component, limits
        self._worker = Worker(__name__)
        self._time = 0.0
        self._is_loaded = False
        self._pending: Values | None = None  # inputs to send with the next call
        self._outputs: Values | None = None  # outputs received with a step

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        """Return the component's answer."""
        return self._component.depends_on(name, outputs)

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        """Put, advance and get."""
        return in_turn(self, doing, first)

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the places of the component's signals in the row and in the list of exact values."""
        self._row, self._beside = row, [] if beside is None else beside
        self._in, self._out = _consecutive_slices(first, self.inputs, self.outputs)
        self._in_beside, self._out_beside = _consecutive_slices(first_beside, self.exact_inputs, self.exact_outputs)

    def open(self, start: float, stop: float) -> None:
        """Start the process and load the component."""
        self._time = start
        self._worker.start()
        inputs, outputs = self._call(OTHER, load, self._component, start, stop)
        self._write_inputs(inputs)
        self._write_outputs(outputs)
        self._is_loaded = True

    def start(self) -> None:
        """End initialization."""
        self._call(OTHER, begin, self.name)

    def change(self, values: Mapping[str, Any]) -> None:
        """Set the values of an event in the component."""
        self._write_inputs(self._call(OTHER, change, self.name, dict(values)))

    def put(self) -> None:
        """Keep the inputs for the next call."""
        self._pending = self._row[self._in], self._beside[self._in_beside]

    def advance(self, t: float, h: float) -> None:
        """Step and receive the outputs."""
        self._time = t
        self._outputs = self._exchange(ADVANCE, (t, h))
        self._time = t + h

    def get(self) -> None:
        """Write the outputs of the last step, or of the current inputs."""
        outputs, self._outputs = self._outputs, None
        self._write_outputs(self._exchange(GET, None) if outputs is None else outputs)

    @property
    def saves(self) -> bool:
        """Return the component's answer."""
        return self._component.saves

    def checkpoint(self) -> Any:
        """Return the state of the component."""
        return self._call(OTHER, checkpoint, self.name)

    def restore(self, state: Any) -> None:
        """Restore the state of the component."""
        self._call(OTHER, restore, self.name, state)

    def close(self) -> None:
        """Free the component and end its process."""
        try:
            if self._is_loaded and self._worker.running:
                self._is_loaded = False
                self.log.extend(self._call(OTHER, close, self.name))
        finally:
            self._worker.end()

    def _exchange(self, doing: int, step: tuple[float, float] | None) -> Values:
        inputs, self._pending = self._pending, None
        outputs: Values = self._call(doing, exchange, self.name, inputs, step)
        return outputs

    def _write_inputs(self, values: Values) -> None:
        self._row[self._in], self._beside[self._in_beside] = [*values[0]], values[1]

    def _write_outputs(self, values: Values) -> None:
        self._row[self._out], self._beside[self._out_beside] = [*values[0]], values[1]

    def _call(self, doing: int, function: Callable[..., Any], *arguments: Any) -> Any:
        watch = Watch([self.name], [fmi_calls(self.description)], lambda row, doing: self._time, self._limits)
        return self._worker.call(function, *arguments, watch=watch, doing=doing)


def _consecutive_slices(first: int, *groups: Sequence[Signal]) -> list[slice]:
    places = []
    for group in groups:
        places.append(slice(first, first + len(group)))
        first += len(group)
    return places


def in_own_processes(system: System, limits: Limits) -> System:
    """Return the system with components moved to own processes.

    This applies on request, and to FMUs that allow a single instance per process.
    """
    paths: set[Any] = set()
    stages = []
    for stage in system.stages:
        about = getattr(getattr(stage.component, "description", None), "coSimulation", None)
        single = bool(getattr(about, "canBeInstantiatedOnlyOncePerProcess", False))
        path = getattr(stage.component, "path", None)
        if stage.component.name in system.apart or (single and path in paths):
            stage = replace(stage, component=OwnProcess(stage.component, Limits(memory=limits.memory)))
        elif single:
            paths.add(path)
        stages.append(stage)
    return replace(system, stages=tuple(stages))
