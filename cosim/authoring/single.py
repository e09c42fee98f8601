"""A run of a single FMU, with a scenario.yaml written for it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cosim.authoring.draft_text import scenario_text, write_sound
from cosim.authoring.matching import Match, Matches, text
from cosim.authoring.parts import SLACK, STEPS, STOP, DraftPart, parts_of, times_of
from cosim.blocks.component import Signal
from cosim.blocks.coupling import DEFAULT
from cosim.blocks.sources import read_recording
from cosim.blocks.summary import experiment_of, read_fmus
from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.messages import Note
from cosim.core.text import split_assignment
from cosim.core.times import difference
from cosim.core.units import computed_in
from cosim.files.artefact import LOG
from cosim.files.files import FilePath, check_writable
from cosim.files.folders import new_run
from cosim.files.kinds import check_given
from cosim.files.yaml_file import Document, NotYaml, short
from cosim.simulation.workflow import Outcome, WriteReport, run

MAX_STEPS = 1_000_000  # requested by the FMU's own times


def simulate(
    fmu: FilePath,
    folder: FilePath | None = None,
    *,
    start: Mapping[str, Any] | Sequence[str] = (),
    recorded: FilePath | None = None,
    stop: float | None = None,
    step: float | None = None,
    record: Sequence[str] = (),
    interpolation: str = "held",
    report: WriteReport | Literal[False] = False,
    force: bool = True,
    in_process: bool = False,
    format_: str = "csv",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Outcome, tuple[str, ...]]:
    """Run an FMU over its default experiment.

    Writes scenario.yaml, results.csv, manifest.json and the report. After a failure the rows so far are written before
    the error is raised.

    Args:
        start: Start values of parameters and inputs, as a mapping or NAME=VALUE texts.
        recorded: CSV whose columns drive the inputs of the same names.
        stop: Stop time [s], like `step` in place of the default experiment's.
        record: Locals and parameters to record besides inputs and outputs.
        interpolation: Values of `recorded` between two rows: held or linear.

    Returns:
        The outcome and notes.

    Raises:
        InputError: The input is faulty.
        FmuError: The FMU does not load.
        SimulationError: The simulation stopped early.
    """
    path = Path(fmu)
    (description,) = read_fmus([path])
    values = start if isinstance(start, Mapping) else start_pairs(path, start, description)
    (part,) = parts_of([path], values)
    with new_run(folder, part.name, "cosim simulate", force=force) as place:
        scenario, csv = place / "scenario.yaml", None if recorded is None else Path(recorded)
        first, matches, notes = experiment_of(description).get("start"), Matches((), ()), list[str]()
        source, end, more = path, stop, dict[str, Any]()
        if csv is not None:
            matches, unused, time = _read_recording(csv, part)
            if unused:
                notes.append(Note(f"{csv.name}: {part.name} has no inputs {', '.join(unused)}: they drive nothing"))
            begin, last = float(time[0]), float(time[-1])
            declared, first = first, begin if first is None else max(first, begin)
            source, end = csv, last if stop is None else stop
            if first > begin:
                notes.append(Note(f"{csv.name}: begins at {begin:g} s, the run at {first:g} s as {part.name} says"))
            elif first > (declared or 0.0):
                notes.append(Note(f"the run begins at {first:g} s, where {csv.name} does"))
            if end > last * (1 + SLACK):
                notes.append(Note(f"{csv.name}: ends at {last:g} s; its last row is held until {end:g} s"))
            steps = np.diff(time)
            steps = steps[steps > 0.0]  # Equal times are a jump.
            usual = STOP / STEPS
            if steps.size:  # without the digits that the times do not hold
                far = float(np.max(np.abs(time)))
                usual = difference(far + float(np.median(steps)), far) or float(np.median(steps))
            more = {
                "usual_step": float(f"{usual:.6g}"),
                "why_stop": f"the end of {csv.name}" if stop is None else "given",
                "why_start": f"{csv.name} begins" if first == begin else "",
            }
        if end is not None and end <= (first or 0.0):
            text_ = f"ends at {end:g} s, the run begins at {first or 0.0:g} s; give a later --stop"
            raise InputError.at(source, text_)
        times = times_of([part], start=first, stop=end, step=step, most=MAX_STEPS, **more)
        check_writable(place, (scenario.name,), [path, *([csv] if csv else [])])
        text_ = scenario_text(place, [part], matches, times, DEFAULT, played=(csv, interpolation), verb="simulate")
        names = [n if n.startswith(f"{part.name}.") else f"{part.name}.{n}" for n in record]
        with draft_of(scenario) as draft:
            write_sound(draft, text_ + (f"record: {json.dumps(names)}\n" if names else ""), path)
        settings: dict[str, Any] = {"in_process": in_process, "format_": format_, "progress": progress}
        outcome = run(scenario, place, report=report, command="cosim simulate", **settings)
    return outcome, (*notes, *times.notes)


def _read_recording(path: Path, part: DraftPart) -> tuple[Matches, list[str], Array]:
    """Return the connections of a recording's columns to inputs, its other columns, and its times [s].

    Raises:
        InputError: No column is an input, or one has a start value.
    """
    check_given(path, LOG)
    inputs = {text(port).partition(".")[2]: port for port in part.inputs}
    kinds = {signal.name: signal.kind for signal in part.block.exact_inputs}
    log, exact = read_recording(path, inputs, kinds)
    columns = [*(column.name for column in log.columns if column.name != "time"), *exact]
    driving = [name for name in columns if name in inputs]
    if not driving:
        names = f"its columns: {', '.join(columns) or 'none'}; inputs of {part.name}: {', '.join(inputs) or 'none'}"
        raise InputError([Fault(path, 1, 1, f"no column is an input of {part.path.name} ({names}); rename a column")])
    refuse(
        Fault(part.path, 0, 0, f"--set {n}={part.start[n]}: {path.name} plays it; leave out --set, or the column")
        for n in driving
        if n in part.start
    )
    source, connections = "recorded" if part.name != "recorded" else "played", []
    for name in driving:
        signal = Signal(name, kind=kinds[name]) if name in exact else None
        signal = signal or Signal(name, computed_in(log.by_name[name].unit)[0], relative=True)
        connections.append(Match((source, signal), inputs[name]))
    unused = [*(name for name in columns if name not in driving), *sorted(log.spoiled)]
    return Matches(tuple(connections), ()), unused, log["time"]


def start_pairs(fmu: Path, texts: Sequence[str], description: Any) -> dict[str, Any]:
    """Return start values from NAME=VALUE texts; text stays as written."""
    names = {v.name for v in description.modelVariables}
    words = {v.name for v in description.modelVariables if v.type in {"String", "Binary"}}
    values: dict[str, Any] = {}
    faults = []
    for assignment in texts:
        name, sign, value = split_assignment(assignment, names)
        if not sign or not name:
            faults.append(Fault(fmu, 0, 0, f'--set "{short(assignment)}" is not NAME=VALUE; for example --set mass=2'))
            continue
        values[name] = value
        if name not in words:
            with suppress(NotYaml):
                values[name] = Document(value).data
    refuse(faults)
    return values
