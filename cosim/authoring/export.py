"""Export of a scenario as an SSP for other importing tools; anything SSP cannot express is a fault with remedy."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.messages import Note
from cosim.base.scratch import temporary_folder
from cosim.base.settings import Names
from cosim.base.units import computed_in
from cosim.blocks.coupling import algorithms
from cosim.blocks.description import enumeration_items, ways
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.profile import Profile, ProfileFunction
from cosim.fmi.native.signal_source import CompilerFailed, NoCompiler, SignalChange, TimeSignal, build_source
from cosim.scenario.scenario import Connection, FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent
from cosim.scenario.scenario_file import ScenarioFile, take_nearest
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import IMPORTERS
from cosim.ssp.write import SspConnector, SspFmu, Value, Whole, defined_units, write_ssp
from cosim.storage.files import FilePath, named_path
from cosim.storage.table import read_columns
from cosim.system.system import System, build_system
from cosim.system.wiring import assumed_conversion

TYPES = ("Real", "Integer", "Boolean")  # types connected by all importing tools


@dataclass(frozen=True)
class Exported:
    """A written SSP, with notes on omitted parts of the scenario."""

    path: Path
    notes: tuple[str, ...]


def export_ssp(
    scenario: FilePath, path: FilePath | None = None, overrides: Names = (), *, nearest: bool = False
) -> Exported:
    """Write a scenario as an SSP 1.0 without noise; reference components become FMUs in C.

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
    system = build_system(file)
    refuse(_faults(file, system))
    target = _target(file, Path() if path is None else named_path(path))
    with temporary_folder("export") as folder:
        models = [
            _source(file, name, component, folder)
            if isinstance(component, ReferenceComponent | PlaybackComponent)
            else _model(file, name, system)
            for name, component in file.scenario.components.items()
        ]
        s = file.scenario
        stop = s.start_time + s.duration
        ends = [(_split(c.source), _split(c.target)) for c in s.connections]
        whole = Whole(
            s.name,
            s.description,
            models,
            ends,
            defined_units((_description(system, m.name), port.unit) for m in models for port in m.ports),
            s.start_time,
            stop,
            s.step,
        )
        write_ssp(target, whole)
    return Exported(target, tuple(_notes(file)))


def _target(file: ScenarioFile, path: Path) -> Path:
    """Return the SSP file to write, in a folder with the scenario's name; raise InputError for an unsuitable path."""
    if path.is_dir():
        path = path / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', file.scenario.name) or 'system'}.ssp"
    if path.suffix.lower() != ".ssp":
        raise InputError.at(path, f"an SSP is known by its ending; name it so: {path.with_suffix('.ssp').name}")
    if path.exists() and any(other.exists() and path.samefile(other) for other in (file.path, *file.files)):
        raise InputError.at(path, "is read, and would be written over; give another file as --out")
    return path


def _split(signal: str) -> tuple[str, str]:
    name, _, variable = signal.partition(".")
    return name, variable


def _notes(file: ScenarioFile) -> Iterator[str]:
    """Yield notes on parts missing in the SSP, and on a coupling algorithm that importing tools lack."""
    scenario = file.scenario
    if any(connection.noise for connection in scenario.connections):
        yield Note("noise is left out: SSP has no word for it")
    tolerances = [c.tolerance for c in scenario.components.values() if isinstance(c, FmuComponent)]
    if any(tolerance is not None for tolerance in (scenario.tolerance, *tolerances)):
        yield Note("tolerance is left out: importers take that of each FMU's default experiment, or none")
    if scenario.goals:
        yield Note("criteria are left out: SSP has no word for them")
    if scenario.algorithm != IMPORTERS.name:
        ours = algorithms()[scenario.algorithm].title
        yield Note(
            f"libcosim, ecos and FMPy step by {IMPORTERS.title}, this scenario by {ours}, so their results may "
            f"differ; compare theirs with `cosim run --set algorithm={IMPORTERS.name} --set noise=off`"
        )


def _faults(file: ScenarioFile, system: System) -> Iterator[Fault]:
    """Yield a fault for each part of a scenario that SSP or importing tools cannot hold."""
    scenario = file.scenario
    for key in ("faults", "events"):
        if getattr(scenario, key):
            yield file.fault(
                (key,), f"{key} cannot be exported, as SSP has no place for them; remove them, or add --set {key}=[]"
            )
    for name, component in scenario.components.items():
        where = ("components", name)
        if isinstance(component, FixComponent):
            yield file.fault(
                (*where, "block"),
                "fixes cannot be exported, as SSP has no place for them; connect the signals without this block",
            )
        if not isinstance(component, FmuComponent):
            continue
        if component.step is not None and component.step != scenario.step:
            yield file.fault(
                (*where, "step"),
                (
                    f"a communication step of its own: an SSP has one; give the scenario step {component.step:g}, or "
                    "leave it out here"
                ),
            )
        description = system.fmus[name][1]
        if description.fmiVersion.startswith("3"):
            yield file.fault((*where, "fmu"), "is FMI 3.0; SSP 1.0 and its importers take FMI 1.0 and 2.0")
        elif (component.interface or ways(description)[0]) != "co-simulation":
            yield file.fault(where, "is run by model exchange; the importers of SSPs run co-simulation")
    for k, connection in zip(file.places["connections"], scenario.connections, strict=True):
        for message in _objections(file, system, connection):
            yield file.fault(("connections", k), message)


def _objections(file: ScenarioFile, system: System, connection: Connection) -> Iterator[str]:
    """Yield reasons why importing tools cannot hold a connection."""
    signals = system.signals
    if connection.source not in signals or connection.target not in signals:
        yield "arrays are not what SSP 1.0 can connect; connect their elements"
        return
    source, target = signals[connection.source], signals[connection.target]
    for end, signal in ((connection.source, source), (connection.target, target)):
        if signal.kind not in {"", *TYPES}:
            yield f"{end} is {signal.kind}; importers connect {', '.join(TYPES)}"
    names = {"source": connection.source, "target": connection.target}
    if source.kind and target.kind and source.kind != target.kind:
        yield (
            "{source} is {source_type}, {target} {target_type}: importers of SSPs convert no types; give both one type"
        ).format(**names, source_type=source.kind, target_type=target.kind)
    assumed = assumed_conversion(file, connection, source, target)
    conversion = connection.conversion or source.conversion(target)
    if (conversion if assumed is None else (assumed.factor, assumed.offset)) != (1.0, 0.0):
        yield (
            "the connection converts: {source} [{source_unit}] to {target} [{target_unit}]; not all importers "
            "of SSPs convert; let both ends have one unit, or an FMU between them convert"
        ).format(**names, source_unit=source.unit, target_unit=target.unit)


# -- models ---------------------------------------------------------------------------------------


def _model(file: ScenarioFile, name: str, system: System) -> SspFmu:
    """Return an FMU for the SSP, with its outputs, connected inputs and changed start values."""
    block = next(stage.component for stage in system.stages if stage.component.name == name)
    assert isinstance(block, FmuBlock)
    targets = {c.target for c in file.scenario.connections}
    ports = [SspConnector(s.name, "input", s.kind, s.unit) for s in block.inputs if f"{name}.{s.name}" in targets]
    ports += [SspConnector(s.name, "output", s.kind, s.unit) for s in block.outputs if s.kind in TYPES and not s.local]
    variables = {v.name: v for v in block.description.modelVariables}
    values = {n: (variables[n], value) for n, value in block.start_values.items()}
    start = {n: _convert_value(*value) for n, value in values.items() if not _is_default(*value)}
    return SspFmu(name, block.path, ports, start)


def _is_default(variable: Any, value: Any) -> bool:
    """Return whether a start value equals the FMU's own start value, so that it need not be exported."""
    if variable.start is None or variable.type == "Enumeration":
        return False
    if variable.type == "String":
        return bool(variable.start == value)
    if variable.type == "Boolean":
        return (str(variable.start) in {"true", "1", "True"}) == bool(value)
    return float(variable.start) == float(value)


def _convert_value(variable: Any, value: Any) -> tuple[str, Value]:
    """Return the SSP type and the value of a variable; items of enumerations become names."""
    if variable.type == "Enumeration":
        items = {number: name for name, number in enumeration_items(variable).items()}
        return "Enumeration", items.get(value, str(value))
    return variable.type, value


def _source(file: ScenarioFile, name: str, component: ReferenceComponent | PlaybackComponent, folder: Path) -> SspFmu:
    """Return a reference or recording as a C FMU."""
    if isinstance(component, ReferenceComponent):
        signals = {signal: _profile(profile) for signal, profile in component.signals.items()}
    else:
        columns = {s.partition(".")[2] for c in file.scenario.connections if (s := c.source).startswith(f"{name}.")}
        signals = _recording_signals(
            file.resolve(component.file), columns, is_linear=component.interpolation == "linear"
        )
    try:
        fmu = build_source(name, signals, folder / f"{name}.fmu", file.scenario.step, file.scenario.duration)
    except (NoCompiler, CompilerFailed) as error:
        raise InputError(
            [file.fault(("components", name), f"becomes an FMU of C, which cannot be compiled: {error}")]
        ) from None
    return SspFmu(name, fmu, [SspConnector(n, "output", "Real", s.unit) for n, s in signals.items()])


def _profile(profile: Profile) -> TimeSignal:
    """Return a reference profile as steps and ramps [rad]."""
    unit, factor = computed_in(profile.unit)
    changes = []
    for k, change in enumerate(profile.changes):
        before = ProfileFunction(profile.model_copy(update={"changes": profile.changes[:k]}))(change.at)
        changes.append(SignalChange(change.at, factor * before, factor * change.to, abs(factor) * (change.rate or 0.0)))
    return TimeSignal(unit, factor * profile.start, changes)


def _recording_signals(path: Path, names: set[str], *, is_linear: bool) -> dict[str, TimeSignal]:
    """Return columns of a recording, held or linear between rows."""
    table = read_columns(path, names)
    times = table["time"].tolist()
    signals = {}
    for column in (c for c in table.columns if c.name in names):
        unit, factor = computed_in(column.unit)
        values = [factor * v for v in table[column.name].tolist()]
        rows = [(t, v) for t, v in zip(times, values, strict=True) if math.isfinite(v)]
        changes = [SignalChange(t, v, v) for t, v in rows]
        for k, ((t, v), (after, to)) in enumerate(itertools.pairwise(rows)):
            if is_linear and after > t and to != v:
                changes[k] = SignalChange(t, v, to, abs(to - v) / (after - t))
        signals[column.name] = TimeSignal(unit, values[0], changes)
    return signals


def _description(system: System, name: str) -> Any:
    """Return the model description of a component; None for a source in C."""
    return system.fmus[name][1] if name in system.fmus else None
