"""Components of a scenario: FMUs with start values, references, recordings and fixes."""

from __future__ import annotations

from contextlib import suppress

from cosim.blocks.component import Component
from cosim.blocks.fixes import Fixes, fix_outputs
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import playback, reference
from cosim.core.errors import FmuError, InputError
from cosim.core.registry import BASE, is_model, model_entry
from cosim.core.text import did_you_mean
from cosim.files.kinds import shell_path
from cosim.fmi.description import matches, state_names, ways
from cosim.fmi.fmi_types import element_names, kinds_of
from cosim.scenario.scenario import FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent
from cosim.scenario.start_values import start_value, with_elements
from cosim.system.events import event_block
from cosim.system.wiring import Building


def build_components(building: Building) -> None:
    """Build the components of a scenario."""
    file, scenario = building.file, building.scenario
    ends = [connection.ends for connection in scenario.connections]
    for name, component in scenario.components.items():
        block: Component | None
        try:
            if isinstance(component, ReferenceComponent):
                block = reference(name, component.signals, scenario.step)
            elif isinstance(component, PlaybackComponent):
                names = {column for owner, column, _, _ in ends if owner == name}
                linear = component.interpolation == "linear"
                exact = _exact(building, name)
                block = playback(name, file.resolve(component.file), names, exact, step=scenario.step, linear=linear)
            elif isinstance(component, FixComponent):
                block = _fixes(building, name, component)
            else:
                block = _fmu(building, name, component)
        except InputError as error:
            building.faults += error.faults
        except FmuError as error:
            building.note(("components", name, "fmu"), str(error), exit_code=3)
        else:
            if block is not None:
                building.components[name] = block


def _exact(building: Building, name: str) -> dict[str, str]:
    """Return column → FMI type for recorded columns that feed inputs of types beyond doubles (text, 64-bit)."""
    types: dict[str, str] = {}
    for connection in building.scenario.connections:
        owner, column, target, variable = connection.ends
        fmu = building.scenario.components.get(target)
        if owner != name or not isinstance(fmu, FmuComponent):
            continue
        with suppress(FmuError, InputError, OSError):  # another check reports an error in this FMU
            description = building.describe(building.file.resolve(fmu.fmu))
            kinds = kinds_of(description.fmiVersion)
            fed = {variable, variable.rpartition("[")[0]}
            of = next((v.type for v in description.modelVariables if v.name in fed), "")
            if of in kinds and kinds[of].beside:
                types[column] = of
    return types


def _fixes(building: Building, name: str, component: FixComponent) -> Fixes | None:
    """Return a sensor of position fixes; after a fault, record it and return None."""
    scenario, signals = building.scenario, {}
    for signal, about in component.signals.items():
        noise = about.noise if scenario.noise else None
        signals[signal] = (about.unit, noise.variance, noise.bias) if noise else (about.unit, 0.0, 0.0)
    collisions = [n for n in signals if n in fix_outputs(signals)]
    for signal in collisions:
        message = f'"{signal}" is already the name of an output; rename the signal'
        building.note(("components", name, "signals", signal), message)
    fastest = 1.0 / scenario.step
    if too_fast := component.rate > fastest * (1.0 + 1e-9):
        message = f"rate is {component.rate:g} Hz; use at most {fastest:g} Hz, one fix a step, or a shorter step"
        building.note(("components", name, "rate"), message)
    if too_fast or collisions:
        return None
    rates = component.rate, component.latency, component.dropout
    return Fixes(name, *rates, signals, step=scenario.step, seed=scenario.seed)


def _fmu(building: Building, name: str, component: FmuComponent) -> FmuBlock | None:
    file, scenario, path = building.file, building.scenario, building.file.resolve(component.fmu)
    if not path.is_file():
        is_built = is_model(BASE) and path.name in model_entry().built
        made = model_entry().name if is_built else ""
        cure = (
            f'; "cosim build --model {made} --out {shell_path(path.parent)}" builds the FMU of {made}' if made else ""
        )
        cure += "" if file.manifest is None else f"; put it there, or into the folder of {file.path.name}"
        building.note(("components", name, "fmu"), f"no such FMU: {path}{cure}")
        return None
    description = building.describe(path)
    variables = {v.name: v for v in description.modelVariables} if component.start else {}
    start = {}
    for variable, value in with_elements(component.start, variables).items():
        try:
            start[variable] = start_value(description, variables, variable, value, name)
        except ValueError as error:
            building.note(("components", name, "start", variable), str(error))
    connected = building.connected.get(name, frozenset())
    if component.interface not in (None, *ways(description)):
        message = f"{path.name} offers {' and '.join(ways(description))} only"
        building.note(("components", name, "interface"), message)
        return None
    inputs = [v for v in description.modelVariables if v.causality == "input"]
    names = {*(v.name for v in inputs), *(element for v in inputs for element in element_names(v))}
    for k, entry in enumerate(component.feedthrough or ()):
        if entry not in names:
            hint = did_you_mean(entry, [v.name for v in inputs])
            message = f'{name} has no input "{entry}"{hint}; feedthrough: must list inputs'
            building.note(("components", name, "feedthrough", k), message)
    # variables to record besides inputs and outputs; for an FMU without outputs, its states, as in FMPy
    recorded = {
        v.name
        for v in description.modelVariables
        if v.causality not in {"input", "output", "independent"}
        and any(matches(pattern, name, v.name) for pattern in scenario.recorded)
    }
    if not any(v.causality == "output" for v in description.modelVariables):
        recorded |= set(state_names(description))
    make = event_block(building, name, component, path)
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
