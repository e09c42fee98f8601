"""FMUs of a scenario draft: their component names, ports, and times of the run."""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.authoring.matching import Port
from cosim.blocks.component import Signal
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.summary import experiment_of, read_fmus
from cosim.core.errors import InputError
from cosim.core.messages import Note
from cosim.core.times import difference
from cosim.fmi.description import takes_any_step
from cosim.fmi.sampled import sampled_by
from cosim.system.events import default_block

STOP, STEPS = 1.0, 500  # defaults without an FMU's declaration: duration [s], number of steps
LONGEST = 24  # characters of a component's name, which precedes every signal
SPELLING = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "ø": "o", "Ø": "O"}
)
MOST_STEPS = 20_000  # steps of a first run, which must answer soon
SLACK = 1e-9  # relative tolerance for a whole number of steps


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
    """Start, duration and step of a run [s], own steps of components, and reasons.

    Attributes:
        notes: Deviations from the request.
    """

    start: float
    duration: float
    step: float
    own: Mapping[str, float]
    why_duration: str
    why_step: str
    why_start: str
    notes: tuple[str, ...]


def component_name(stem: str, model: str = "") -> str:
    """Return a component name from the file name, or from the model name if the file name is long."""
    name = _identifier(stem)
    if len(name) > LONGEST:
        name = _identifier(model.rpartition(".")[2]) or name
    if len(name) > LONGEST:
        whole = name.rfind("_", LONGEST // 2, LONGEST + 1)  # between words
        name = name[: whole if whole > 0 else LONGEST]
    return (f"fmu_{name}" if name[:1].isdigit() else name) or "fmu"


def _identifier(text: str) -> str:
    """Return a text as an identifier of ASCII letters, digits and underscores; ä becomes ae."""
    plain = unicodedata.normalize("NFKD", text.translate(SPELLING))
    return re.sub(r"[\W_]+", "_", "".join(c for c in plain if not unicodedata.combining(c)), flags=re.ASCII).strip("_")


def parts_of(paths: Sequence[Path], start: Mapping[str, Any] | None = None) -> list[DraftPart]:
    """Return FMUs with unique component names; raise InputError with all faults."""
    parts: list[DraftPart] = []
    for path, description in zip(paths, read_fmus(paths), strict=True):
        stem = component_name(path.stem, description.modelName or "")
        names = {p.name for p in parts}
        name = next(n for n in (stem, *(f"{stem}_{k}" for k in range(2, 10_000))) if n not in names)
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
    why_stop: str = "given",
    why_start: str = "",
    most: int = MOST_STEPS,
) -> Times:
    """Return start, duration and step of a run.

    A step that is requested or required by an FMU stays, and the end moves to a whole number of steps. Otherwise the
    end stays, and the step is shortened to fit.

    Args:
        start, stop, step: Times [s] in place of those of the FMUs.
        usual_step: Step [s] if neither the user nor an FMU states one.
        why_stop, why_start: Reasons, for the comments of a draft.
        most: Largest number of steps without a requested stop.

    Raises:
        InputError: A step exceeds the run.
    """
    experiments = {p.name: experiment_of(p.description) for p in parts}
    own = {p.name: required for p in parts if (required := _own_step(p)) > 0}
    if start is None:
        start = min((e.get("start", 0.0) for e in experiments.values()), default=0.0)
    ends = {name: e["stop"] for name, e in experiments.items() if e.get("stop", start) > start}
    duration, why_duration = STOP, "no FMU says how long; a guess"
    if stop is not None:
        duration, why_duration = difference(stop, start), why_stop
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
        h, why_step = min(usual_step, duration), "the usual one of its rows"
    else:  # rounded down to 1, 2 or 5 × 10^n
        why_step, guess = "no FMU says how fine; a guess", duration / STEPS
        power = 10.0 ** math.floor(math.log10(guess) + 1e-9)
        h = float(f"{max(m * power for m in (1, 2, 5) if m * power <= guess * (1 + 1e-9)):.12g}")
    if step is not None and h > duration * (1 + SLACK):
        text = f"--step {h:g}: is longer than the run, {duration:g} s ({why_duration}); give a shorter one"
        raise InputError.at(parts[0].path, f"{text}, or a later --stop")
    count = max(1, math.ceil(duration / h - SLACK))
    if stop is None and count > most:
        why_duration = f"{most} steps; {why_duration} would be {duration:g} s"
        count, duration = most, most * h
    notes, end = list[str](), start + duration
    if stop is not None and step is None and not own:
        fitting = duration / count
        if abs(fitting - h) > SLACK * h:
            notes.append(Note(f"the step is {fitting:g} s, not {h:g} s ({why_step}), to end at {end:g} s"))
            why_step = f"{count} to the end; not {h:g} s, {why_step}"
        h = fitting
    else:
        own = {n: required for n, required in own.items() if required > h * (1 + SLACK)}
        whole = float(f"{count * h:.12g}")
        if abs(whole - duration) > SLACK * duration:
            text = f"the run ends at {start + whole:g} s, not at {end:g} s ({why_duration})"
            notes.append(Note(f"{text}: in whole steps of {h:g} s ({why_step})"))
            why_duration = f"whole steps; {why_duration} is {duration:g} s"
        duration = whole
    why_start = why_start or "of the default experiments"
    return Times(start, duration, h, own, why_duration, why_step, why_start, tuple(notes))


def _own_step(part: DraftPart) -> float:
    """Return an FMU's required communication step [s], 0 if it accepts any step."""
    parameter = sampled_by(part.path)
    if parameter is not None:
        declared = next((v.start for v in part.description.modelVariables if v.name == parameter), None)
        return float(part.start.get(parameter, declared) or 0.0)
    return 0.0 if takes_any_step(part.description) else experiment_of(part.description).get("step", 0.0)
