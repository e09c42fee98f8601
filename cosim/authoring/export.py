"""Export of a scenario as an SSP for other tools. Parts that SSP cannot store are faults, reported with a cure."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.blocks.coupling import algorithms
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.profile import ProfileFunction
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.messages import Note
from cosim.core.scratch import temporary_folder
from cosim.core.settings import Names
from cosim.core.text import join_names
from cosim.core.units import computed_in
from cosim.files.files import FilePath, named_path
from cosim.files.table import read_columns
from cosim.fmi.description import enumeration_items, ways
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler
from cosim.fmi.native.signal_source import SignalChange, TimeSignal, build_gain, build_source
from cosim.scenario.scenario import FixComponent, FmuComponent, PlaybackComponent, ReferenceComponent
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import check_pinned
from cosim.simulation.packaged import ALGORITHM_OF_IMPORTERS
from cosim.ssp.write import SspConnector, SspFmu, Value, defined_units, write_ssp
from cosim.system.system import System, build_system

NO_CONVERSION = (1.0, 0.0)  # factor and offset
PORTABLE_TYPES = ("Real", "Integer", "Boolean")  # types connected by all importing tools


@dataclass(frozen=True)
class Exported:
    """A written SSP, with notes on parts of the scenario that were not exported."""

    path: Path
    notes: tuple[str, ...]


def export_ssp(
    scenario: FilePath,
    path: FilePath | None = None,
    overrides: Names = (),
    *,
    insert_gains: bool = False,
) -> Exported:
    """Write a scenario as an SSP 1.0 without noise; reference components become FMUs in C.

    Args:
        scenario: Scenario or manifest.json.
        path: SSP file; None writes NAME.ssp into the current folder.
        overrides: Texts "path=value" that replace values of the scenario.
        insert_gains: Insert a small FMU in C into each connection with a conversion, for importers that ignore linear
            transformations. Each delays its value by one step.

    Returns:
        The path, and notes on parts that SSP cannot store.

    Raises:
        InputError: The scenario has faults, or an essential part that SSP or its importers do not support; the error
            names all.
    """
    file = ScenarioFile(Path(scenario), [*overrides, "noise=off"])
    check_pinned(file)
    system, s = build_system(file), file.scenario
    refuse(_faults(file, system))
    target = Path() if path is None else named_path(path)
    if target.is_dir():
        target = target / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', s.name) or 'system'}.ssp"
    if target.suffix.lower() != ".ssp":
        raise InputError.at(target, f"an SSP needs the ending .ssp; use {target.with_suffix('.ssp').name}")
    if target.exists() and any(other.exists() and target.samefile(other) for other in (file.path, *file.files)):
        raise InputError.at(target, "is an input and would be overwritten; give another file as --out")
    with temporary_folder("export") as folder:
        models = [
            _source(file, name, component, folder)
            if isinstance(component, ReferenceComponent | PlaybackComponent)
            else _model(file, name, system)
            for name, component in s.components.items()
        ]
        ends = list[tuple[tuple[str, str], tuple[str, str], tuple[float, float]]]()
        converted, conversions = list[str](), {t.name: (t.factor, t.offset) for t in system.transfers}
        for c in s.connections:
            source, output, component, input_ = c.ends
            first, last, linear = (source, output), (component, input_), conversions[c.target]
            if linear != NO_CONVERSION:
                converted.append(c.target)
            if linear != NO_CONVERSION and insert_gains:
                gain = f"gain_{component}_{input_}"
                units_of_ends = system.signals[c.source].unit, system.signals[c.target].unit
                models.append(_gain(file, gain, linear, units_of_ends, folder))
                ends.append((first, (gain, "u"), NO_CONVERSION))
                first, linear = (gain, "y"), NO_CONVERSION
            ends.append((first, last, linear))
        descriptions = {name: description for name, (_, description) in system.fmus.items()}
        units = defined_units((descriptions.get(m.name), port.unit) for m in models for port in m.ports)
        times = s.start_time, s.start_time + s.duration, s.step
        write_ssp(target, models, ends, units, times, name=s.name, description=s.description)
    return Exported(target, tuple(_notes(file, () if insert_gains else converted)))


def _notes(file: ScenarioFile, converted: Sequence[str]) -> Iterator[str]:
    """Yield notes on parts missing in the SSP, and on features that importing tools lack.

    Args:
        converted: Inputs of connections with a linear transformation.
    """
    scenario = file.scenario
    if converted:
        text = f"the values of {join_names(converted)} are converted by linear transformations of SSP: libcosim and "
        yield Note(f"{text}cosim apply them, FMPy and ecos ignore them. --insert-gains replaces them by small FMUs")
    if any(connection.noise for connection in scenario.connections):
        yield Note("noise was not exported: SSP cannot store it")
    tolerances = [c.tolerance for c in scenario.components.values() if isinstance(c, FmuComponent)]
    if any(tolerance is not None for tolerance in (scenario.tolerance, *tolerances)):
        yield Note("tolerance was not exported: importers use the tolerance of each FMU's default experiment, or none")
    if scenario.every_goal:
        yield Note("criteria were not exported: SSP cannot store them")
    if scenario.algorithm != ALGORITHM_OF_IMPORTERS.name:
        ours = algorithms()[scenario.algorithm].title
        yield Note(
            f"libcosim, ecos and FMPy use {ALGORITHM_OF_IMPORTERS.title} coupling, this scenario {ours}, so their "
            "results may differ; compare them with "
            f"`cosim run --set algorithm={ALGORITHM_OF_IMPORTERS.name} --set noise=off`"
        )


def _faults(file: ScenarioFile, system: System) -> Iterator[Fault]:
    """Yield a fault for each part of a scenario that SSP or importing tools do not support."""
    scenario, signals = file.scenario, system.signals
    for key in ("faults", "events"):
        if getattr(scenario, key):
            yield file.fault((key,), f"{key} cannot be exported, because SSP cannot store them; add --set {key}=[]")
    for name, component in scenario.components.items():
        where = ("components", name)
        if isinstance(component, FixComponent):
            yield file.fault((*where, "block"), "fixes cannot be exported, because SSP cannot store them")
        if not isinstance(component, FmuComponent):
            continue
        if component.step is not None and component.step != scenario.step:
            text = "this component has its own step, but an SSP has one step for all"
            yield file.fault(
                (*where, "step"), f"{text}; remove it, and set the step of the scenario to {component.step:g}"
            )
        description = system.fmus[name][1]
        if description.fmiVersion.startswith("3"):
            yield file.fault((*where, "fmu"), "is FMI 3.0; SSP 1.0 and its importers support FMI 1.0 and 2.0")
        elif (component.interface or ways(description)[0]) != "co-simulation":
            yield file.fault(where, "uses model exchange; importers of SSPs support co-simulation only")
    for k, connection in zip(file.places["connections"], scenario.connections, strict=True):
        ends = [signals.get(end) for end in (connection.source, connection.target)]
        kinds = [signal.kind for signal in ends if signal is not None]
        if None in ends:
            yield file.fault(("connections", k), "SSP 1.0 cannot connect arrays; connect their elements")
        elif not {*kinds} <= {"", *PORTABLE_TYPES} or len({*kinds} - {""}) > 1:
            text = f"connects {' to '.join(kinds)}; importers connect equal types, of {', '.join(PORTABLE_TYPES)}"
            yield file.fault(("connections", k), text)


# -- models ---------------------------------------------------------------------------------------


def _model(file: ScenarioFile, name: str, system: System) -> SspFmu:
    """Return an FMU for the SSP, with its outputs, connected inputs and start values."""
    block = next(stage.component for stage in system.stages if stage.component.name == name)
    assert isinstance(block, FmuBlock)
    targets = {c.target for c in file.scenario.connections}
    ports = [SspConnector(s.name, "input", s.kind, s.unit) for s in block.inputs if f"{name}.{s.name}" in targets]
    ports += [
        SspConnector(s.name, "output", s.kind, s.unit)
        for s in block.outputs
        if s.kind in PORTABLE_TYPES and not s.local
    ]
    variables = {v.name: v for v in block.description.modelVariables}
    start: dict[str, tuple[str, Value]] = {}
    for n, value in block.start_values.items():
        v = variables[n]
        items = {number: item for item, number in enumeration_items(v).items()} if v.type == "Enumeration" else {}
        start[n] = v.type, items.get(value, str(value)) if v.type == "Enumeration" else value
    return SspFmu(name, block.path, ports, start)


def _source(file: ScenarioFile, name: str, component: ReferenceComponent | PlaybackComponent, folder: Path) -> SspFmu:
    """Return a reference or recording as a C FMU."""
    signals: dict[str, TimeSignal] = {}
    if isinstance(component, ReferenceComponent):
        for signal, profile in component.signals.items():  # as steps and ramps
            unit, factor = computed_in(profile.unit)
            changes = []
            for k, change in enumerate(profile.changes):
                before = ProfileFunction(profile.model_copy(update={"changes": profile.changes[:k]}))(change.at)
                rate = abs(factor) * (change.rate or 0.0)
                changes.append(SignalChange(change.at, factor * before, factor * change.to, rate))
            signals[signal] = TimeSignal(unit, factor * profile.start, changes)
    else:
        columns = {output for owner, output, _, _ in (c.ends for c in file.scenario.connections) if owner == name}
        table, is_linear = read_columns(file.resolve(component.file), columns), component.interpolation == "linear"
        for column in (c for c in table.columns if c.name in columns):
            unit, factor = computed_in(column.unit)
            values = [factor * v for v in table[column.name].tolist()]
            rows = [(t, v) for t, v in zip(table["time"].tolist(), values, strict=True) if math.isfinite(v)]
            changes = [SignalChange(t, v, v) for t, v in rows]
            for k, ((t, v), (after, to)) in enumerate(itertools.pairwise(rows)):
                if is_linear and after > t and to != v:
                    changes[k] = SignalChange(t, v, to, abs(to - v) / (after - t))
            signals[column.name] = TimeSignal(unit, values[0], changes)
    try:
        fmu = build_source(name, signals, folder / f"{name}.fmu", file.scenario.step, file.scenario.duration)
    except (NoCompiler, CompilerFailed) as error:
        raise InputError(
            [file.fault(("components", name), f"cannot be exported, because its FMU in C does not compile: {error}")]
        ) from None
    return SspFmu(name, fmu, [SspConnector(n, "output", "Real", s.unit) for n, s in signals.items()])


def _gain(file: ScenarioFile, name: str, linear: tuple[float, float], units: tuple[str, str], folder: Path) -> SspFmu:
    """Return a linear conversion as an FMU in C."""
    try:
        fmu = build_gain(name, linear, units, folder / f"{name}.fmu", file.scenario.step)
    except (NoCompiler, CompilerFailed) as error:
        raise InputError(
            [file.fault(("connections",), f"the FMU of a gain does not compile: {error}; omit --insert-gains")]
        ) from None
    ports = zip(("u", "y"), ("input", "output"), units, strict=True)
    return SspFmu(name, fmu, [SspConnector(port, kind, "Real", unit) for port, kind, unit in ports])
