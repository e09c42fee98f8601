"""A first scenario of FMUs: times from their default experiments, connections by name and unit."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.authoring.draft_text import BY, is_edited, scenario_text, sealed
from cosim.authoring.matching import Match, Matches, Port, matched, text
from cosim.authoring.parts import SLACK, STEPS, STOP, Asked, Part, Times, parts_of, times_of
from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.units import computed_in
from cosim.blocks.component import Signal
from cosim.blocks.description import no_library, platform_of
from cosim.blocks.summary import experiment_of, platforms_of
from cosim.coupling.algorithms import DEFAULT, WITHOUT_ORDER, Algorithm
from cosim.coupling.order import AlgebraicLoop
from cosim.scenario.scenario_file import ScenarioFile
from cosim.storage.files import check_writable
from cosim.storage.folders import MOST_BYTES, check_run_folder, keep_earlier
from cosim.storage.kinds import LOG, check_given
from cosim.storage.table import read_columns
from cosim.system.system import System, build_system

MOST_OF_ONE = 1_000_000  # steps of a single FMU's run, requested by its own times


@dataclass(frozen=True)
class Draft:
    """A written first scenario with its FMUs, connections, times and warnings."""

    path: Path
    parts: Sequence[Part]
    matches: Matches
    times: Times
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
    force: bool = False,
    keep: bool = False,
) -> tuple[Path, tuple[str, ...]]:
    """Write scenario.yaml for a run of one FMU.

    Args:
        recorded: CSV whose columns drive the inputs of the same names.
        stop: Stop time [s], like `step` in place of the default experiment's.
        record: Further variables to record.
        keep: Whether to move the files of an earlier run to `runs` in the folder.

    Returns:
        The path and warnings.

    Raises:
        InputError: The FMU or its settings are faulty, no column is an input, or the folder belongs to another command.
    """
    (part,) = parts_of([fmu], start)
    path = folder / "scenario.yaml"
    check_run_folder(folder, part.name, force=force, keep=keep)
    earlier = _read_earlier(path) if path.is_file() else BY.format("simulate")
    if not earlier.startswith(BY.format("simulate")) or (is_edited(earlier) and not keep):
        cure = "is a scenario of yours and would be written over; give another folder as --out"
        raise InputError([Fault(path, 0, 0, cure)])
    played = _played(recorded, part) if recorded is not None else None
    asked, notes = _choose_times(part, played, stop, step)
    times = times_of([part], asked, most=MOST_OF_ONE)
    check_writable(folder, (path.name,), [fmu, *([recorded] if recorded else [])])
    matches = played.matches if played else Matches((), ())
    lines = scenario_text(folder, [part], matches, times, DEFAULT, played=recorded, verb="simulate")
    names = [n if n.startswith(f"{part.name}.") else f"{part.name}.{n}" for n in record]
    lines += f"record: {json.dumps(names)}\n" if names else ""
    with draft_of(path) as made:
        _write_sound(made, sealed(lines), fmu)
        if keep:
            keep_earlier(folder, "cosim run", [path.name])
    return path, (*notes, *times.notes)


def _read_earlier(path: Path) -> str:
    """Return the text of an earlier scenario, or an empty text for a file too long to be one of ours."""
    return path.read_text(encoding="utf-8", errors="replace") if path.stat().st_size <= MOST_BYTES else ""


def _choose_times(
    part: Part, played: Played | None, stop: float | None, step: float | None
) -> tuple[Asked, tuple[str, ...]]:
    """Return the requested times of a run and notes. A recording is played from its first row to its last."""
    declared = experiment_of(part.description).get("start")
    if played is None:
        _check_end(part.path, declared, stop)
        return Asked(declared, stop, step), ()
    recording, notes = played.path.name, list(played.notes)
    start = played.start if declared is None else max(declared, played.start)
    end = played.end if stop is None else stop
    if start > played.start:
        notes.append(f"{recording}: begins at {played.start:g} s, the run at {start:g} s as {part.name} says")
    elif start > (declared or 0.0):
        notes.append(f"the run begins at {start:g} s, where {recording} does")
    _check_end(played.path, start, end)
    if end > played.end * (1 + SLACK):
        notes.append(f"{recording}: ends at {played.end:g} s; its last row is held until {end:g} s")
    because = f"the end of {recording}" if stop is None else "given"
    why_start = f"{recording} begins" if start == played.start else ""
    return Asked(start, end, step, played.step, because, why_start), tuple(notes)


def _check_end(source: Path, start: float | None, end: float | None) -> None:
    if end is not None and end <= (start or 0.0):
        cure = f"ends at {end:g} s, the run begins at {start or 0.0:g} s; give a later --stop"
        raise InputError([Fault(source, 0, 0, cure)])


@dataclass(frozen=True)
class Played:
    """A recording for the inputs of an FMU: start, end and step [s], connections, and notes on unused columns."""

    path: Path
    start: float
    end: float
    step: float
    matches: Matches
    notes: tuple[str, ...]


def _played(path: Path, part: Part) -> Played:
    check_given(path, LOG)
    inputs = {text(port).partition(".")[2]: port for port in part.ports[0]}
    log = read_columns(path, inputs)
    columns = dict(log.columns)
    del columns["time"]
    fed, missed = [n for n in columns if n in inputs], [n for n in columns if n not in inputs]
    if not fed:
        names = f"its columns: {', '.join(columns) or 'none'}; inputs of {part.name}: {', '.join(inputs) or 'none'}"
        raise InputError([Fault(path, 1, 1, f"no column is an input of {part.path.name} ({names})")])
    cure = f"{path.name} plays it; leave out --set, or the column"
    faults = [Fault(part.path, 0, 0, f"--set {n}={part.start[n]}: {cure}") for n in fed if n in part.start]
    refuse(faults)
    source = "recorded" if part.name != "recorded" else "played"
    found = [Match((source, Signal(n, computed_in(columns[n].heading.unit)[0])), inputs[n]) for n in fed]
    missed += sorted(log.spoiled)
    notes = (f"{path.name}: {part.name} has no inputs {', '.join(missed)}: they drive nothing",) if missed else ()
    start, end = log["time"][[0, -1]].tolist()
    return Played(path, start, end, _usual_step(log["time"]), Matches(tuple(found), ()), notes)


def _usual_step(time: Array) -> float:
    """Return the median step of a recording [s]."""
    return float(f"{np.median(np.diff(time)) if time.size > 1 else STOP / STEPS:.6g}")


def write_draft(path: Path, fmus: Sequence[Path]) -> Draft:
    """Write a commented scenario of FMUs, with guesses marked.

    Connections are by name and unit. An existing file is never overwritten.

    Raises:
        InputError: An FMU is faulty, no output fits an input, or `path` exists.
    """
    if path.is_dir():
        raise InputError([Fault(path, 0, 0, "is a folder; name the file to write as --out")])
    if path.exists():
        cure = "it is never written over; give another name as --out, or move it away"
        raise InputError([Fault(path, 0, 0, f"is there already; {cure}")])
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError([Fault(path, 0, 0, "a scenario is YAML; name a .yaml or .yml file as --out")])
    if not path.parent.is_dir():
        raise InputError([Fault(path.parent, 0, 0, "no such folder; make it first")])
    parts = parts_of(fmus)
    inputs, outputs = ([p for part in parts for p in part.ports[side]] for side in (0, 1))
    sizes = {name: size for part in parts for name, size in part.sizes.items()}
    matches = _without_loops(parts, matched(outputs, inputs, sizes))
    if len(parts) > 1 and not matches.found and not any(candidates for _, candidates in matches.left):
        raise InputError([Fault(fmus[0], 0, 0, _cannot(fmus, inputs, outputs, sizes))])
    times = times_of(parts)
    algorithm = _algorithm(parts, matches.found)
    with draft_of(path) as made:
        system = _write_sound(made, scenario_text(path.parent, parts, matches, times, algorithm), parts[0].path)
    return Draft(path, parts, matches, times, algorithm.name, (*_elsewhere(parts), *times.notes, *system.warnings))


def _write_sound(made: Path, lines: str, fmu: Path) -> System:
    """Write a scenario and return its system; raise InputError, with the FMU as place, if faulty."""
    made.write_text(lines, encoding="utf-8")
    try:
        return build_system(ScenarioFile(made))
    except InputError as error:
        raise InputError([Fault(fmu, 0, 0, f.message, f.exit_code) for f in error.faults]) from None


def _elsewhere(parts: Sequence[Part]) -> Iterator[str]:
    """Yield a warning for each FMU without a library for this machine."""
    for part in parts:
        here, there = platform_of(part.description), platforms_of(part.path)
        if here not in there:
            yield f"{part.name} does not run on this machine: {no_library(here, there)}"


def _without_loops(parts: Sequence[Part], matches: Matches) -> Matches:
    """Remove guessed connections that close an algebraic loop."""
    sure = [m for m in matches.found if not m.guess]
    if _algorithm(parts, sure) is not DEFAULT:
        return matches
    kept = list(sure)
    for guess in (m for m in matches.found if m.guess):
        kept += [guess] if _algorithm(parts, [*kept, guess]) is DEFAULT else []
    dropped = tuple((m.target, (text(m.source), *m.others)) for m in matches.found if m not in kept)
    return Matches(tuple(m for m in matches.found if m in kept), (*matches.left, *dropped), matches.choices)


def _algorithm(parts: Sequence[Part], matches: Sequence[Match]) -> Algorithm:
    """Return the default algorithm, or for loops the one without order."""
    blocks = {part.name: part.block for part in parts}
    edges = [(m.source[0], m.target[0], m.target[1].name, m.source[1].name) for m in matches]
    try:
        DEFAULT.plan(blocks, edges, None)
    except AlgebraicLoop:
        return WITHOUT_ORDER
    return DEFAULT


def _cannot(fmus: Sequence[Path], inputs: Sequence[Port], outputs: Sequence[Port], sizes: Mapping[str, int]) -> str:
    names = " and ".join(p.name for p in fmus)
    if not outputs or not inputs:
        return f"{names} cannot be connected: they have no {'outputs' if not outputs else 'inputs'}"

    def about(port: Port) -> str:
        size = sizes.get(text(port))
        return f"{text(port)} [{port[1].unit or port[1].kind}{f', {size} elements' if size else ''}]"

    some = [", ".join(map(about, ports[:6])) for ports in (outputs, inputs)]
    by = "type, unit and number of elements" if sizes else "type and unit"
    element = next((port for port in (*inputs, *outputs) if text(port) in sizes), None)
    told = f"{names} cannot be connected: no output ({some[0]}) fits an input of another ({some[1]}) by {by}"
    if element is None:
        return told
    return f"{told}; a scenario may connect elements of an array one by one, as {element[0]}.{element[1].name}"
