"""Events of a scenario: parameters and inputs set at given times."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from cosim.blocks.faults import steps_in
from cosim.blocks.fmu import FmuBlock
from cosim.scenario.diagnosis import Diagnosis
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import Misfit, typed
from cosim.storage.yaml_file import did_you_mean

Events = Mapping[int, Mapping[str, Mapping[str, Any]]]  # communication point → component → variable → value


def changes(file: ScenarioFile, blocks: Mapping[str, FmuBlock], diagnosis: Diagnosis) -> Events:
    """Return the events by communication point.

    An event acts at the first point at or after its time. Among events at the same point, the later time wins.
    """
    scenario = file.scenario
    found: dict[int, dict[str, dict[str, Any]]] = {}
    connected = {c.target for c in scenario.connections}
    variables = {name: {v.name: v for v in block.description.modelVariables} for name, block in blocks.items()}
    given_at: dict[tuple[float, str], Any] = {}
    events = zip(file.places["events"], scenario.events, strict=True)
    for k, event in sorted(events, key=lambda placed: placed[1].at):
        point = math.ceil(steps_in(event.at - scenario.start_time, scenario.step) - 1e-9)
        if not 0 <= point <= scenario.steps:
            end = scenario.start_time + scenario.duration
            diagnosis.note(("events", k, "at"), f"{event.at:g} s is not within {scenario.start_time:g} … {end:g} s")
            continue
        for target, given in event.set.items():
            name, _, variable = target.partition(".")
            value = _value(blocks, variables, connected, target, given)
            if isinstance(value, Misfit):
                diagnosis.note(("events", k, "set", target), value.reason)
            elif given_at.setdefault((event.at, target), value) != value:
                both = f"{given_at[event.at, target]!r} and {value!r}"
                diagnosis.note(("events", k, "set", target), f"two values at {event.at:g} s: {both}; keep one")
            else:
                found.setdefault(point, {}).setdefault(name, {})[variable] = value
    return found


def _value(
    blocks: Mapping[str, FmuBlock],
    variables_of: Mapping[str, Mapping[str, Any]],
    connected: Collection[str],
    target: str,
    given: Any,
) -> Any:
    """Return the value in FMI's type, or the objection."""
    name, _, variable_name = target.partition(".")
    block = blocks.get(name)
    if block is None:
        return Misfit(f'no FMU "{name}" among the components{did_you_mean(name, blocks)}')
    variables = variables_of[name]
    variable = variables.get(variable_name)
    if variable is None:
        known = [n for n, v in variables.items() if changeable(v)]
        return Misfit(f'{name} has no variable "{variable_name}"{did_you_mean(variable_name, known)}')
    if not changeable(variable):
        what = f"a {variable.variability} {variable.causality}"
        return Misfit(f"{target} is {what}; inputs and tunable parameters change while it runs")
    if target in connected or target.partition("[")[0] in connected:
        return Misfit(f"{target} is connected, which decides its value; use faults: for what disturbs a connection")
    value = typed(block.description, variable, given)
    return Misfit(f"{target} is {given!r}; {value.reason}") if isinstance(value, Misfit) else value


def changeable(variable: Any) -> bool:
    """Return whether FMI allows setting the variable during a run."""
    return bool(variable.causality == "input" or (variable.causality, variable.variability) == ("parameter", "tunable"))
