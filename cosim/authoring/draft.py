"""A first scenario for given FMUs: component names, times from default experiments, connections by name and unit."""

from __future__ import annotations

import json
import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.authoring.matching import Match, Matches, Port, match_ports, text
from cosim.blocks.component import Signal
from cosim.blocks.coupling import DEFAULT, WITHOUT_ORDER, AlgebraicLoop, Algorithm
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.summary import experiment_of, platforms_of, read_fmus
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.messages import Note
from cosim.core.text import NOT_IN_YAML, as_yaml, unique_name
from cosim.core.times import STEP_COUNT_TOLERANCE, difference
from cosim.fmi.annotations import sampled_by
from cosim.fmi.description import no_library, platform_of, takes_any_step, unit_of
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import settable
from cosim.system.events import default_block
from cosim.system.system import System, build_system

GUESSED_STOP_S, GUESSED_STEPS = 1.0, 500  # defaults if the FMUs declare none: duration [s], number of steps
SPELLING = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
MAX_NAME_LENGTH = 24  # characters of a component's name, which precedes every signal
MAX_FIRST_RUN_STEPS = 20_000  # maximum number of steps of a first run, so that it is short
BY = "# Written by `cosim {}`."
MAX_DRAFT_PARAMETERS = 12  # shown per FMU
PLAIN_SCALAR = re.compile(r"[A-Za-z_][\w.]*")
NOT_TEXT = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}  # YAML words that need quotes as text


@dataclass(frozen=True)
class DraftPart:
    """An FMU of a scenario draft: component name, description and start values.

    Attributes:
        block: The FMU, unconnected and not loaded.
        inputs, outputs: Ports, with only the first element of arrays.
        sizes: Number of elements of each array, by name `component.variable`.
    """

    name: str
    path: Path
    description: Any
    start: Mapping[str, Any]
    block: FmuBlock
    inputs: list[Port]
    outputs: list[Port]
    sizes: Mapping[str, int]


@dataclass(frozen=True)
class Times:
    """Start, duration and step of a run [s], steps of single components, and the reasons for these values.

    Attributes:
        notes: Deviations from the user's request.
    """

    start: float
    duration: float
    step: float
    own: Mapping[str, float]
    why_duration: str
    why_step: str
    notes: tuple[str, ...]


def component_name(stem: str, model: str = "") -> str:
    """Return a component name from the file name, or from the model name if the file name is long."""
    names = [_identifier(stem), _identifier(model.rpartition(".")[2])]
    name = next((name for name in names if 0 < len(name) <= MAX_NAME_LENGTH), names[0][:MAX_NAME_LENGTH].rstrip("_"))
    return (f"fmu_{name}" if name[:1].isdigit() else name) or "fmu"


def _identifier(text: str) -> str:
    """Return a text as an identifier of ASCII letters, digits and underscores; ä becomes ae."""
    ascii_ = unicodedata.normalize("NFKD", text.translate(SPELLING)).encode("ascii", "ignore").decode()
    return re.sub(r"[\W_]+", "_", ascii_).strip("_")


def parts_of(paths: Sequence[Path], start: Mapping[str, Any] | None = None) -> list[DraftPart]:
    """Return FMUs with unique component names; an InputError names every fault of every FMU."""
    parts: list[DraftPart] = []
    for path, description in zip(paths, read_fmus(paths), strict=True):
        name = unique_name(component_name(path.stem, description.modelName or ""), {p.name for p in parts})
        block = default_block(path, description)(name, path, description, {}, frozenset())
        sides = (*block.inputs, *block.exact_inputs), (*block.outputs, *block.exact_outputs)
        order = {v.name: k for k, v in enumerate(description.modelVariables)}
        ports: list[list[Port]] = []
        for side in sides:
            firsts: dict[str, Signal] = {}
            for signal in side:
                if not signal.local:
                    firsts.setdefault(signal.array or signal.name, signal)
            ports.append([(name, firsts[n]) for n in sorted(firsts, key=lambda n: order.get(n, 0))])
        sizes = Counter(f"{name}.{s.array}" for side in sides for s in side if s.array and not s.local)
        inputs, outputs = ports
        parts.append(DraftPart(name, path, description, start or {}, block, inputs, outputs, sizes))
    return parts


def times_of(
    parts: Sequence[DraftPart],
    *,
    start: float | None = None,
    stop: float | None = None,
    step: float | None = None,
    usual_step: float | None = None,
    most: int = MAX_FIRST_RUN_STEPS,
) -> Times:
    """Return start, duration and step of a run.

    A step that the user requests or an FMU requires is kept, and the end moves to a whole number of steps. Otherwise
    the end is kept, and the step is shortened to divide the run into whole steps.

    Args:
        start, stop, step: Times [s] in place of those of the FMUs.
        usual_step: Step [s] if neither the user nor an FMU states one.
        most: Largest number of steps without a requested stop.

    Raises:
        InputError: A step is longer than the run.
    """
    experiments = {p.name: experiment_of(p.description) for p in parts}
    own: dict[str, float] = {}
    for part in parts:
        required = 0.0 if takes_any_step(part.description) else experiments[part.name].get("step", 0.0)
        if (parameter := sampled_by(part.path)) is not None:
            declared = next((v.start for v in part.description.modelVariables if v.name == parameter), None)
            required = float(part.start.get(parameter, declared) or 0.0)
        if required > 0.0:
            own[part.name] = required
    if start is None:
        start = min((e.get("start", 0.0) for e in experiments.values()), default=0.0)
    ends = {name: e["stop"] for name, e in experiments.items() if e.get("stop", start) > start}
    duration, why_duration = GUESSED_STOP_S, "a guess; no FMU declares a duration"
    if stop is not None:
        duration, why_duration = difference(stop, start), "given"
    elif ends:
        longest = max(ends, key=lambda n: ends[n])
        duration, why_duration = difference(ends[longest], start), f"the default experiment of {longest}"
    duration = float(f"{duration:.12g}")
    steps = {**{n: e["step"] for n, e in experiments.items() if e.get("step", 0.0) > 0}, **own}
    if step is not None:
        h, why_step = step, "given"
    elif steps:
        finest = min(steps, key=lambda n: steps[n])
        h, why_step = float(f"{steps[finest]:.12g}"), f"the step of {finest}"
    elif usual_step is not None:
        h, why_step = min(usual_step, duration), "the typical spacing of its rows"
    else:  # rounded down to 1, 2 or 5 × 10^n
        why_step, guess = "a guess; no FMU declares a step", duration / GUESSED_STEPS
        power = 10.0 ** math.floor(math.log10(guess) + 1e-9)
        h = float(f"{max(m * power for m in (1, 2, 5) if m * power <= guess * (1 + 1e-9)):.12g}")
    if step is not None and h > duration * (1 + STEP_COUNT_TOLERANCE):
        text = f"--step {h:g} is longer than the run of {duration:g} s ({why_duration}); give a shorter step"
        raise InputError.at(parts[0].path, f"{text}, or a later --stop")
    count = max(1, math.ceil(duration / h - STEP_COUNT_TOLERANCE))
    if stop is None and count > most:
        why_duration = f"limited to {most} steps; {why_duration}: {duration:g} s"
        count, duration = most, most * h
    notes, end = list[str](), start + duration
    if stop is not None and step is None and not own:
        fitting = duration / count
        if abs(fitting - h) > STEP_COUNT_TOLERANCE * h:
            notes.append(
                Note(f"the step is {fitting:g} s instead of {h:g} s ({why_step}), so that the run ends at {end:g} s")
            )
            why_step = f"{count} steps to the end; instead of {h:g} s, {why_step}"
        h = fitting
    else:
        own = {n: required for n, required in own.items() if required > h * (1 + STEP_COUNT_TOLERANCE)}
        whole = float(f"{count * h:.12g}")
        if abs(whole - duration) > STEP_COUNT_TOLERANCE * duration:
            text = f"the run ends at {start + whole:g} s instead of {end:g} s ({why_duration})"
            notes.append(Note(f"{text}, after a whole number of steps of {h:g} s ({why_step})"))
            why_duration = f"a whole number of steps; {why_duration}: {duration:g} s"
        duration = whole
    return Times(start, duration, h, own, why_duration, why_step, tuple(notes))


# -- text of a scenario --------------------------------------------------------------------------------


def write_draft(path: Path, fmus: Sequence[Path]) -> tuple[Matches, str, list[str]]:
    """Write a commented scenario of FMUs, with guesses marked. Return connections, coupling algorithm and warnings.

    Connections are made by name and unit. An existing file is never overwritten.

    Raises:
        InputError: An FMU is faulty, no output fits an input, or `path` exists.
    """
    if path.exists():
        raise InputError.at(path, "already exists and is never overwritten; give another --out, or move the file")
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError.at(path, "a scenario needs the ending .yaml or .yml; give such a file as --out")
    if not path.parent.is_dir():
        raise InputError.at(path.parent, "no such folder; create it first")
    parts = parts_of(fmus)
    inputs, outputs = [p for part in parts for p in part.inputs], [p for part in parts for p in part.outputs]
    sizes = {name: size for part in parts for name, size in part.sizes.items()}
    matches = match_ports(outputs, inputs, sizes)
    every = matches.connections
    kept = [m for m in every if not m.guess]
    if _algorithm(parts, kept) is DEFAULT:  # leave out guesses that would close an algebraic loop
        for guess in (m for m in every if m.guess):
            kept += [guess] if _algorithm(parts, [*kept, guess]) is DEFAULT else []
        dropped = tuple((m.target, (text(m.source), *m.others)) for m in every if m not in kept)
        matches = Matches(tuple(m for m in every if m in kept), (*matches.unconnected, *dropped))
    if len(parts) > 1 and not matches.any_candidate:
        names = " and ".join(path.name for path in fmus)
        reason = f"{names} cannot be connected: no output fits an input of another FMU by type, unit and size"
        raise InputError.at(fmus[0], f"{reason}; `cosim info` lists them, `cosim simulate` runs each FMU by itself")
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
    """Return the default coupling algorithm, or one that needs no order of steps if there is an algebraic loop."""
    blocks = {part.name: part.block for part in parts}
    edges = [(m.source[0], m.target[0], m.target[1].name, m.source[1].name) for m in matches]
    try:
        DEFAULT.plan(blocks, edges, None)
    except AlgebraicLoop:
        return WITHOUT_ORDER
    return DEFAULT


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
        played: Recording that supplies inputs (its connections come first), and its interpolation.
        verb: Command that writes the scenario.
    """
    guesses = sum(bool(m.guess) for m in matches.connections)
    lines = [
        BY.format(verb) + " It runs unchanged: try `cosim run`, `cosim check` and `cosim graph`.",
        "# docs/scenario.md and `cosim schema scenario` describe all keys.",
    ]
    if guesses:
        lines.append(f"# Guessed connections below, marked as a guess: {guesses}. Check them first.")
    lines += [
        f"name: {'_'.join(dict.fromkeys(p.name for p in parts))[:60]}",
        f"duration: {times.duration:.12g} # s: {times.why_duration}",
        f"step: {_exact_text(times.step)} # s: {times.why_step}",
    ]
    lines += [f"start_time: {_exact_text(times.start)} # s"] if times.start else []
    if algorithm is not DEFAULT:
        lines.append(
            f"algorithm: {algorithm.name} # because of an algebraic loop between the FMUs; or set `order: [...]`"
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
        lines.append("# criteria: # requirements; a missed criterion is reported, with exit code 5")
        lines.append(f"#   peak: {{of: {scalar(text(first))}, max: 1}}")
    return "\n".join(lines) + "\n"


def _exact_text(value: float) -> str:
    """Return a number as text with enough digits to read back the same value."""
    return short if float(short := f"{value:.12g}") == value else repr(float(value))


def _component(folder: Path, part: DraftPart, times: Times) -> Iterator[str]:
    d = part.description
    about = f"{d.modelName}, FMI {d.fmiVersion}" + (f", by {d.generationTool}" if d.generationTool else "")
    yield f"  {part.name}: # {_comment(about)}"
    yield f"    fmu: {scalar(relative(part.path, folder))}"
    if part.name in times.own:
        yield f"    step: {_exact_text(times.own[part.name])} # s: the only accepted step"
    parameters = [v for v in d.modelVariables if v.causality == "parameter" and settable(v) and not v.shape]
    if part.start:
        yield "    start:"
        yield from (f"      {scalar(name)}: {scalar(value)}" for name, value in part.start.items())
    elif parameters:
        yield "    # start:"
    for v in [v for v in parameters if v.name not in part.start][:MAX_DRAFT_PARAMETERS]:
        is_text, start = v.type == "String", "" if v.start is None else str(v.start)
        value = scalar(start if is_text else start.strip(), literal=not is_text)
        about = ", ".join(filter(None, (unit_of(v), _comment(v.description or "")[:80])))
        yield f"    #   {scalar(v.name)}: {value}" + (f" # {_comment(about)}" if about else "")
    if len(parameters) > MAX_DRAFT_PARAMETERS:
        yield f"    #   … and {len(parameters) - MAX_DRAFT_PARAMETERS} more: cosim info {_comment(part.path.name)}"


def _connections(matches: Matches) -> Iterator[str]:
    yield "connections:" if matches.any_candidate else "connections: []"
    for m in matches.connections:
        a, b = m.source[1].unit, m.target[1].unit
        why = [f"guess: {m.guess}" if m.guess else "same name"]
        if a and b:
            is_converted = (m.source[1].conversion(m.target[1]) or (1.0, 0.0)) != (1.0, 0.0)
            why.append(f"{a} to {b}, converted" if is_converted else b)
        elif a or b:
            why.append(f"{a or b} on one side, no unit on the other side")
        why += [f"or from {', '.join(m.others)}"] if m.others else []
        yield f"  - {{from: {scalar(text(m.source))}, to: {scalar(text(m.target))}}} # {_comment('; '.join(why))}"
    for port, candidates in matches.unconnected:
        unit = f", {_comment(port[1].unit)}" if port[1].unit else ""
        fits = "; outputs that fit, the most likely first:" if candidates else ""
        yield f"  # {_comment(text(port))}{unit}: not connected, keeps its start value{fits}"
        yield from (f"  # - {{from: {scalar(c)}, to: {scalar(text(port))}}}" for c in candidates)


def relative(path: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder, or the absolute path if the file is far away."""
    name = os.path.relpath(path.resolve(), folder.resolve())
    return Path(name).as_posix() if name.count("..") < 4 else path.resolve().as_posix()


def scalar(value: Any, literal: bool = False) -> str:
    """Return a value in YAML flow style; text is quoted if necessary.

    Args:
        literal: Omit quotes.
    """
    if not isinstance(value, str):
        return json.dumps(value)
    plain = PLAIN_SCALAR.fullmatch(value) and value.lower() not in NOT_TEXT
    return value if plain or (literal and value) else as_yaml(value)


def _comment(value: str) -> str:
    return " ".join(NOT_IN_YAML.sub(" ", value).split())


def write_sound(path: Path, lines: str, fmu: Path) -> System:
    """Write a scenario and return its system.

    Faults of the scenario are reported as faults of the FMU, because the user has not written the scenario.
    """
    path.write_text(lines, encoding="utf-8")
    try:
        return build_system(ScenarioFile(path))
    except InputError as error:
        raise InputError([Fault(fmu, 0, 0, f.message, f.exit_code) for f in error.faults]) from None
