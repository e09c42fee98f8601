"""A first scenario of FMUs: what they are run for by their default experiments, connected by name and unit."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.description import platform_of, takes_any_step, unit_of
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.interface import Signal
from cosim.blocks.summary import experiment_of, platforms_of, read_fmus
from cosim.errors import Fault, InputError
from cosim.files import check_writable
from cosim.kinds import LOG, check_given
from cosim.simulation.folder import check_ours
from cosim.simulation.matching import Match, Matches, Port, matched, text
from cosim.simulation.order import AlgebraicLoop, stages
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.start_values import settable
from cosim.simulation.system import System, build_system
from cosim.table import read_columns
from cosim.text import counted
from fmus.files import draft_of
from fmus.sampled import sampled_by
from fmus.units import computed_in

STOP, STEPS = 1.0, 500  # [s] where no FMU says how long; steps where none says how fine
MOST_STEPS = 20_000  # of a first run, which is to answer soon
MOST_OF_ONE = 1_000_000  # of one FMU, which was asked for by its own times
BY = "# Written by `cosim {}`."
PARAMETERS = 12  # shown of each FMU
PLAIN = re.compile(r"[A-Za-z_][\w.]*")


@dataclass(frozen=True)
class Part:
    """An FMU of a first scenario: its name there, how it is described, what it is given."""

    name: str
    path: Path
    description: Any
    start: Mapping[str, Any] = field(default_factory=dict)

    @property
    def block(self) -> FmuBlock:
        """It, unconnected and not loaded."""
        return FmuBlock(self.name, self.path, self.description, {}, frozenset())

    @property
    def ports(self) -> tuple[list[Port], list[Port]]:
        """Its inputs and outputs, of an array the first element alone."""
        block = self.block
        both = (*block.inputs, *block.exact_inputs), (*block.outputs, *block.exact_outputs)
        order = {v.name: k for k, v in enumerate(self.description.modelVariables)}
        inputs, outputs = (sorted(_whole(side), key=lambda s: order.get(s.array or s.name, 0)) for side in both)
        return [(self.name, s) for s in inputs], [(self.name, s) for s in outputs]


def _whole(signals: Sequence[Signal]) -> list[Signal]:
    firsts: dict[str, Signal] = {}
    for signal in signals:
        if not signal.local:
            firsts.setdefault(signal.array or signal.name, signal)
    return list(firsts.values())


@dataclass(frozen=True)
class Times:
    """When a run begins, how long it lasts and its step [s]; steps of components that need others, and why all that."""

    start: float
    duration: float
    step: float
    own: Mapping[str, float]
    why_duration: str
    why_step: str


def parts_of(paths: Sequence[Path], start: Mapping[str, Any] | None = None) -> list[Part]:
    """FMUs with names that a scenario takes, each its own; InputError with what is wrong with every one."""
    found: list[Part] = []
    for path, description in zip(paths, read_fmus(paths), strict=True):
        stem = re.sub(r"\W+", "_", path.stem, flags=re.ASCII).strip("_") or "fmu"
        stem = f"fmu_{stem}" if stem[0].isdigit() else stem
        taken = {p.name for p in found}
        name = next(n for n in (stem, *(f"{stem}_{k}" for k in range(2, 10_000))) if n not in taken)
        found.append(Part(name, path, description, start or {}))
    return found


def times_of(
    parts: Sequence[Part], stop: float | None = None, step: float | None = None, most: int = MOST_STEPS
) -> Times:
    """Times of a run of these FMUs, by their default experiments where nothing else is given."""
    experiments = {p.name: experiment_of(p.description) for p in parts}
    start = min((e.get("start", 0.0) for e in experiments.values()), default=0.0)
    ends = {name: e["stop"] for name, e in experiments.items() if e.get("stop", start) > start}
    longest = max(ends, key=lambda n: ends[n]) if ends else ""
    why_duration = f"the default experiment of {longest}" if longest else "no FMU says how long; a guess"
    duration = (ends[longest] if longest else start + STOP) - start
    duration, why_duration = (duration, why_duration) if stop is None else (stop - start, "given")
    needed = {p.name: own for p in parts if (own := _own_step(p)) > 0}
    wished = {**{n: e["step"] for n, e in experiments.items() if e.get("step", 0.0) > 0}, **needed}
    finest = min(wished, key=lambda n: wished[n]) if wished else ""
    if step is not None:
        h, why_step = step, "given"
    elif finest:
        h, why_step = wished[finest], f"the step of {finest}"
    else:
        h, why_step = _round(duration / STEPS), "no FMU says how fine; a guess"
    steps = max(1, math.ceil(duration / h - 1e-9))
    if stop is None and steps > most:
        why_duration = f"{most} steps; {why_duration} would be {duration:g} s"
        steps = most
    if stop is not None and step is None and not needed:  # the end is what was asked for
        h = duration / steps
    else:
        duration = float(f"{steps * h:.12g}")
    coarser = {n: own for n, own in needed.items() if own > h * (1 + 1e-9)}
    return Times(start, duration, float(f"{h:.12g}"), coarser, why_duration, why_step)


def _own_step(part: Part) -> float:
    """The communication step that an FMU insists on [s], 0 where it takes any."""
    parameter = sampled_by(part.path)
    if parameter is not None:
        declared = next((v.start for v in part.description.modelVariables if v.name == parameter), None)
        return float(part.start.get(parameter, declared) or 0.0)
    return 0.0 if takes_any_step(part.description) else experiment_of(part.description).get("step", 0.0)


def _round(step: float) -> float:
    """The round number at or below: 1, 2 or 5 × 10^n."""
    power = 10.0 ** math.floor(math.log10(step) + 1e-9)
    return float(f"{max(m * power for m in (1, 2, 5) if m * power <= step * (1 + 1e-9)):.12g}")


# -- the scenario -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draft:
    """A first scenario that is written: where, of which FMUs, how they are connected, what is to be known of it."""

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
) -> tuple[Path, tuple[str, ...]]:
    """Write scenario.yaml into a folder, a run of one FMU; its path, and warnings.

    recorded: a CSV whose columns are played to the inputs of their names
    stop, step: [s], in place of those of its default experiment
    Raises InputError where the FMU cannot be read or set so, no column is of an input, or the folder is another's.
    """
    (part,) = parts_of([fmu], start)
    path = folder / "scenario.yaml"
    check_ours(folder, part.name, force=force)
    if path.is_file() and not path.read_text(encoding="utf-8", errors="replace").startswith(BY.format("simulate")):
        cure = "is a scenario of yours and would be written over; give another folder as --out"
        raise InputError([Fault(path, 0, 0, cure)])
    played = _played(recorded, part) if recorded is not None else None
    ends = stop if stop is not None or played is None else played.end
    fine = step if step is not None or played is None or experiment_of(part.description).get("step") else played.step
    began = experiment_of(part.description).get("start", 0.0)
    if ends is not None and ends <= began:
        raise InputError(
            [Fault(recorded or fmu, 0, 0, f"ends at {ends:g} s, the run begins at {began:g} s; give a later --stop")]
        )
    times = times_of([part], ends, fine, most=MOST_OF_ONE)
    check_writable(folder, (path.name,), [fmu, *([recorded] if recorded else [])])
    lines = _text(
        folder, [part], played.matches if played else Matches((), ()), times, "gauss-seidel", played, "simulate"
    )
    names = [n if n.startswith(f"{part.name}.") else f"{part.name}.{n}" for n in record]
    lines += f"record: {json.dumps(names)}\n" if names else ""
    with draft_of(path) as made:
        made.write_text(lines, encoding="utf-8")
        try:
            build_system(ScenarioFile(made))
        except InputError as error:
            raise InputError([Fault(fmu, 0, 0, f.message, f.exit_code) for f in error.faults]) from None
    return path, played.notes if played else ()


@dataclass(frozen=True)
class Played:
    """A recording played to the inputs of an FMU: its end and step [s], what goes where, what goes nowhere."""

    path: Path
    end: float
    step: float
    matches: Matches
    notes: tuple[str, ...]


def _played(path: Path, part: Part) -> Played:
    check_given(path, LOG)
    inputs = {text(port).partition(".")[2]: port for port in part.ports[0]}
    log = read_columns(path, inputs)
    columns = [c for c in log.columns.values() if c.name != "time"]
    fed = [c for c in columns if c.name in inputs]
    if not fed:
        names = f"its columns: {', '.join(c.name for c in columns) or 'none'}; "
        names += f"inputs of {part.name}: {', '.join(inputs) or 'none'}"
        raise InputError([Fault(path, 1, 1, f"no column is an input of {part.path.name} ({names})")])
    source = "recorded" if part.name != "recorded" else "played"
    found = []
    for c in fed:
        unit, _ = computed_in(c.heading.unit)
        found.append(Match((source, Signal(c.name, unit)), inputs[c.name]))
    missed = [c.name for c in columns if c.name not in inputs]
    notes = (f"{path.name}: not inputs of {part.name}, so not played: {', '.join(missed)}",) if missed else ()
    time = log["time"]
    between = float(np.median(np.diff(time))) if time.size > 1 else STOP / STEPS
    return Played(path, float(time[-1]), float(f"{between:.6g}"), Matches(tuple(found), ()), notes)


def write_draft(path: Path, fmus: Sequence[Path]) -> Draft:
    """Write a commented scenario of these FMUs, connected by name and unit, guesses marked; never over a file.

    Raises InputError where FMUs cannot be read, none of their outputs fits an input of another, or `path` is there.
    """
    if path.exists():
        cure = "it is never written over; give another name as --out, or move it away"
        raise InputError([Fault(path, 0, 0, f"is there already; {cure}")])
    if not path.parent.is_dir():
        raise InputError([Fault(path.parent, 0, 0, "no such folder; make it first")])
    parts = parts_of(fmus)
    inputs, outputs = ([p for part in parts for p in part.ports[side]] for side in (0, 1))
    matches = _without_loops(parts, matched(outputs, inputs))
    if len(parts) > 1 and not matches.found and not any(candidates for _, candidates in matches.left):
        raise InputError([Fault(fmus[0], 0, 0, _cannot(fmus, inputs, outputs))])
    times = times_of(parts)
    with draft_of(path) as made:
        algorithm, system = _that_runs(made, path.parent, parts, matches, times)
    return Draft(path, parts, matches, times, algorithm, (*_elsewhere(parts), *system.warnings))


def _elsewhere(parts: Sequence[Part]) -> Iterator[str]:
    """A warning for each FMU that has no library for this machine."""
    for part in parts:
        here, there = platform_of(part.description), platforms_of(part.path)
        if here not in there:
            yield f"{part.name} does not run on this machine, {here}: it has libraries for {', '.join(there) or 'none'}"


def _without_loops(parts: Sequence[Part], matches: Matches) -> Matches:
    """Leave out guesses that close a loop in which each needs the other's value of the same time."""
    blocks = {part.name: part.block for part in parts}
    sure = [m for m in matches.found if not m.guess]
    if _loops(blocks, sure):
        return matches
    kept = list(sure)
    for guess in (m for m in matches.found if m.guess):
        kept += [] if _loops(blocks, [*kept, guess]) else [guess]
    dropped = tuple((m.target, (text(m.source), *m.others)) for m in matches.found if m not in kept)
    return Matches(tuple(m for m in matches.found if m in kept), (*matches.left, *dropped))


def _loops(blocks: Mapping[str, FmuBlock], matches: Sequence[Match]) -> bool:
    edges = [(m.source[0], m.target[0], m.target[1].name, m.source[1].name) for m in matches]
    try:
        stages(blocks, edges, None)
    except AlgebraicLoop:
        return True
    return False


def _that_runs(made: Path, folder: Path, parts: Sequence[Part], matches: Matches, times: Times) -> tuple[str, System]:
    """The algorithm under which the scenario can be put together, the file written, and what it makes."""
    for algorithm in ("gauss-seidel", "jacobi"):
        made.write_text(_text(folder, parts, matches, times, algorithm), encoding="utf-8")
        try:
            return algorithm, build_system(ScenarioFile(made))
        except InputError as error:
            if algorithm == "jacobi" or not any("algebraic loop" in f.message for f in error.faults):
                raise InputError([Fault(parts[0].path, 0, 0, f.message, f.exit_code) for f in error.faults]) from None
    raise AssertionError  # the second one returned or raised


def _cannot(fmus: Sequence[Path], inputs: Sequence[Port], outputs: Sequence[Port]) -> str:
    names = " and ".join(p.name for p in fmus)
    if not outputs or not inputs:
        return f"{names} cannot be connected: they have no {'outputs' if not outputs else 'inputs'}"
    some = [", ".join(f"{text(p)} [{p[1].unit or p[1].kind}]" for p in ports[:6]) for ports in (outputs, inputs)]
    return f"{names} cannot be connected: no output ({some[0]}) fits an input of another ({some[1]}) by type and unit"


def _text(
    folder: Path,
    parts: Sequence[Part],
    matches: Matches,
    times: Times,
    algorithm: str,
    played: Played | None = None,
    verb: str = "init",
) -> str:
    lines = [
        BY.format(verb) + " It runs as it is: `cosim run`, `cosim check` and `cosim graph` take it.",
        "# Every key stands in docs/scenario.md and in `cosim schema scenario`.",
        *_guessed(sum(bool(m.guess) for m in matches.found)),
        f"name: {'_'.join(dict.fromkeys(p.name for p in parts))[:60]}",
        f"duration: {times.duration:.12g} # s: {times.why_duration}",
        f"step: {times.step:.12g} # s: {times.why_step}",
    ]
    lines += [f"start_time: {times.start:.12g} # s: of the default experiments"] if times.start else []
    if algorithm == "jacobi":
        lines.append("algorithm: jacobi # each FMU needs another's output of the same time; or state `order: [...]`")
    lines.append("components:")
    for part in parts:
        lines += _component(folder, part, times)
    if played is not None:
        lines += [
            f"  {matches.found[0].source[0]}:",
            "    block: playback",
            f"    file: {scalar(relative(played.path, folder))}",
        ]
    lines += _connections(matches) + _more(parts)
    return "\n".join(lines) + "\n"


def _guessed(count: int) -> list[str]:
    what = f"{counted(count, 'connection')} below {'is a guess' if count == 1 else 'are guesses'}"
    return [f"# {what}, marked so: look there first."] if count else []


def _component(folder: Path, part: Part, times: Times) -> Iterator[str]:
    d = part.description
    about = f"{d.modelName}, FMI {d.fmiVersion}" + (f", by {d.generationTool}" if d.generationTool else "")
    yield f"  {part.name}: # {_comment(about)}"
    yield f"    fmu: {scalar(relative(part.path, folder))}"
    if part.name in times.own:
        yield f"    step: {times.own[part.name]:.12g} # s: it takes no other"
    given = [v for v in d.modelVariables if v.causality == "parameter" and settable(v) and not v.shape]
    if part.start:
        yield "    start:"
        yield from (f"      {scalar(name)}: {scalar(value)}" for name, value in part.start.items())
    elif given:
        yield "    # start:"
    for v in [v for v in given if v.name not in part.start][:PARAMETERS]:
        about = ", ".join(filter(None, (unit_of(v), " ".join((v.description or "").split())[:80])))
        value = scalar(
            "" if v.start is None else v.start if v.type == "String" else str(v.start).strip(), v.type != "String"
        )
        yield f"    #   {scalar(v.name)}: {value}" + (f" # {_comment(about)}" if about else "")
    if len(given) > PARAMETERS:
        yield f"    #   … and {len(given) - PARAMETERS} more: cosim info {_comment(part.path.name)}"


def _connections(matches: Matches) -> list[str]:
    lines = ["connections:" if matches.found else "connections: []"]
    for m in matches.found:
        lines.append(f"  - {{from: {scalar(text(m.source))}, to: {scalar(text(m.target))}}} # {_why(m)}")
    for port, candidates in matches.left:
        start = f", {unit}" if (unit := port[1].unit) else ""
        lines.append(
            f"  # {_comment(text(port))}{start}: not connected, stays at its start value"
            + ("; fits:" if candidates else "")
        )
        lines += [f"  # - {{from: {scalar(c)}, to: {scalar(text(port))}}}" for c in candidates]
    return lines


def _why(m: Match) -> str:
    a, b = m.source[1].unit, m.target[1].unit
    parts = [f"guess: {m.guess}" if m.guess else "same name"]
    if a and b:
        parts.append(f"{a} to {b}, converted" if m.factor != (1.0, 0.0) else b)
    elif a or b:
        parts.append(f"{a or b} on one side, no unit on the other")
    parts += [f"or from {', '.join(m.others)}"] if m.others else []
    return _comment("; ".join(parts))


def _more(parts: Sequence[Part]) -> list[str]:
    first = next((text(o) for part in parts for o in part.ports[1] if o[1].kind in ("Real", "Float64")), None)
    if first is None:
        return []
    return [
        "# criteria: # what must hold; a missed one is told and exits 5",
        f"#   peak: {{of: {scalar(first)}, max: 1}}",
    ]


def relative(path: Path, folder: Path) -> str:
    """A file as a scenario in `folder` names it: from there where it is near, else whole."""
    named = os.path.relpath(path.resolve(), folder.resolve())
    return Path(named).as_posix() if named.count("..") < 4 else path.resolve().as_posix()


def scalar(value: Any, literal: bool = False) -> str:
    """A value as YAML in flow style; text in quotes where it needs them, but not what is `literal`."""
    if not isinstance(value, str):
        return json.dumps(value)
    plain = PLAIN.fullmatch(value) and value.lower() not in {
        "true",
        "false",
        "yes",
        "no",
        "on",
        "off",
        "null",
        "y",
        "n",
    }
    return value if plain or (literal and value) else json.dumps(value, ensure_ascii=False)


def _comment(value: str) -> str:
    return " ".join(value.split())
