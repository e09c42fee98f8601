"""A run of a single FMU, with a scenario.yaml written for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.authoring.draft import (
    DraftPart,
    parts_of,
    scenario_text,
    times_of,
    write_sound,
)
from cosim.authoring.matching import Match, Matches, text
from cosim.blocks.compiling import compiling
from cosim.blocks.component import Signal
from cosim.blocks.coupling import DEFAULT
from cosim.blocks.sources import read_recording
from cosim.blocks.summary import experiment_of, read_fmus
from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.messages import Note
from cosim.core.settings import Given, Names, PositiveSeconds, Seconds, normalize_settings
from cosim.core.text import did_you_mean, split_assignment
from cosim.core.times import STEP_COUNT_TOLERANCE, difference
from cosim.core.units import computed_in
from cosim.files.artefact import LOG
from cosim.files.files import FilePath, check_writable
from cosim.files.folders import results_in
from cosim.files.kinds import check_given
from cosim.files.yaml_file import Document, NotYaml, short
from cosim.logs.log import read_column_names
from cosim.simulation.run_signals import Run
from cosim.simulation.workflow import run

MAX_UNDECLARED_STEPS = 1_000_000  # number of steps if the FMU declares no step


def simulate(
    fmu: FilePath,
    out: FilePath | None = None,
    set: Given | None = None,
    *,
    input: FilePath | None = None,
    columns: Given | None = None,
    interpolation: str = "held",
    stop: Seconds | None = None,
    step: PositiveSeconds | None = None,
    record: Names = (),
    report: bool = True,
    force: bool = False,
    in_process: bool = False,
    compile: bool = False,
    format: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Simulate one FMU over its default experiment.

    Args:
        fmu: The FMU.
        out: Folder for scenario.yaml, results.csv, manifest.json and report.html; None writes nothing.
        set: Parameter or input → value, or texts "name=value".
        input: CSV file with time and columns named as inputs.
        columns: Column of `input` → input of the FMU, if their names differ.
        interpolation: Values of `input` between two rows: "held" from a row until the next, or "linear".
        stop: End of the simulation, in seconds or with a unit ("4 min"); by default that of the FMU or of `input`.
        step: Communication step, in seconds or with a unit; by default that of the FMU.
        record: Names or patterns of local variables and parameters to record too.
        report: Write report.html.
        force: Write even if the folder is not empty; results in it are replaced.
        in_process: Load the FMU into this process, for a debugger.
        compile: Compile and execute the sources of an FMU that has no library for this machine.
        format: File format of the rows: "csv", "parquet", "mat", "hdf5", or a format of an installed package.
        progress (in Python): Function of (completed steps, all steps).

    Returns:
        The signals, the manifest and the warnings.

    Raises:
        InputError: The input has faults; the error names all of them.
        FmuError: An FMU cannot be read or loaded.
        SimulationError: The simulation failed; the rows so far are in `out`.
    """
    path = Path(fmu)
    (description,) = read_fmus([path])
    if columns and input is None:
        raise InputError.at(Path("--column"), "renames columns of a file, but no file is given; add --input FILE")
    settings = normalize_settings(set)
    values = settings if isinstance(settings, Mapping) else start_pairs(path, settings, description)
    (part,) = parts_of([path], values)
    with ExitStack() as stack:
        stack.enter_context(compiling(compile))
        place = stack.enter_context(results_in(out, "cosim simulate", part.name, force=force))
        scenario, csv = place / "scenario.yaml", None if input is None else Path(input)
        first, matches, notes = experiment_of(description).get("start"), Matches((), ()), list[str]()
        source, end, usual = path, stop, None
        if csv is not None:
            matches, unused, time = _read_recording(csv, part, read_column_names(columns, csv))
            if unused:
                text_ = f"{csv.name}: {part.name} has no inputs {', '.join(unused)}; these columns are ignored"
                notes.append(Note(text_))
            begin, last = float(time[0]), float(time[-1])
            first = begin if first is None else max(first, begin)
            source, end = csv, last if stop is None else stop
            if first > begin or end - last > STEP_COUNT_TOLERANCE * abs(last):
                text_ = f"{csv.name} covers {begin:g} … {last:g} s, the run {first:g} … {end:g} s"
                kept = f"; after {last:g} s, each input keeps its last value in the file" if end > last else ""
                notes.append(Note(text_ + kept))
            steps = np.diff(time)
            steps = steps[steps > 0.0]  # Equal times mark a jump.
            if steps.size:  # rounded to the digits that the times contain
                far = float(np.max(np.abs(time)))
                usual = difference(far + float(np.median(steps)), far) or float(np.median(steps))
        if end is not None and end <= (first or 0.0):
            reason = f"the end {end:g} s is before the start {first or 0.0:g} s of the run; give a later --stop"
            raise InputError.at(source, reason)
        times = times_of([part], start=first, stop=end, step=step, usual_step=usual, most=MAX_UNDECLARED_STEPS)
        check_writable(place, (scenario.name,), [path, *([csv] if csv else [])])
        text_ = scenario_text(place, [part], matches, times, DEFAULT, played=(csv, interpolation), verb="simulate")
        names = [n if n.startswith(f"{part.name}.") else f"{part.name}.{n}" for n in record]
        with draft_of(scenario) as draft:
            write_sound(draft, text_ + (f"record: {json.dumps(names)}\n" if names else ""), path)
        is_reported = report and out is not None
        made = run(scenario, place, report=is_reported, in_process=in_process, format=format, progress=progress)
    manifest = {**made.manifest, "warnings": [*notes, *times.notes, *made.warnings]}
    return replace(made, manifest=manifest, folder=None if out is None else made.folder)


def _read_recording(path: Path, part: DraftPart, names: Mapping[str, str]) -> tuple[Matches, list[str], Array]:
    """Return the connections from a recording's columns to inputs, the unused columns, and the times [s].

    Args:
        names: Column → input, if their names differ.

    Raises:
        InputError: No column is an input, or a column's input also has a start value.
    """
    check_given(path, LOG)
    inputs = {text(port).partition(".")[2]: port for port in part.inputs}
    refuse(
        Fault(path, 0, 0, f"--column {column}={name}: {part.path.name} has no input {name}{did_you_mean(name, inputs)}")
        for column, name in names.items()
        if name not in inputs
    )
    fed = {name: name for name in inputs if name not in names.values()} | dict(names)
    every = {signal.name: signal.kind for signal in part.block.exact_inputs}
    kinds = {column: every[name] for column, name in fed.items() if name in every}
    log, exact = read_recording(path, fed, kinds)
    columns = [*(column.name for column in log.columns if column.name != "time"), *exact]
    driving = [column for column in columns if column in fed]
    if not driving:
        found = f"its columns: {', '.join(columns) or 'none'}; inputs of {part.name}: {', '.join(inputs) or 'none'}"
        cure = "assign a column with --column COLUMN=INPUT"
        raise InputError([Fault(path, 1, 1, f"no column is an input of {part.path.name} ({found}); {cure}")])
    refuse(
        Fault(
            part.path, 0, 0, f"--set {n}={part.start[n]}: {path.name} already supplies {n}; remove --set, or the column"
        )
        for n in map(fed.__getitem__, driving)
        if n in part.start
    )
    source, connections = "recorded" if part.name != "recorded" else "played", []
    for name in driving:
        signal = Signal(name, kind=kinds[name]) if name in exact else None
        signal = signal or Signal(name, computed_in(log.by_name[name].unit)[0], relative=True)
        connections.append(Match((source, signal), inputs[fed[name]]))
    unused = [*(name for name in columns if name not in driving), *sorted(log.spoiled)]
    return Matches(tuple(connections), ()), unused, log["time"]


def start_pairs(fmu: Path, texts: Sequence[str], description: Any) -> dict[str, Any]:
    """Return start values from NAME=VALUE texts; values of text type are not converted."""
    names = {v.name for v in description.modelVariables}
    words = {v.name for v in description.modelVariables if v.type in {"String", "Binary"}}
    values: dict[str, Any] = {}
    faults = []
    for assignment in texts:
        name, sign, value = split_assignment(assignment, names)
        if not sign or not name:
            message = f'--set "{short(assignment)}" does not have the form NAME=VALUE; for example --set mass=2'
            faults.append(Fault(fmu, 0, 0, message))
            continue
        values[name] = value
        if name not in words:
            with suppress(NotYaml):
                values[name] = Document(value).data
    refuse(faults)
    return values
