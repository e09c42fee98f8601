"""Text of a first scenario: commented keys, marked guesses, and lines to uncomment."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cosim.authoring.matching import Matches, text
from cosim.authoring.parts import DraftPart, Times
from cosim.blocks.coupling import DEFAULT, Algorithm
from cosim.core.errors import Fault, InputError
from cosim.core.text import NOT_IN_YAML, as_yaml, counted
from cosim.fmi.description import unit_of
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import settable
from cosim.system.system import System, build_system

BY = "# Written by `cosim {}`."
MAX_PARAMETERS = 12  # shown per FMU
PLAIN = re.compile(r"[A-Za-z_][\w.]*")
NOT_TEXT = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}  # YAML words that need quotes as text


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
