"""A first scenario of FMUs: times from their default experiments, connections by name and unit, and its text."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.authoring.matching import Match, Matches, Port, match_ports, text
from cosim.authoring.parts import DraftPart, Times, parts_of, times_of
from cosim.blocks.coupling import DEFAULT, WITHOUT_ORDER, AlgebraicLoop, Algorithm
from cosim.blocks.summary import platforms_of
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.text import NOT_IN_YAML, as_yaml, counted
from cosim.fmi.description import no_library, platform_of, unit_of
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import settable
from cosim.system.system import System, build_system

MAX_PORTS = 6  # inputs and outputs in a message
BY = "# Written by `cosim {}`."
MAX_PARAMETERS = 12  # shown per FMU
PLAIN = re.compile(r"[A-Za-z_][\w.]*")
NOT_TEXT = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}  # YAML words that need quotes as text


def write_draft(path: Path, fmus: Sequence[Path]) -> tuple[Matches, str, list[str]]:
    """Write a commented scenario of FMUs, with guesses marked; return connections, coupling algorithm and warnings.

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
    inputs, outputs = [p for part in parts for p in part.inputs], [p for part in parts for p in part.outputs]
    sizes = {name: size for part in parts for name, size in part.sizes.items()}
    matches = match_ports(outputs, inputs, sizes)
    every = matches.connections
    kept = [m for m in every if not m.guess]
    if _algorithm(parts, kept) is DEFAULT:  # leave out guesses that close an algebraic loop
        for guess in (m for m in every if m.guess):
            kept += [guess] if _algorithm(parts, [*kept, guess]) is DEFAULT else []
        dropped = tuple((m.target, (text(m.source), *m.others)) for m in every if m not in kept)
        matches = Matches(tuple(m for m in every if m in kept), (*matches.unconnected, *dropped), matches.choices)
    if len(parts) > 1 and not matches.any_candidate:
        raise InputError.at(fmus[0], _no_fit(fmus, inputs, outputs, sizes))
    times = times_of(parts)
    algorithm = _algorithm(parts, matches.connections)
    with draft_of(path) as draft:
        system = write_sound(draft, scenario_text(path.parent, parts, matches, times, algorithm), parts[0].path)
    warnings = []
    for part in parts:
        here, there = platform_of(part.description), platforms_of(part.path)
        if here not in there:
            warnings.append(f"{part.name} does not run on this machine: {no_library(here, there)}")
    return matches, algorithm.name, [*warnings, *times.notes, *system.warnings]


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
    """Return why no output fits any input."""
    text_ = f"{' and '.join(p.name for p in fmus)} cannot be connected"
    if not outputs or not inputs:
        return f"{text_}: they have no {'inputs' if outputs else 'outputs'}; run each alone by `cosim simulate`"
    lists = []
    for ports in (outputs, inputs):
        names = []
        for port in ports[:MAX_PORTS]:
            size = sizes.get(text(port))
            names.append(f"{text(port)} [{port[1].unit or port[1].kind}{f', {size} elements' if size else ''}]")
        lists.append(", ".join(names))
    text_ += f": no output ({lists[0]}) fits an input of another ({lists[1]}) by type"
    element = next((f"{port[0]}.{port[1].name}" for port in (*inputs, *outputs) if text(port) in sizes), None)
    if element is None:
        return f"{text_} and unit"
    cure = f"a scenario may connect elements of an array one by one, as {element}"
    return f"{text_}, unit and number of elements; {cure}"


def scenario_text(
    folder: Path,
    parts: Sequence[DraftPart],
    matches: Matches,
    times: Times,
    algorithm: Algorithm,
    *,
    played: tuple[Path | None, str] = (None, "held"),
    verb: str = "init",
) -> str:
    """Return the text of a first scenario, to be written into `folder`.

    Args:
        played: Recording that plays inputs, whose connections come first, and its interpolation.
        verb: Command that writes the scenario.
    """
    guesses, choices = sum(bool(m.guess) for m in matches.connections), len(matches.choices)
    lines = [
        BY.format(verb) + " It runs as it is: `cosim run`, `cosim check` and `cosim graph` take it.",
        "# Every key stands in docs/scenario.md and in `cosim schema scenario`.",
    ]
    if guesses:
        verb_form = "is a guess" if guesses == 1 else "are guesses"
        lines.append(f"# {counted(guesses, 'connection')} below {verb_form}, marked so: look there first.")
    if choices:
        inputs = f"{counted(choices, 'input')} {'is' if choices == 1 else 'are'} left open"
        lines.append(f"# {inputs}, which several outputs fit alike: uncomment the one that is meant.")
    lines += [
        f"name: {'_'.join(dict.fromkeys(p.name for p in parts))[:60]}",
        f"duration: {times.duration:.12g} # s: {times.why_duration}",
        f"step: {_whole(times.step)} # s: {times.why_step}",
    ]
    lines += [f"start_time: {_whole(times.start)} # s: {times.why_start}"] if times.start else []
    if algorithm is not DEFAULT:
        lines.append(
            f"algorithm: {algorithm.name} # each FMU needs another's output of the same time; or state `order: [...]`"
        )
    lines.append("components:")
    for part in parts:
        lines += _component(folder, part, times)
    recording, interpolation = played
    if recording is not None:
        lines += [
            f"  {matches.connections[0].source[0]}:",
            "    block: playback",
            f"    file: {scalar(relative(recording, folder))}",
            *([f"    interpolation: {interpolation}"] if interpolation != "held" else []),
        ]
    lines += _connections(matches)
    signals = (o for part in parts for o in part.outputs if o[1].kind in ("Real", "Float64"))
    if first := next(signals, None):
        lines.append("# criteria: # what must hold; a missed one is told and exits 5")
        lines.append(f"#   peak: {{of: {scalar(text(first))}, max: 1}}")
    return "\n".join(lines) + "\n"


def _whole(value: float) -> str:
    """Return a number with enough digits to reproduce it."""
    return short if float(short := f"{value:.12g}") == value else repr(float(value))


def _component(folder: Path, part: DraftPart, times: Times) -> Iterator[str]:
    d = part.description
    about = f"{d.modelName}, FMI {d.fmiVersion}" + (f", by {d.generationTool}" if d.generationTool else "")
    yield f"  {part.name}: # {_comment(about)}"
    yield f"    fmu: {scalar(relative(part.path, folder))}"
    if part.name in times.own:
        yield f"    step: {times.own[part.name]:.12g} # s: it takes no other"
    parameters = [v for v in d.modelVariables if v.causality == "parameter" and settable(v) and not v.shape]
    if part.start:
        yield "    start:"
        yield from (f"      {scalar(name)}: {scalar(value)}" for name, value in part.start.items())
    elif parameters:
        yield "    # start:"
    for v in [v for v in parameters if v.name not in part.start][:MAX_PARAMETERS]:
        is_text, start = v.type == "String", "" if v.start is None else str(v.start)
        value = scalar(start if is_text else start.strip(), literal=not is_text)
        about = ", ".join(filter(None, (unit_of(v), _comment(v.description or "")[:80])))
        yield f"    #   {scalar(v.name)}: {value}" + (f" # {_comment(about)}" if about else "")
    if len(parameters) > MAX_PARAMETERS:
        yield f"    #   … and {len(parameters) - MAX_PARAMETERS} more: cosim info {_comment(part.path.name)}"


def _connections(matches: Matches) -> Iterator[str]:
    yield "connections:" if matches.any_candidate else "connections: []"
    for m in matches.connections:
        a, b = m.source[1].unit, m.target[1].unit
        why = [f"guess: {m.guess}" if m.guess else "same name"]
        if a and b:
            is_converted = (m.source[1].conversion(m.target[1]) or (1.0, 0.0)) != (1.0, 0.0)
            why.append(f"{a} to {b}, converted" if is_converted else b)
        elif a or b:
            why.append(f"{a or b} on one side, no unit on the other")
        why += [f"or from {', '.join(m.others)}"] if m.others else []
        yield f"  - {{from: {scalar(text(m.source))}, to: {scalar(text(m.target))}}} # {_comment('; '.join(why))}"
    for port, candidates in matches.unconnected:
        unit = f", {_comment(port[1].unit)}" if port[1].unit else ""
        alike = len(matches.choices.get(text(port), ()))
        choice = f"; the first {alike} fit alike:" if alike else "; fits:" if candidates else ""
        yield f"  # {_comment(text(port))}{unit}: not connected, stays at its start value{choice}"
        yield from (f"  # - {{from: {scalar(c)}, to: {scalar(text(port))}}}" for c in candidates)


def relative(path: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder, or the absolute path if the file is far away."""
    name = os.path.relpath(path.resolve(), folder.resolve())
    return Path(name).as_posix() if name.count("..") < 4 else path.resolve().as_posix()


def scalar(value: Any, literal: bool = False) -> str:
    """Return a value in YAML flow style, text quoted if necessary.

    Args:
        literal: Whether to omit quotes.
    """
    if not isinstance(value, str):
        return json.dumps(value)
    plain = PLAIN.fullmatch(value) and value.lower() not in NOT_TEXT
    return value if plain or (literal and value) else as_yaml(value)


def _comment(value: str) -> str:
    return " ".join(NOT_IN_YAML.sub(" ", value).split())


def write_sound(path: Path, lines: str, fmu: Path) -> System:
    """Write a scenario and return its system.

    If the scenario has faults, InputError names the FMU as their place, because the user has not written the scenario.
    """
    path.write_text(lines, encoding="utf-8")
    try:
        return build_system(ScenarioFile(path))
    except InputError as error:
        raise InputError([Fault(fmu, 0, 0, f.message, f.exit_code) for f in error.faults]) from None
