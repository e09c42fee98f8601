"""Components of a scenario: FMUs with start values, references, recordings and fixes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from cosim.blocks.component import Component
from cosim.blocks.fixes import COUNT, Fixes, fix_outputs
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock, playback, reference
from cosim.core.errors import FmuError, InputError
from cosim.core.registry import BASE, is_model, model_entry
from cosim.core.text import did_you_mean
from cosim.files.kinds import shell_path
from cosim.fmi.description import matches, read_description, state_names, ways
from cosim.fmi.fmi_types import element_names, kinds_of
from cosim.scenario.scenario import FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent, Scenario
from cosim.scenario.scenario_file import Diagnosis, ScenarioFile
from cosim.scenario.start_values import start_value, with_elements
from cosim.system.events import event_block


def build_components(file: ScenarioFile, diagnosis: Diagnosis) -> dict[str, Component]:
    """Return the sound components by name, in file order."""
    scenario, components = file.scenario, dict[str, Component]()
    read = cache(read_description)  # Several components may use the same FMU.
    for name, component in scenario.components.items():
        block: Component | None
        try:
            if isinstance(component, ReferenceComponent):
                block = reference(name, component.signals, scenario.step)
            elif isinstance(component, PlaybackComponent):
                names = _variables_of(name, [connection.source for connection in scenario.connections])
                linear = component.interpolation == "linear"
                exact = _exact(file, name, read)
                block = playback(name, file.resolve(component.file), names, exact, step=scenario.step, linear=linear)
            elif isinstance(component, FixComponent):
                block = _fixes(scenario, name, component, diagnosis)
            else:
                block = _fmu(file, name, component, read, diagnosis)
        except InputError as error:
            diagnosis.faults += error.faults
        except FmuError as error:
            diagnosis.note(("components", name, "fmu"), str(error), exit_code=3)
        else:
            components |= {name: block} if block is not None else {}
    for connection in scenario.connections:  # Hold recorded signals between rows where they feed whole numbers.
        owner, _, column = connection.source.partition(".")
        target, _, variable = connection.target.partition(".")
        source = components.get(owner)
        if isinstance(source, SourceBlock) and column in source.interpolated and target in components:
            signals = (*components[target].inputs, *components[target].exact_inputs)
            if any(s.is_whole for s in signals if variable in (s.name, s.array)):
                source.hold(column)
    return components


def _exact(file: ScenarioFile, name: str, read: Callable[[Path], Any]) -> dict[str, str]:
    """Return the columns of a recording that feed inputs whose values no double holds, with the types of these."""
    types: dict[str, str] = {}
    for connection in file.scenario.connections:
        owner, _, column = connection.source.partition(".")
        target, _, variable = connection.target.partition(".")
        fmu = file.scenario.components.get(target)
        if owner != name or not isinstance(fmu, FmuComponent):
            continue
        with suppress(FmuError, InputError, OSError):  # Another check reports this FMU.
            description = read(file.resolve(fmu.fmu))
            kinds = kinds_of(description.fmiVersion)
            fed = {variable, variable.rpartition("[")[0]}
            of = next((v.type for v in description.modelVariables if v.name in fed), "")
            if of in kinds and kinds[of].beside:
                types[column] = of
    return types


def _fixes(scenario: Scenario, name: str, component: FixComponent, diagnosis: Diagnosis) -> Fixes | None:
    """Return a sensor of position fixes; note faults."""
    signals = {}
    for signal, about in component.signals.items():
        noise = about.noise if scenario.noise else None
        signals[signal] = (about.unit, noise.variance, noise.bias) if noise else (about.unit, 0.0, 0.0)
    collisions = [n for n in signals if n in fix_outputs(signals)]
    for signal in collisions:
        other = "the output that counts the fixes" if signal == COUNT else "an output with the fixes of another signal"
        message = f'"{signal}" is already the name of {other}; give the signal another name'
        diagnosis.note(("components", name, "signals", signal), message)
    fastest = 1.0 / scenario.step
    if too_fast := component.rate > fastest * (1.0 + 1e-9):
        message = (
            f"rate is {component.rate:g} Hz, communication points come at {fastest:g} Hz; use at most "
            f"{fastest:g} Hz, or a shorter step"
        )
        diagnosis.note(("components", name, "rate"), message)
    if too_fast or collisions:
        return None
    rates = component.rate, component.latency, component.dropout
    return Fixes(name, *rates, signals, step=scenario.step, seed=scenario.seed)


def _fmu(
    file: ScenarioFile,
    name: str,
    component: FmuComponent,
    read: Callable[[Path], Any],
    diagnosis: Diagnosis,
) -> FmuBlock | None:
    path, scenario = file.resolve(component.fmu), file.scenario
    if not path.is_file():
        is_built = is_model(BASE) and path.name in model_entry().built
        made = model_entry().name if is_built else ""
        cure = f'; "cosim build --model {made} --out {shell_path(path.parent)}" makes that of {made}' if made else ""
        cure += "" if file.manifest is None else f"; put it there, or {path.name} beside {file.path.name}"
        diagnosis.note(("components", name, "fmu"), f"no such FMU: {path}{cure}")
        return None
    description = read(path)
    variables = {v.name: v for v in description.modelVariables} if component.start else {}
    start = {}
    for variable, value in with_elements(component.start, variables).items():
        try:
            start[variable] = start_value(description, variables, variable, value, name)
        except ValueError as error:
            diagnosis.note(("components", name, "start", variable), str(error))
    connected = frozenset(_variables_of(name, [connection.target for connection in file.scenario.connections]))
    if component.interface not in (None, *ways(description)):
        message = f"{path.name} offers {' and '.join(ways(description))} only"
        diagnosis.note(("components", name, "interface"), message)
        return None
    inputs = [v for v in description.modelVariables if v.causality == "input"]
    names = {*(v.name for v in inputs), *(element for v in inputs for element in element_names(v))}
    for k, entry in enumerate(component.feedthrough or ()):
        if entry not in names:
            hint = did_you_mean(entry, [v.name for v in inputs])
            message = f'{name} has no input "{entry}"{hint}; feedthrough: names inputs'
            diagnosis.note(("components", name, "feedthrough", k), message)
    # variables to record besides inputs and outputs; for an FMU without outputs, its states, as in FMPy
    recorded = {
        v.name
        for v in description.modelVariables
        if v.causality not in {"input", "output", "independent"}
        and any(matches(pattern, name, v.name) for pattern in scenario.recorded)
    }
    if not any(v.causality == "output" for v in description.modelVariables):
        recorded |= set(state_names(description))
    make = event_block(file, name, component, path, read, diagnosis)
    if make is None:
        return None
    return make(
        name,
        path,
        description,
        start,
        connected,
        way=component.interface,
        tolerance=scenario.tolerance if component.tolerance is None else component.tolerance,
        recorded=frozenset(recorded),
        logging=component.logging,
        solver=component.solver,
        solver_step=component.solver_step,
        max_steps=component.max_steps,
        feedthrough=None if component.feedthrough is None else frozenset(component.feedthrough),
    )


def _variables_of(component: str, ends: Iterable[str]) -> set[str]:
    """Return the variables of a component among ends of connections, `component.variable`."""
    return {variable for owner, _, variable in (end.partition(".") for end in ends) if owner == component}
