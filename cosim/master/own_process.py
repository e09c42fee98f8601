"""A component in its own process, apart from the worker of the others."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, MutableSequence, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from cosim.blocks.component import Component, Row, Signal, in_turn
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmi import Calls
from cosim.blocks.fmi_types import Exchange
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.instance import Instance
from cosim.blocks.remote_fmu import RemoteFmu
from cosim.blocks.values import Values as InstanceValues
from cosim.isolation import worker as here
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import ADVANCE, GET, OTHER, PUT
from cosim.isolation.watch import Watch, fmi_calls
from cosim.system.event_blocks import is_exchange
from cosim.system.system import System

Values = tuple[list[float], list[Any]]  # in the row, and beside the row
MIRRORED = "mode", "reached", "next_event", "asks", "active", "timers"  # attributes of an FMU with event mode

# -- in the process of the component ---------------------------------------------------------------


class _LoadedComponent:
    """The component of this process with its signals."""

    def __init__(self, component: Component) -> None:
        self.component: Any = component
        self.row = (ctypes.c_double * (len(component.inputs) + len(component.outputs)))()
        self.beside: list[Any] = [None] * (len(component.exact_inputs) + len(component.exact_outputs))
        component.bind(self.row, 0, self.beside, 0)
        self.states: dict[int, Any] = {}
        self.numbers = count()

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


def derive(name: str, inputs: Values | None, outputs: Sequence[str], names: Sequence[str]) -> Any:
    """Return directional derivatives of outputs at the inputs, None if unavailable."""
    exchange(name, inputs, None)
    return _components[name].component.slopes(outputs, names)


def save_state(name: str) -> int:
    """Save the state of a component to go back to; return its number."""
    loaded = _components[name]
    component, number = loaded.component, next(loaded.numbers)
    loaded.states[number] = component.save() if isinstance(component, EventFmu) else component.instance.save_state()
    return number


def restore_state(name: str, number: int, *, keep: bool) -> None:
    """Go back to a saved state, and free it unless `keep` is set."""
    loaded = _components[name]
    state = loaded.states[number] if keep else loaded.states.pop(number)
    if isinstance(loaded.component, EventFmu):
        loaded.component.go_back(state)
    else:
        loaded.component.instance.restore_state(state, keep=keep)


def free_state(name: str, number: int) -> None:
    """Free a saved state."""
    loaded = _components[name]
    state = loaded.states.pop(number)
    loaded.component.instance.free_state(state[0] if isinstance(loaded.component, EventFmu) else state)


def act(name: str, method: str, arguments: Sequence[Any], values: Values | None) -> tuple[Any, Values, dict[str, Any]]:
    """Call a method of an FMU with event mode.

    Args:
        values: All its signals, None to keep them.

    Returns:
        The result, all signals, and the attributes that `OwnEvents` mirrors.
    """
    loaded = _components[name]
    if values is not None:
        loaded.row[:], loaded.beside[:] = [*values[0]], values[1]
    result = getattr(loaded.component, method)(*arguments) if method else None
    mirrored = {attribute: getattr(loaded.component, attribute) for attribute in MIRRORED}
    return result, (loaded.row[:], loaded.beside[:]), mirrored


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
        self._log = [*getattr(component, "log", ())]
        self._component, self._limits = component, limits
        self._worker = Worker(__name__)
        self._time = 0.0
        self._is_loaded = False
        self._pending: Values | None = None  # inputs to send with the next call
        self._outputs: Values | None = None  # outputs received with a step

    @property
    def log(self) -> Sequence[str]:
        """Return the messages of the component."""
        return self._log

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
                self._log.extend(self._call(OTHER, close, self.name))
        finally:
            self._worker.end()

    def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of this module about the component in its process."""
        return self._call(OTHER, function, self.name, *arguments)

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


class _OwnInstance(Instance):
    """The instance of an FMU in another process: its states stay there and have numbers here."""

    def __init__(self, owner: OwnProcess, path: Path, calls: Calls) -> None:
        super().__init__(path, calls)
        self.owner, self.fmu = owner, owner  # not None: only a crash loses the FMU, and ends the run

    def save_state(self) -> Any:
        return self.owner.ask(save_state)

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        self.owner.ask(partial(restore_state, keep=keep), state)

    def free_state(self, state: Any) -> None:
        self.owner.ask(free_state, state)


class OwnFmu(OwnProcess, FmuBlock):
    """An FMU for co-simulation in another process, whose steps can be repeated."""

    def __init__(self, component: FmuBlock, limits: Limits) -> None:
        self.__dict__.update(component.__dict__)
        self.instance = _OwnInstance(self, component.path, component.calls)
        OwnProcess.__init__(self, component, limits)

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the places of the signals."""
        OwnProcess.bind(self, row, first, beside, first_beside)
        super(OwnProcess, self).bind(row, first, beside, first_beside)

    def try_inputs(self) -> None:
        """Keep the inputs for the next call."""
        self.put()

    def slopes(self, outputs: Sequence[str], inputs: Sequence[str]) -> list[list[float]] | None:
        """Return directional derivatives of outputs, None if unavailable."""
        values, self._pending = self._pending, None
        slopes: list[list[float]] | None = self.ask(derive, values, outputs, inputs)
        return slopes

    @property
    def log(self) -> Sequence[str]:  # type: ignore[override]
        """Return the messages of the FMU, and those about its calls."""
        return [*self.instance.log, *self._log]

    def slot(self) -> str:
        """Return the reason against the C loop."""
        return f"{self.name} has a process of its own"


class OwnEvents(OwnFmu, EventFmu):
    """An FMU with event mode in another process.

    Its schedule is mirrored here after each call. Which inputs have changed is known here, too, so that an FMU without
    part in an instant costs no message.
    """

    def __init__(self, component: EventFmu, limits: Limits) -> None:
        super().__init__(component, limits)
        self._values = _ChangedInputs(self.instance, self._ports)

    def open(self, start: float, stop: float) -> None:
        """Start the process and load the FMU."""
        self._changes, self._given, self._seen = {}, {}, []
        OwnProcess.open(self, start, stop)
        self._mirror(self._call(OTHER, act, self.name, "", (), None))

    def start(self) -> None:
        """End initialization."""
        self._act("start")

    def put(self) -> None:
        """Set changed inputs, as far as the mode allows."""
        values = self._values
        assert isinstance(values, _ChangedInputs)
        values.has_changed = False
        super(OwnProcess, self).put()
        if values.has_changed:
            self._act("put", doing=PUT)

    def get(self) -> None:
        """Read outputs, as far as the mode allows."""
        self._act("get", doing=GET)

    def go(self, target: float) -> float:
        """Step to a time [s]; return the time reached."""
        self._time = self.reached
        reached: float = self._act("go", target, doing=ADVANCE)
        self._time = reached
        return reached

    def enter(self) -> None:
        """Enter event mode; set the scenario's values."""
        self._changes = {}
        self._act("enter")

    def change(self, values: Mapping[str, Any]) -> None:
        """Keep an event's values for the next instant."""
        self._act("change", dict(values))

    def tick(self, names: Collection[str]) -> None:
        """Activate input clocks."""
        self._act("tick", [*names])
        self._forget(names)

    def fired(self) -> list[str]:
        """Return output clocks that tick since the last call."""
        names: list[str] = self._act("fired") if self.output_clocks else []
        self._forget(names)
        return names

    def update(self) -> bool:
        """Update discrete states; return whether to repeat."""
        return bool(self._act("update"))

    def leave(self) -> None:
        """Return to step mode."""
        self._act("leave")

    def ask_for_small_steps(self) -> None:
        """Ask the FMU to return after each of its own steps."""
        self._act("ask_for_small_steps")

    def _act(self, method: str, *arguments: Any, doing: int = OTHER) -> Any:
        values = self._row[self._in.start : self._out.stop], self._beside[self._in_beside.start : self._out_beside.stop]
        return self._mirror(self._call(doing, act, self.name, method, arguments, values))

    def _mirror(self, answer: tuple[Any, Values, dict[str, Any]]) -> Any:
        result, (row, beside), attributes = answer
        self._row[self._in.start : self._out.stop] = [*row]
        self._beside[self._in_beside.start : self._out_beside.stop] = beside
        self.__dict__.update(attributes)
        self.instance.time = self.reached
        return result


class _ChangedInputs(InstanceValues):
    """Values that note whether an input would be set."""

    has_changed = False

    def put_in(self, exchange: Exchange) -> None:
        self.has_changed = True


def _apart(component: Component, limits: Limits) -> OwnProcess:
    """Return a component in a process of its own."""
    if isinstance(component, RemoteFmu) or is_exchange(component) or not isinstance(component, FmuBlock):
        return OwnProcess(component, limits)
    kind = OwnEvents if isinstance(component, EventFmu) else OwnFmu
    proxy: OwnProcess = type(kind.__name__, (kind, type(component)), {})(component, limits)
    return proxy


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
            stage = replace(stage, component=_apart(stage.component, Limits(memory=limits.memory)))
        elif single:
            paths.add(path)
        stages.append(stage)
    return replace(system, stages=tuple(stages))
