"""Events of a scenario: parameters and inputs set at given times."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.core.times import first_point
from cosim.files.yaml_file import did_you_mean
from cosim.fmi.description import enumeration_items, unit_of
from cosim.fmi.fmi_types import input_aliases
from cosim.scenario.scenario import FmuComponent
from cosim.scenario.scenario_file import Diagnosis, ScenarioFile
from cosim.scenario.start_values import bounds_of, convert_value
from cosim.system.event_blocks import clock_interval

Events = Mapping[int, Mapping[str, Mapping[str, Any]]]  # communication point → component → variable → value


def changes_of(file: ScenarioFile, blocks: Mapping[str, FmuBlock], diagnosis: Diagnosis) -> Events:
    """Return communication point → component → variable → event value.

    An event acts at the first point at or after its time. Among events at the same point, the later time wins.
    """
    scenario = file.scenario
    changes: dict[int, dict[str, dict[str, Any]]] = {}
    descriptions = {name: block.description for name, block in blocks.items()}
    targets = Targets(descriptions, scenario.targets)
    values: dict[tuple[float, str], Any] = {}
    events = zip(file.places["events"], scenario.events, strict=True)
    for k, event in sorted(events, key=lambda placed: placed[1].at):
        point = first_point(event.at, scenario.start_time, scenario.step)
        if not 0 <= point <= scenario.steps:
            end = scenario.start_time + scenario.duration
            message = f"{event.at:g} s is not within {scenario.start_time:g} … {end:g} s"
            diagnosis.note(("events", k, "at"), message)
            continue
        for target, written in event.set.items():
            name, _, variable = target.partition(".")
            if name not in blocks and isinstance(scenario.components.get(name), FmuComponent):
                continue  # Its FMU cannot be used, which is a fault already.
            try:
                value = clock_interval(blocks.get(name), target, written)
                value = targets.value(target, written) if value is None else value
                if (first := values.setdefault((event.at, target), value)) != value:
                    raise ValueError(f"two values at {event.at:g} s: {first!r} and {value!r}; keep one")
                changes.setdefault(point, {}).setdefault(name, {})[variable] = value
            except ValueError as error:
                diagnosis.note(("events", k, "set", target), str(error))
    return changes


@dataclass(frozen=True)
class Variable:
    """A variable that can be changed during a run.

    Attributes:
        name: Name `component.variable`.
        is_input: Whether it is an input, recorded in the rows, and not a parameter.
        kind: FMI type.
        start: Value at the start of the run, None if the FMU does not declare it.
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
    """Variables that may be set during a run: tunable parameters and unconnected inputs of FMUs.

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
        """Return a value in the FMI type of the variable `component.variable`; raise ValueError if unsuitable."""
        variable = self.variable(target)
        try:
            return convert_value(self._descriptions[target.partition(".")[0]], variable, written)
        except ValueError as error:
            raise ValueError(f"{target} is {written!r}; {error}") from None

    def variable(self, target: str) -> Any:
        """Return the variable `component.variable`; raise ValueError if it cannot be set during a run."""
        name, _, variable_name = target.partition(".")
        description = self._descriptions.get(name)
        if description is None:
            raise ValueError(f'no FMU "{name}" among the components{did_you_mean(name, self._descriptions)}')
        variables = self._variables[name]
        variable = variables.get(variable_name)
        if variable is None:
            hint = did_you_mean(variable_name, [n for n, v in variables.items() if _is_changeable(v)])
            raise ValueError(f'{name} has no variable "{variable_name}"{hint}')
        if not _is_changeable(variable):
            kind = f"{variable.variability} {variable.causality}"
            raise ValueError(f"{target} is a {kind}; inputs and tunable parameters change while it runs")
        if self._is_connected(target):
            raise ValueError(f"{target} is connected, which decides its value; use faults: for its disturbances")
        return variable

    def variables(self, starts: Mapping[str, Mapping[str, Any]]) -> list[Variable]:
        """Return all variables that may be set, with their start values in `starts` by component."""
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
    """Return whether FMI allows setting the variable mid-run."""
    is_tunable = (variable.causality, variable.variability) == ("parameter", "tunable")
    return variable.type != "Clock" and bool(variable.causality == "input" or is_tunable)
