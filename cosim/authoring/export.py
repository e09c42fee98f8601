"""Export of a scenario as an SSP for other importing tools; anything SSP cannot express is a fault with remedy."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.scratch import temporary_folder
from cosim.base.units import computed_in, parse
from cosim.blocks.description import enumeration_items, unit_definition, ways
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.profile import Profile, profile_function
from cosim.coupling.algorithms import algorithms
from cosim.fmi.native.signal_source import Change, CompilerFailed, NoCompiler, TimeSignal, build_source
from cosim.scenario.controller_design import designed_values
from cosim.scenario.nearest_models import take_nearest
from cosim.scenario.scenario import Connection, FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import IMPORTERS
from cosim.ssp.structure import Units
from cosim.ssp.write import Model, Port, Value, Whole, write_ssp
from cosim.storage.files import FilePath, named_path
from cosim.storage.table import read_columns
from cosim.system.system import System, build_system
from cosim.system.wiring import taken_for

TYPES = ("Real", "Integer", "Boolean")  # types connected by all importing tools
BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@dataclass(frozen=True)
class Exported:
    """A written SSP, with notes on omitted parts of the scenario."""

    path: Path
    notes: tuple[str, ...]


def export_ssp(
    scenario: FilePath, path: FilePath | None = None, overrides: tuple[str, ...] = (), *, nearest: bool = False
) -> Exported:
    """Write a scenario as an SSP 1.0 without noise; references become FMUs in C.

    Args:
        scenario: Scenario or manifest.json.
        path: SSP file; None writes NAME.ssp into the current folder.
        overrides: Texts "path=value" that replace values of the scenario.
        nearest: Use nearest.yaml instead of model.yaml of every refine folder that the scenario names.

    Returns:
        The path, and notes about parts that SSP cannot hold.

    Raises:
        InputError: Every fault of the scenario, and every part that SSP or its importers cannot hold.
    """
    file = ScenarioFile(Path(scenario), [*overrides, "noise=off"])
    if nearest:
        take_nearest(file)
    check_pinned(file)
    designed = designed_values(file)
    system = build_system(file, designed)
    refuse(_refused(file, system))
    target = _target(file, Path() if path is None else named_path(path))
    with temporary_folder("export") as made:
        models = [
            _source(file, name, component, made)
            if isinstance(component, ReferenceComponent | PlaybackComponent)
            else _model(file, name, _block(system, name))
            for name, component in file.scenario.components.items()
        ]
        s = file.scenario
        stop = s.start_time + s.duration
        ends = [(_split(c.source), _split(c.target)) for c in s.connections]
        whole = Whole(s.name, s.description, models, ends, _units(system, models), s.start_time, stop, s.step)
        write_ssp(target, whole)
    return Exported(target, tuple(_notes(file)))


def _target(file: ScenarioFile, path: Path) -> Path:
    """Return the file to write, named after the scenario in a folder; raise InputError for an input."""
    if path.is_dir():
        path = path / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', file.scenario.name) or 'system'}.ssp"
    if path.suffix.lower() != ".ssp":
        raise InputError([Fault(path, 0, 0, "an SSP is known by its ending; name it so: " + f"{path.stem}.ssp")])
    if path.exists() and any(other.exists() and path.samefile(other) for other in (file.path, *file.files)):
        raise InputError([Fault(path, 0, 0, "is read, and would be written over; give another file as --out")])
    return path


def _split(signal: str) -> tuple[str, str]:
    name, _, variable = signal.partition(".")
    return name, variable


def _block(system: System, name: str) -> FmuBlock:
    block = next(stage.component for stage in system.stages if stage.component.name == name)
    assert isinstance(block, FmuBlock)
    return block


def _notes(file: ScenarioFile) -> Iterator[str]:
    """Yield notes on omissions and differences of importing tools."""
    scenario = file.scenario
    if any(connection.noise for connection in scenario.connections):
        yield "noise is left out: SSP has no word for it"
    given = [c.tolerance for c in scenario.components.values() if isinstance(c, FmuComponent)]
    if any(tolerance is not None for tolerance in (scenario.tolerance, *given)):
        yield "tolerance is left out: importers take that of each FMU's default experiment, or none"
    if scenario.goals:
        yield "criteria are left out: SSP has no word for them"
    if scenario.algorithm != IMPORTERS.name:
        yield (
            f"libcosim, ecos and FMPy step by {IMPORTERS.title}, this scenario by "
            f"{algorithms()[scenario.algorithm].title}: hold them against "
            f"`cosim run --set algorithm={IMPORTERS.name} --set noise=off`"
        )


def _refused(file: ScenarioFile, system: System) -> Iterator[Fault]:
    """Yield faults of anything SSP or its importing tools lack."""
    scenario = file.scenario
    for key in ("faults", "events"):
        if getattr(scenario, key):
            yield file.fault((key,), f"{key} are not what an SSP can hold; take them out, or --set {key}=[]")
    for name, component in scenario.components.items():
        where = ("components", name)
        if isinstance(component, FixComponent):
            yield file.fault((*where, "block"), "fixes are not what an SSP can hold; connect past them")
        if not isinstance(component, FmuComponent):
            continue
        if component.step is not None and component.step != scenario.step:
            cure = f"an SSP has one; give the scenario step {component.step:g}, or leave it out here"
            yield file.fault((*where, "step"), f"a communication step of its own: {cure}")
        description = system.fmus[name][1]
        if description.fmiVersion.startswith("3"):
            yield file.fault((*where, "fmu"), "is FMI 3.0; SSP 1.0 and its importers take FMI 1.0 and 2.0")
        elif (component.interface or ways(description)[0]) != "co-simulation":
            yield file.fault(where, "is run by model exchange; the importers of SSPs run co-simulation")
    for k, connection in zip(file.places["connections"], scenario.connections, strict=True):
        yield from _unfit(file, system, k, connection)


def _unfit(file: ScenarioFile, system: System, k: int, connection: Connection) -> Iterator[Fault]:
    """Yield objections of importing tools to a connection."""
    signals = system.signals
    if connection.source not in signals or connection.target not in signals:
        yield file.fault(("connections", k), "arrays are not what SSP 1.0 can connect; connect their elements")
        return
    source, target = signals[connection.source], signals[connection.target]
    for end, signal in ((connection.source, source), (connection.target, target)):
        if signal.kind not in {"", *TYPES}:
            yield file.fault(("connections", k), f"{end} is {signal.kind}; importers connect {', '.join(TYPES)}")
    if source.kind and target.kind and source.kind != target.kind:
        cure = "importers of SSPs convert no types; give both one type"
        yield file.fault(
            ("connections", k), f"{connection.source} is {source.kind}, {connection.target} {target.kind}: {cure}"
        )
    assumed = taken_for(file, connection, source, target)
    conversion = connection.conversion or source.conversion(target)
    if (conversion if assumed is None else (assumed.factor, assumed.offset)) != (1.0, 0.0):
        what = f"{connection.source} [{source.unit}] to {connection.target} [{target.unit}]"
        cure = "not all importers of SSPs convert; let both ends have one unit, or an FMU between them convert"
        yield file.fault(("connections", k), f"the connection converts: {what}; {cure}")


# -- models ---------------------------------------------------------------------------------------


def _model(file: ScenarioFile, name: str, block: FmuBlock) -> Model:
    """Return an FMU's outputs, connected inputs, changed start values."""
    fed = {c.target for c in file.scenario.connections}
    ports = [Port(s.name, "input", s.kind, s.unit) for s in block.inputs if f"{name}.{s.name}" in fed]
    ports += [Port(s.name, "output", s.kind, s.unit) for s in block.outputs if s.kind in TYPES and not s.local]
    variables = {v.name: v for v in block.description.modelVariables}
    start: dict[str, tuple[str, Value]] = {}
    for variable, value in block.start_values.items():
        if not _own(variables[variable], value):
            start[variable] = _typed(variables[variable], value)
    return Model(name, block.path, ports, start)


def _own(variable: Any, value: Any) -> bool:
    """Return whether a start value equals the FMU's own."""
    if variable.start is None or variable.type == "Enumeration":
        return False
    if variable.type == "String":
        return bool(variable.start == value)
    if variable.type == "Boolean":
        return (str(variable.start) in {"true", "1", "True"}) == bool(value)
    return float(variable.start) == float(value)


def _typed(variable: Any, value: Any) -> tuple[str, Value]:
    """Return SSP's type and value; an enumeration's item by name."""
    if variable.type == "Enumeration":
        items = {number: name for name, number in enumeration_items(variable).items()}
        return "Enumeration", items.get(value, str(value))
    return variable.type, value


def _source(file: ScenarioFile, name: str, component: ReferenceComponent | PlaybackComponent, folder: Path) -> Model:
    """Return a reference or recording as a C FMU."""
    if isinstance(component, ReferenceComponent):
        signals = {signal: _profile(profile) for signal, profile in component.signals.items()}
    else:
        used = {s.partition(".")[2] for c in file.scenario.connections if (s := c.source).startswith(f"{name}.")}
        signals = _recorded(file.resolve(component.file), used)
    try:
        fmu = build_source(name, signals, folder / f"{name}.fmu", file.scenario.step, file.scenario.duration)
    except (NoCompiler, CompilerFailed) as error:
        message = f"becomes an FMU of C, which cannot be compiled: {error}"
        raise InputError([file.fault(("components", name), message)]) from None
    return Model(name, fmu, [Port(n, "output", "Real", s.unit) for n, s in signals.items()])


def _profile(profile: Profile) -> TimeSignal:
    """Return a profile's changes, each from the value reached before. Degrees become radians."""
    unit, factor = computed_in(profile.unit)
    changes = []
    for k, change in enumerate(profile.changes):
        before = profile_function(profile.model_copy(update={"changes": profile.changes[:k]}))(change.at)
        changes.append(Change(change.at, factor * before, factor * change.to, abs(factor) * (change.rate or 0.0)))
    return TimeSignal(unit, factor * profile.start, changes)


def _recorded(path: Path, names: set[str]) -> dict[str, TimeSignal]:
    """Return used columns of a recording, held between rows."""
    table = read_columns(path, names)
    times = table.values["time"]
    signals = {}
    for column in (c for c in table.columns.values() if c.name in names):
        unit, factor = computed_in(column.heading.unit)
        values = [factor * v for v in table.values[column.name]]
        changes = [Change(t, v, v) for t, v in zip(times, values, strict=True) if math.isfinite(v)]
        signals[column.name] = TimeSignal(unit, values[0], changes)
    return signals


def _units(system: System, models: list[Model]) -> Units:
    """Return SI definitions of the connectors' units."""
    found: dict[str, tuple[float, ...]] = {}
    for model in models:
        description = system.fmus[model.name][1] if model.name in system.fmus else None
        for port in model.ports:
            definition = None if description is None else unit_definition(description, port.unit)
            if definition is None and (unit := parse(port.unit)) is not None:
                definition = (*(float(unit.exponents.get(n, 0)) for n in BASE), unit.factor, unit.offset)
            if port.unit and definition is not None:
                found.setdefault(port.unit, definition)
    return found
