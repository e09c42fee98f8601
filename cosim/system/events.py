"""Events of a scenario, and FMUs with event mode: selection, clocks and checks."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cosim.blocks.event_mode import PERIODIC, EventFmu, ScheduledFmu, read_clocks
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.model_exchange import ModelExchange
from cosim.blocks.sources import SourceBlock
from cosim.core.text import did_you_mean
from cosim.core.times import first_point
from cosim.core.units import read_quantity
from cosim.fmi.annotations import sampled_by
from cosim.fmi.description import Way, enumeration_items, takes_any_step, unit_of, ways
from cosim.fmi.fmi_types import FLOAT_TYPES, input_aliases
from cosim.scenario.scenario import FmuComponent
from cosim.scenario.start_values import bounds_of, convert_value
from cosim.system.schedule import Loop, Schedule, Stage
from cosim.system.wiring import Building

Events = Mapping[int, Mapping[str, Mapping[str, Any]]]  # communication point → component → variable → value


def event_block(building: Building, name: str, component: FmuComponent, path: Path) -> Callable[..., FmuBlock] | None:
    """Return the class for an FMU with or without event mode; after a fault, record it and return None."""
    scenario, description = building.scenario, building.describe(path)
    way = component.interface or ways(description)[0]
    clocks = read_clocks(path, description)
    wanted = bool(clocks) if component.event_mode is None else component.event_mode
    uses = way == "scheduled-execution" or (wanted and has_event_mode(description, way))
    if not uses:
        if component.event_mode:
            message = f"{name} has no event mode, which needs FMI 3.0, co-simulation and the capability hasEventMode"
            building.note(("components", name, "event_mode"), message)
            return None
        if component.clocks:
            cure = "remove event_mode: false" if clocks else "remove clocks:"
            building.note(("components", name, "clocks"), f"{name} has no clocks without event mode; {cure}")
        return FmuBlock
    timings = {}
    for clock_name, timing in component.clocks.items():
        clock, full_name = clocks.get(clock_name), f"{name}.{clock_name}"
        if clock is None or clock.causality != "input":
            hint = did_you_mean(clock_name, [c.name for c in clocks.values() if c.causality == "input"])
            message = f'{name} has no input clock "{clock_name}"{hint}'
        elif full_name in scenario.targets:
            message = f"{full_name} has both times in the scenario and a connection; keep one"
        elif clock.kind == "constant" or (clock.kind != "triggered" and clock.interval is None):
            message = f"the FMU specifies the times of {full_name}; remove them from the scenario"
        elif bool(timing.at) == (timing.interval is not None) or (
            clock.kind in PERIODIC and (timing.at or timing.shift is not None)
        ):
            message = f"{full_name} is a {clock.kind} clock; give its interval, or for a triggered clock at:"
        elif timing.at != sorted(set(timing.at)) or (timing.at and timing.at[0] < scenario.start_time):
            message = f"the times of {full_name} must increase and not precede the start of the run"
        else:
            timings[clock_name] = timing
            continue
        building.note(("components", name, "clocks", clock_name), message)
    jumping = set()  # inputs whose sources change discontinuously
    for connection in scenario.connections:
        source, output, owner, variable = connection.ends
        if owner != name:
            continue
        fmu = scenario.components.get(source)
        if not isinstance(fmu, FmuComponent) or fmu.step is not None:
            jumping.add(variable)
        elif (source_path := building.file.resolve(fmu.fmu)).is_file():
            names = output, output.partition("[")[0]
            ends = [v for v in building.describe(source_path).modelVariables if v.name in names]
            if any(v.variability not in (None, "continuous") or v.type not in FLOAT_TYPES for v in ends):
                jumping.add(variable)
    kind = ScheduledFmu if way == "scheduled-execution" else EventFmu
    return partial(kind, timings=timings, jumping=frozenset(jumping))


def default_block(path: Path, description: Any) -> type[FmuBlock]:
    """Return the class that the scenario uses by default for an FMU."""
    way = ways(description)[0]
    if way == "scheduled-execution":
        return ScheduledFmu
    return EventFmu if has_event_mode(description, way) and read_clocks(path, description) else FmuBlock


def has_event_mode(description: Any, way: Way) -> bool:
    """Return True if an FMU supports event mode."""
    return way == "co-simulation" and bool(getattr(description.coSimulation, "hasEventMode", False))


def is_exchange(component: Any) -> bool:
    """Return True if a component uses model exchange."""
    return isinstance(component, FmuBlock) and isinstance(component.instance, ModelExchange)


def can_end_step_at_event(stage: Stage, loops: Sequence[Loop]) -> bool:
    """Return True if a component can end a step at any event; components of an algebraic loop cannot."""
    component = stage.component
    if any(component.name in loop.members for loop in loops):
        return False
    if stage.every > 1 or (component.nominal_step is True and isinstance(component, FmuBlock)):
        return False
    if isinstance(component, EventFmu):
        return component.may_return or not component.steps
    if isinstance(component, SourceBlock) or is_exchange(component):
        return True
    return isinstance(component, FmuBlock) and takes_any_step(component.description) and not sampled_by(component.path)


def clock_interval(block: FmuBlock | None, target: str, value: Any) -> Any:
    """Return the interval [s] that an event sets for a clock; None if the target is not a clock.

    Raises:
        ValueError: The value is not a valid interval for the clock.
    """
    clock = block.clocks.get(target.partition(".")[2]) if isinstance(block, EventFmu) else None
    if clock is None:
        return None
    with suppress(ValueError):
        value = read_quantity(value, "s") if isinstance(value, str) else value
    is_time = isinstance(value, int | float) and not isinstance(value, bool) and value > 0
    if clock.kind != "tunable" or clock.interval is None or not is_time:
        raise ValueError(f"{target} is {value!r}; give a tunable clock with intervalDecimal, and a time above 0 s")
    return float(value)


def check_events(building: Building, plan: Schedule, apart: Collection[str]) -> None:
    """Record warnings about FMUs with event mode.

    Args:
        apart: Components with a process of their own.
    """
    events = [stage.component for stage in plan.stages if isinstance(stage.component, EventFmu)]
    if not events:
        return
    for stage in plan.stages:
        name, reason = stage.component.name, ""
        if not can_end_step_at_event(stage, plan.loops):
            reason = "accepts only one step length or is part of an algebraic loop"
        elif name in apart and is_exchange(stage.component):
            reason = "uses model exchange in a process of its own"
        if reason:
            building.warnings.append(f"{name} {reason}, so an event within a step takes effect at the end of the step")
    clocks = (f"{fmu.name}.{signal.name}" for fmu in events for signal in fmu.inputs if signal.kind == "Clock")
    if idle := [name for name in clocks if name not in building.scenario.targets]:
        names = ", ".join(idle)
        building.warnings.append(
            f"{names}: the clock never ticks; connect it to an output clock, or give its times under clocks:"
        )


def changes_of(building: Building) -> Events:
    """Return communication point → component → variable → value set by events.

    An event takes effect at the first communication point at or after its time. If several events take effect at the
    same point, the one with the later time is used.
    """
    scenario, blocks = building.scenario, building.blocks
    changes: dict[int, dict[str, dict[str, Any]]] = {}
    descriptions = {name: block.description for name, block in blocks.items()}
    targets = Targets(descriptions, scenario.targets)
    values: dict[tuple[float, str], Any] = {}
    events = zip(building.file.places["events"], scenario.events, strict=True)
    for k, event in sorted(events, key=lambda placed: placed[1].at):
        point = first_point(event.at, scenario.start_time, scenario.step)
        if not 0 <= point <= scenario.steps:
            end = scenario.start_time + scenario.duration
            building.note(
                ("events", k, "at"), f"{event.at:g} s is outside the run, {scenario.start_time:g} … {end:g} s"
            )
            continue
        for target, written in event.set.items():
            name, _, variable = target.partition(".")
            if name not in blocks and isinstance(scenario.components.get(name), FmuComponent):
                continue  # the FMU cannot be used, which is already reported
            try:
                value = clock_interval(blocks.get(name), target, written)
                value = targets.value(target, written) if value is None else value
                if (first := values.setdefault((event.at, target), value)) != value:
                    raise ValueError(f"two values at {event.at:g} s: {first!r} and {value!r}; keep one")
                changes.setdefault(point, {}).setdefault(name, {})[variable] = value
            except ValueError as error:
                building.note(("events", k, "set", target), str(error))
    return changes


@dataclass(frozen=True)
class Variable:
    """A variable that can be changed during a run.

    Attributes:
        name: Name `component.variable`.
        is_input: True for an input, which is recorded in the rows; False for a parameter.
        kind: FMI type.
        start: Value at the start of the run, None if the FMU does not declare a value.
        bounds: Least and largest value.
        items: Name → number of an enumeration.
        shape: Lengths of an array, empty for a scalar.
    """

    name: str
    is_input: bool
    kind: str
    unit: str
    start: Any
    bounds: tuple[float, float]
    items: Mapping[str, int]
    shape: Sequence[int]
    description: str


class Targets:
    """Variables that can be set during a run: tunable parameters and unconnected inputs of FMUs.

    Args:
        descriptions: FMU → model description.
        connected: Names of connected inputs, or of their arrays.
    """

    def __init__(self, descriptions: Mapping[str, Any], connected: Collection[str]) -> None:
        aliases = {name: input_aliases(description) for name, description in descriptions.items()}
        others = (
            f"{n}.{w}" for n, of in aliases.items() for v, ws in of.items() if f"{n}.{v}" in connected for w in ws
        )
        self._descriptions, self._connected = descriptions, {*connected, *others}
        self._variables = {name: {v.name: v for v in d.modelVariables} for name, d in descriptions.items()}

    def value(self, target: str, written: Any) -> Any:
        """Return a value in the FMI type of `component.variable`; raise ValueError if it does not fit the type."""
        variable = self.variable(target)
        try:
            return convert_value(self._descriptions[target.partition(".")[0]], variable, written)
        except ValueError as error:
            raise ValueError(f"{target} is {written!r}; {error}") from None

    def variable(self, target: str) -> Any:
        """Return the variable `component.variable`; raise ValueError if it cannot be set during a run."""
        name, _, variable_name = target.partition(".")
        variable = self._variables.get(name, {}).get(variable_name)
        if variable is None or not _is_changeable(variable):
            every = (f"{n}.{v.name}" for n, own in self._variables.items() for v in own.values() if _is_changeable(v))
            hint = did_you_mean(target, every)
            raise ValueError(f"{target} is no input or tunable parameter of an FMU, so it cannot change in a run{hint}")
        if self._is_connected(target):
            raise ValueError(f"{target} is connected to an output; use faults: to disturb its value")
        return variable

    def variables(self, starts: Mapping[str, Mapping[str, Any]]) -> list[Variable]:
        """Return all variables that can be set during a run; `starts` has the start values of each component."""
        return [
            Variable(
                f"{name}.{v.name}",
                v.causality == "input",
                v.type,
                unit_of(v),
                starts.get(name, {}).get(v.name, v.start),
                bounds_of(self._descriptions[name], v),
                enumeration_items(v),
                tuple(v.shape or ()),
                v.description or "",
            )
            for name, variables in self._variables.items()
            for v in variables.values()
            if _is_changeable(v) and not self._is_connected(f"{name}.{v.name}")
        ]

    def _is_connected(self, target: str) -> bool:
        return target in self._connected or target.partition("[")[0] in self._connected


def _is_changeable(variable: Any) -> bool:
    """Return True if FMI allows changes of the variable during a run."""
    is_tunable = (variable.causality, variable.variability) == ("parameter", "tunable")
    return variable.type != "Clock" and bool(variable.causality == "input" or is_tunable)
