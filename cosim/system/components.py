"""Components of a scenario: FMUs with start values, references, recordings and fixes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from cosim.base.errors import FmuError, InputError
from cosim.base.registry import BASE, is_model, model_entry
from cosim.blocks.component import Component
from cosim.blocks.description import read_description, state_names, ways
from cosim.blocks.fixes import COUNT, Fixes, Sensor
from cosim.blocks.fmu import FmuBlock, named
from cosim.blocks.sources import playback, reference
from cosim.scenario.diagnosis import Diagnosis, Place
from cosim.scenario.scenario import FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent, Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import Misfit, kind_of, settable, typed, with_elements
from cosim.storage.yaml_file import did_you_mean

Designed = Mapping[str, Mapping[str, float]]  # component → start values


def build_components(file: ScenarioFile, designed: Designed, diagnosis: Diagnosis) -> dict[str, Component]:
    """Return the sound components by name, in file order."""
    found: dict[str, Component] = {}
    read = cache(read_description)  # Several components may use the same FMU.
    for name, component in file.scenario.components.items():
        try:
            block = _component(file, name, component, designed.get(name, {}), read, diagnosis)
        except InputError as error:
            diagnosis.faults += error.faults
        except FmuError as error:
            diagnosis.note(("components", name, "fmu"), str(error), exit_code=3)
        else:
            found |= {name: block} if block is not None else {}
    return found


def _component(
    file: ScenarioFile,
    name: str,
    component: FmuComponent | ReferenceComponent | PlaybackComponent | FixComponent,
    designed: Mapping[str, float],
    read: Callable[[Path], Any],
    diagnosis: Diagnosis,
) -> Component | None:
    if isinstance(component, ReferenceComponent):
        return reference(name, component.signals)
    if isinstance(component, PlaybackComponent):
        sources = (connection.source.partition(".") for connection in file.scenario.connections)
        return playback(name, file.resolve(component.file), {v for owner, _, v in sources if owner == name})
    if isinstance(component, FixComponent):
        return _fixes(file.scenario, name, component, diagnosis)
    return _fmu(file, name, component, designed, read, diagnosis)


def _fixes(scenario: Scenario, name: str, component: FixComponent, diagnosis: Diagnosis) -> Fixes | None:
    """Return a fix sensor; note faults of rate and names."""
    signals = {}
    for signal, about in component.signals.items():
        noise = about.noise if scenario.noise else None
        signals[signal] = (about.unit, noise.variance, noise.bias) if noise else (about.unit, 0.0, 0.0)
    sensor = Sensor(component.rate, component.latency, component.dropout, signals)
    taken = [n for n in signals if n in sensor.outputs()]
    for signal in taken:
        what = "their number goes out" if signal == COUNT else "the fixes of another signal go out"
        where: Place = ("components", name, "signals", signal)
        diagnosis.note(where, f'"{signal}" is the name under which {what}; give the signal another')
    fastest = 1.0 / scenario.step
    fast = component.rate > fastest * (1.0 + 1e-9)
    if fast:
        cure = f"use at most {fastest:g} Hz, or a shorter step"
        message = f"rate is {component.rate:g} Hz, communication points come at {fastest:g} Hz; {cure}"
        diagnosis.note(("components", name, "rate"), message)
    return None if fast or taken else Fixes(name, sensor, scenario.step, scenario.seed)


def _fmu(
    file: ScenarioFile,
    name: str,
    component: FmuComponent,
    designed: Mapping[str, float],
    read: Callable[[Path], Any],
    diagnosis: Diagnosis,
) -> FmuBlock | None:
    path = file.resolve(component.fmu)
    if not path.is_file():
        made = is_model(BASE) and path.name in model_entry().built
        cure = f'; "cosim build --out {path.parent}" makes it' if made else ""
        if file.manifest is not None:
            cure += f"; put it there, or {path.name} beside {file.path.name}"
        diagnosis.note(("components", name, "fmu"), f"no such FMU: {path}{cure}")
        return None
    description = read(path)
    start = _start_values(name, description, {**designed, **component.start}, diagnosis)
    targets = (connection.target.partition(".") for connection in file.scenario.connections)
    connected = frozenset(variable for owner, _, variable in targets if owner == name)
    if component.interface not in (None, *ways(description)):
        offered = " and ".join(ways(description))
        diagnosis.note(("components", name, "interface"), f"{path.name} offers {offered} only")
        return None
    scenario = file.scenario
    return FmuBlock(
        name,
        path,
        description,
        start,
        connected,
        way=component.interface,
        tolerance=scenario.tolerance if component.tolerance is None else component.tolerance,
        recorded=recorded(scenario.record, name, description),
        logging=component.logging,
        solver=component.solver,
    )


def recorded(patterns: Sequence[str], name: str, description: Any) -> frozenset[str]:
    """Return variables to record besides inputs and outputs.

    They match patterns such as `plant.*`. An FMU without outputs adds its states.
    """
    found = {
        v.name
        for v in description.modelVariables
        if v.causality not in {"input", "output", "independent"} and any(named(p, name, v.name) for p in patterns)
    }
    if not any(v.causality == "output" for v in description.modelVariables):  # as in FMPy
        found |= set(state_names(description))
    return frozenset(found)


def _start_values(component: str, description: Any, stated: Mapping[str, Any], diagnosis: Diagnosis) -> dict[str, Any]:
    """Return converted start values; note a fault for each misfit."""
    variables = {v.name: v for v in description.modelVariables} if stated else {}
    values = {}
    for name, value in with_elements(stated, variables).items():
        variable = variables.get(name)
        if variable is None:
            hint = did_you_mean(name, [v.name for v in variables.values() if settable(v)])
            converted: Any = Misfit(f'{component} has no variable "{name}"{hint}')
        elif not settable(variable):
            converted = Misfit(f"{component}.{name} is {kind_of(variable)}; it takes no start value")
        else:
            converted = typed(description, variable, value)
            if isinstance(converted, Misfit):
                converted = Misfit(f"{component}.{name} is {value!r}; {converted.reason}")
        if isinstance(converted, Misfit):
            diagnosis.note(("components", component, "start", name), converted.reason)
        elif converted is not None:
            values[name] = converted
    return values
