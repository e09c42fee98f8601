"""Events of a scenario: parameters and inputs set at given times."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from cosim.blocks.faults import steps_in
from cosim.blocks.fmu import FmuBlock
from cosim.scenario.diagnosis import Diagnosis
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import Misfit, convert_value
from cosim.storage.yaml_file import did_you_mean
from cosim.system import messages

Events = Mapping[int, Mapping[str, Mapping[str, Any]]]  # communication point → component → variable → value


def changes_of(file: ScenarioFile, blocks: Mapping[str, FmuBlock], diagnosis: Diagnosis) -> Events:
    """Return communication point → component → variable → event value.

    An event acts at the first point at or after its time. Among events at the same point, the later time wins.
    """
    scenario = file.scenario
    changes: dict[int, dict[str, dict[str, Any]]] = {}
    connected = {c.target for c in scenario.connections}
    variables = {name: {v.name: v for v in block.description.modelVariables} for name, block in blocks.items()}
    values: dict[tuple[float, str], Any] = {}
    events = zip(file.places["events"], scenario.events, strict=True)
    for k, event in sorted(events, key=lambda placed: placed[1].at):
        point = math.ceil(steps_in(event.at - scenario.start_time, scenario.step) - 1e-9)
        if not 0 <= point <= scenario.steps:
            end = scenario.start_time + scenario.duration
            message = messages.EVENT_OUTSIDE_RUN(time=event.at, start=scenario.start_time, end=end)
            diagnosis.note(("events", k, "at"), message)
            continue
        for target, written in event.set.items():
            name, _, variable = target.partition(".")
            value = _value(blocks, variables, connected, target, written)
            if isinstance(value, Misfit):
                diagnosis.note(("events", k, "set", target), value.reason)
            elif (first := values.setdefault((event.at, target), value)) != value:
                message = messages.TWO_VALUES(time=event.at, first=first, second=value)
                diagnosis.note(("events", k, "set", target), message)
            else:
                changes.setdefault(point, {}).setdefault(name, {})[variable] = value
    return changes


def _value(
    blocks: Mapping[str, FmuBlock],
    variables_of: Mapping[str, Mapping[str, Any]],
    connected: Collection[str],
    target: str,
    written: Any,
) -> Any:
    """Return the value of an event in the variable's FMI type, or the reason for a refusal."""
    name, _, variable_name = target.partition(".")
    block = blocks.get(name)
    if block is None:
        return Misfit(messages.NO_FMU_OF_NAME(name=name, hint=did_you_mean(name, blocks)))
    variables = variables_of[name]
    variable = variables.get(variable_name)
    if variable is None:
        hint = did_you_mean(variable_name, [n for n, v in variables.items() if _is_changeable(v)])
        return Misfit(messages.NO_VARIABLE(component=name, name=variable_name, hint=hint))
    if not _is_changeable(variable):
        kind = {"variability": variable.variability, "causality": variable.causality}
        return Misfit(messages.NOT_CHANGEABLE(name=target, **kind))
    if target in connected or target.partition("[")[0] in connected:
        return Misfit(messages.SET_AND_CONNECTED(name=target))
    value = convert_value(block.description, variable, written)
    if isinstance(value, Misfit):
        return Misfit(messages.VALUE_MISFIT(name=target, value=written, reason=value.reason))
    return value


def _is_changeable(variable: Any) -> bool:
    """Return whether FMI allows setting the variable mid-run."""
    return bool(variable.causality == "input" or (variable.causality, variable.variability) == ("parameter", "tunable"))
