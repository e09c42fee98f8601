"""A first scenario of FMUs: times from their default experiments, connections by name and unit."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.authoring.draft_text import scenario_text
from cosim.authoring.matching import Match, Matches, Port, match_ports, text
from cosim.authoring.parts import SLACK, STEPS, STOP, DraftPart, RequestedTimes, parts_of, times_of
from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.messages import Note
from cosim.base.times import difference
from cosim.base.units import computed_in
from cosim.blocks.component import Signal
from cosim.blocks.coupling import DEFAULT, WITHOUT_ORDER, AlgebraicLoop, Algorithm
from cosim.blocks.description import no_library, platform_of
from cosim.blocks.sources import read_recording
from cosim.blocks.summary import experiment_of, platforms_of
from cosim.scenario.scenario_file import ScenarioFile
from cosim.storage.files import check_writable
from cosim.storage.kinds import LOG, check_given
from cosim.system.system import System, build_system

MAX_SINGLE_STEPS = 1_000_000  # steps of a single FMU's run, requested by its own times
MAX_PORTS = 6  # inputs and outputs in a message


@dataclass(frozen=True)
class Draft:
    """Connections, coupling algorithm and warnings of a first scenario."""

    matches: Matches
    algorithm: str
    warnings: tuple[str, ...]


def write_single(
    folder: Path,
    fmu: Path,
    start: Mapping[str, Any],
    recorded: Path | None = None,
    *,
    stop: float | None = None,
    step: float | None = None,
    record: Sequence[str] = (),
    interpolation: str = "held",
) -> tuple[Path, tuple[str, ...]]:
    """Write scenario.yaml for a run of one FMU.

    Args:
        recorded: CSV whose columns drive the inputs of the same names.
        stop: Stop time [s], like `step` in place of the default experiment's.
        record: Further variables to record.
        interpolation: Values of `recorded` between two rows: held or linear.

    Returns:
        The path and warnings.

    Raises:
        InputError: The FMU or its settings are faulty, no column is an input.
    """
    (part,) = parts_of([fmu], start)
    path = folder / "scenario.yaml"
    recording = _read_recording(recorded, part) if recorded is not None else None
    request, notes = _choose_times(part, recording, stop, step)
    times = times_of([part], request, most=MAX_SINGLE_STEPS)
    inputs = [fmu, *([recorded] if recorded else [])]
    check_writable(folder, (path.name,), inputs)
    matches = recording.matches if recording else Matches((), ())
    lines = scenario_text(folder, [part], matches, times, DEFAULT, played=(recorded, interpolation), verb="simulate")
    names = [n if n.startswith(f"{part.name}.") else f"{part.name}.{n}" for n in record]
    lines += f"record: {json.dumps(names)}\n" if names else ""
    with draft_of(path) as draft:
        _write_sound(draft, lines, fmu)
    return path, (*notes, *times.notes)


def _choose_times(
    part: DraftPart, recording: DraftRecording | None, stop: float | None, step: float | None
) -> tuple[RequestedTimes, tuple[str, ...]]:
    """Return the times of a run, by default those of the recording or of the FMU, and notes."""
    declared = experiment_of(part.description).get("start")
    if recording is None:
        _check_end(part.path, declared, stop)
        return RequestedTimes(declared, stop, step), ()
    name, first, last = recording.path.name, recording.start, recording.end
    notes = list(recording.notes)
    start = first if declared is None else max(declared, first)
    end = last if stop is None else stop
    if start > first:
        notes.append(Note(f"{name}: begins at {first:g} s, the run at {start:g} s as {part.name} says"))
    elif start > (declared or 0.0):
        notes.append(Note(f"the run begins at {start:g} s, where {name} does"))
    _check_end(recording.path, start, end)
    if end > last * (1 + SLACK):
        notes.append(Note(f"{name}: ends at {last:g} s; its last row is held until {end:g} s"))
    because = f"the end of {name}" if stop is None else "given"
    why_start = f"{name} begins" if start == first else ""
    return RequestedTimes(start, end, step, recording.step, because, why_start), tuple(notes)


def _check_end(source: Path, start: float | None, end: float | None) -> None:
    if end is not None and end <= (start or 0.0):
        raise InputError.at(source, f"ends at {end:g} s, the run begins at {start or 0.0:g} s; give a later --stop")


@dataclass(frozen=True)
class DraftRecording:
    """A recording that drives the inputs of an FMU.

    It has a start, an end and a step [s], the connections of its columns to inputs, and notes on unused columns.
    """

    path: Path
    start: float
    end: float
    step: float
    matches: Matches
    notes: tuple[str, ...]


def _read_recording(path: Path, part: DraftPart) -> DraftRecording:
    check_given(path, LOG)
    inputs = {text(port).partition(".")[2]: port for port in part.ports[0]}
    kinds = {signal.name: signal.kind for signal in part.block.exact_inputs}
    log, exact = read_recording(path, inputs, kinds)
    names = [*(column.name for column in log.columns if column.name != "time"), *exact]
    driving = _driving_columns(path, part, names, inputs)
    source = "recorded" if part.name != "recorded" else "played"
    signals = [
        Signal(name, kind=kinds[name])
        if name in exact
        else Signal(name, computed_in(log.by_name[name].unit)[0], relative=True)
        for name in driving
    ]
    connections = tuple(Match((source, signal), inputs[signal.name]) for signal in signals)
    unused = ", ".join([*(name for name in names if name not in driving), *sorted(log.spoiled)])
    notes = (Note(f"{path.name}: {part.name} has no inputs {unused}: they drive nothing"),) if unused else ()
    time = log["time"]
    steps = np.diff(time)
    steps = steps[steps > 0.0]  # Equal times are a jump.
    usual_step = STOP / STEPS
    if steps.size:  # without the digits that the times do not hold
        last = float(np.max(np.abs(time)))
        usual_step = difference(last + float(np.median(steps)), last) or float(np.median(steps))
    usual_step = float(f"{usual_step:.6g}")
    return DraftRecording(path, float(time[0]), float(time[-1]), usual_step, Matches(connections, ()), notes)


def _driving_columns(path: Path, part: DraftPart, columns: Sequence[str], inputs: Collection[str]) -> list[str]:
    """Return the columns that are inputs; raise InputError without any, or if one has a start value."""
    driving = [name for name in columns if name in inputs]
    if not driving:
        names = {"columns": ", ".join(columns) or "none", "inputs": ", ".join(inputs) or "none"}
        message = (
            "no column is an input of {fmu} (its columns: {columns}; inputs of {component}: {inputs}); rename a column"
        ).format(fmu=part.path.name, component=part.name, **names)
        raise InputError([Fault(path, 1, 1, message)])
    values = {name: part.start[name] for name in driving if name in part.start}
    refuse(
        Fault(part.path, 0, 0, f"--set {name}={value}: {path.name} plays it; leave out --set, or the column")
        for name, value in values.items()
    )
    return driving


def write_draft(path: Path, fmus: Sequence[Path]) -> Draft:
    """Write a commented scenario of FMUs, with guesses marked.

    Connections are by name and unit. An existing file is never overwritten.

    Raises:
        InputError: An FMU is faulty, no output fits an input, or `path` exists.
    """
    if path.is_dir():
        raise InputError.at(path, "is a folder; name the file to write as --out")
    if path.exists():
        raise InputError.at(
            path, "is there already; it is never written over; give another name as --out, or move it away"
        )
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError.at(path, "a scenario is YAML; name a .yaml or .yml file as --out")
    if not path.parent.is_dir():
        raise InputError.at(path.parent, "no such folder; make it first")
    parts = parts_of(fmus)
    inputs, outputs = ([p for part in parts for p in part.ports[side]] for side in (0, 1))
    sizes = {name: size for part in parts for name, size in part.sizes.items()}
    matches = _drop_loops(parts, match_ports(outputs, inputs, sizes))
    if len(parts) > 1 and not matches.any_candidate:
        raise InputError.at(fmus[0], _no_fit(fmus, inputs, outputs, sizes))
    times = times_of(parts)
    algorithm = _algorithm(parts, matches.connections)
    with draft_of(path) as draft:
        system = _write_sound(draft, scenario_text(path.parent, parts, matches, times, algorithm), parts[0].path)
    warnings = []
    for part in parts:
        here, there = platform_of(part.description), platforms_of(part.path)
        if here not in there:
            warnings.append(f"{part.name} does not run on this machine: {no_library(here, there)}")
    return Draft(matches, algorithm.name, (*warnings, *times.notes, *system.warnings))


def _write_sound(path: Path, lines: str, fmu: Path) -> System:
    """Write a scenario and return its system.

    If the scenario has faults, InputError names the FMU as their place, because the user has not written the scenario.
    """
    path.write_text(lines, encoding="utf-8")
    try:
        return build_system(ScenarioFile(path))
    except InputError as error:
        raise InputError([Fault(fmu, 0, 0, f.message, f.exit_code) for f in error.faults]) from None


def _drop_loops(parts: Sequence[DraftPart], matches: Matches) -> Matches:
    """Return the matches without guessed connections in algebraic loops."""
    every = matches.connections
    connections = [m for m in every if not m.guess]
    if _algorithm(parts, connections) is not DEFAULT:
        return matches
    for guess in (m for m in every if m.guess):
        connections += [guess] if _algorithm(parts, [*connections, guess]) is DEFAULT else []
    dropped = tuple((m.target, (text(m.source), *m.others)) for m in every if m not in connections)
    return Matches(tuple(m for m in every if m in connections), (*matches.unconnected, *dropped), matches.choices)


def _algorithm(parts: Sequence[DraftPart], matches: Sequence[Match]) -> Algorithm:
    """Return the default coupling algorithm; with an algebraic loop, the algorithm without stepping order."""
    blocks = {part.name: part.block for part in parts}
    edges = [(m.source[0], m.target[0], m.target[1].name, m.source[1].name) for m in matches]
    try:
        DEFAULT.plan(blocks, edges, None)
    except AlgebraicLoop:
        return WITHOUT_ORDER
    return DEFAULT


def _no_fit(fmus: Sequence[Path], inputs: Sequence[Port], outputs: Sequence[Port], sizes: Mapping[str, int]) -> str:
    names = " and ".join(p.name for p in fmus)
    if not outputs or not inputs:
        return (
            f"{names} cannot be connected: they have no {'inputs' if outputs else 'outputs'}; run each alone by "
            "`cosim simulate`"
        )

    def describe(port: Port) -> str:
        size = sizes.get(text(port))
        return f"{text(port)} [{port[1].unit or port[1].kind}{f', {size} elements' if size else ''}]"

    fields = {"fmus": names}
    for side, ports in (("outputs", outputs), ("inputs", inputs)):
        fields[side] = ", ".join(map(describe, ports[:MAX_PORTS]))
    element = next((f"{port[0]}.{port[1].name}" for port in (*inputs, *outputs) if text(port) in sizes), None)
    return (
        (
            "{fmus} cannot be connected: no output ({outputs}) fits an input of another ({inputs}) by type, unit "
            "and number of elements; a scenario may connect elements of an array one by one, as {element}"
        ).format(**fields, element=element)
        if element
        else (
            "{fmus} cannot be connected: no output ({outputs}) fits an input of another ({inputs}) by type and unit"
        ).format(**fields)
    )
