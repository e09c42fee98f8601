"""FMUs of a scenario draft: their component names, ports, and times of the run."""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cosim.authoring.matching import Port
from cosim.base.errors import InputError
from cosim.base.messages import Note
from cosim.base.times import difference
from cosim.blocks.component import Signal
from cosim.blocks.description import takes_any_step
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.summary import experiment_of, read_fmus
from cosim.fmi.sampled import sampled_by
from cosim.system.event_blocks import default_block

STOP, STEPS = 1.0, 500  # defaults without an FMU's declaration: duration [s], number of steps
LONGEST = 24  # characters of a component's name, which precedes every signal
SPELLING = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "ø": "o", "Ø": "O"}
)
MOST_STEPS = 20_000  # steps of a first run, which must answer soon
SLACK = 1e-9  # relative tolerance for a whole number of steps


@dataclass(frozen=True)
class DraftPart:
    """An FMU of a scenario draft: component name, description and start values."""

    name: str
    path: Path
    description: Any
    start: Mapping[str, Any] = field(default_factory=dict)

    @property
    def block(self) -> FmuBlock:
        """Return the FMU as an unconnected, unloaded block."""
        return default_block(self.path, self.description)(self.name, self.path, self.description, {}, frozenset())

    @property
    def ports(self) -> tuple[list[Port], list[Port]]:
        """Return inputs and outputs, with only the first element of arrays."""
        block = self.block
        both = (*block.inputs, *block.exact_inputs), (*block.outputs, *block.exact_outputs)
        order = {v.name: k for k, v in enumerate(self.description.modelVariables)}
        firsts: list[dict[str, Signal]] = [{}, {}]
        for side, signals in zip(firsts, both, strict=True):
            for signal in signals:
                if not signal.local:
                    side.setdefault(signal.array or signal.name, signal)
        inputs, outputs = (
            [(self.name, side[n]) for n in sorted(side, key=lambda n: order.get(n, 0))] for side in firsts
        )
        return inputs, outputs

    @property
    def sizes(self) -> dict[str, int]:
        """Return the number of elements of each array, by name `component.variable`."""
        block = self.block
        every = (*block.inputs, *block.exact_inputs, *block.outputs, *block.exact_outputs)
        return dict(Counter(f"{self.name}.{s.array}" for s in every if s.array and not s.local))


@dataclass(frozen=True)
class RequestedTimes:
    """Start, stop and step [s] requested by the user; None for the values of the FMUs.

    Attributes:
        usual_step: Step [s] if neither the user nor an FMU states one.
        because: Reason for the stop time, for the draft's comments.
    """

    start: float | None = None
    stop: float | None = None
    step: float | None = None
    usual_step: float | None = None
    because: str = "given"
    why_start: str = ""


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
    why_start: str = "of the default experiments"
    notes: tuple[str, ...] = ()


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
        parts.append(DraftPart(name, path, description, start or {}))
    return parts


def times_of(parts: Sequence[DraftPart], request: RequestedTimes | None = None, *, most: int = MOST_STEPS) -> Times:
    """Return start, duration and step of a run.

    A step that is requested or required by an FMU stays, and the end moves to a whole number of steps. Otherwise the
    end stays, and the step is shortened to fit.

    Args:
        most: Largest number of steps without a requested stop.

    Raises:
        InputError: A step exceeds the run.
    """
    request = request or RequestedTimes()
    experiments = {p.name: experiment_of(p.description) for p in parts}
    start, duration, why_duration = _span(request, experiments)
    own_steps = {p.name: own for p in parts if (own := _own_step(p)) > 0}
    h, why_step = _step(request, experiments, own_steps, duration)
    if request.step is not None and h > duration * (1 + SLACK):
        raise InputError.at(
            parts[0].path,
            (
                f"--step {h:g}: is longer than the run, {duration:g} s ({why_duration}); give a shorter one, or a "
                "later --stop"
            ),
        )
    steps = max(1, math.ceil(duration / h - SLACK))
    if request.stop is None and steps > most:
        why_duration = f"{most} steps; {why_duration} would be {duration:g} s"
        steps, duration = most, most * h
    times = Times(start, duration, h, own_steps, why_duration, why_step, request.why_start or Times.why_start)
    if request.stop is None or request.step is not None or own_steps:
        return _move_end(times, steps)
    return _shorten_step(times, steps)


def _span(request: RequestedTimes, experiments: Mapping[str, Mapping[str, float]]) -> tuple[float, float, str]:
    """Return the start and the duration of the run [s], and the reason for the duration as text."""
    start = min((e.get("start", 0.0) for e in experiments.values()), default=0.0)
    start = start if request.start is None else request.start
    ends = {name: e["stop"] for name, e in experiments.items() if e.get("stop", start) > start}
    duration, why = STOP, "no FMU says how long; a guess"
    if request.stop is not None:
        duration, why = difference(request.stop, start), request.because
    elif ends:
        longest = max(ends, key=lambda n: ends[n])
        duration, why = difference(ends[longest], start), f"the default experiment of {longest}"
    return start, float(f"{duration:.12g}"), why


def _move_end(t: Times, steps: int) -> Times:
    """Move the end to a whole number of steps."""
    t = replace(t, own={n: own for n, own in t.own.items() if own > t.step * (1 + SLACK)})
    duration = float(f"{steps * t.step:.12g}")
    if abs(duration - t.duration) <= SLACK * t.duration:
        return replace(t, duration=duration)
    note = Note(
        f"the run ends at {t.start + duration:g} s, not at {t.start + t.duration:g} s ({t.why_duration}): in "
        f"whole steps of {t.step:g} s ({t.why_step})"
    )
    why = f"whole steps; {t.why_duration} is {t.duration:g} s"
    return replace(t, duration=duration, why_duration=why, notes=(note,))


def _shorten_step(t: Times, steps: int) -> Times:
    """Shorten the step for a run of whole steps."""
    step = t.duration / steps
    if abs(step - t.step) <= SLACK * t.step:
        return replace(t, step=step)
    note = Note(f"the step is {step:g} s, not {t.step:g} s ({t.why_step}), to end at {t.start + t.duration:g} s")
    why = f"{steps} to the end; not {t.step:g} s, {t.why_step}"
    return replace(t, step=step, why_step=why, notes=(note,))


def _step(
    request: RequestedTimes,
    experiments: Mapping[str, Mapping[str, float]],
    own_steps: Mapping[str, float],
    duration: float,
) -> tuple[float, str]:
    """Return the desired step [s] before it is fitted to the duration, and its reason."""
    if request.step is not None:
        return request.step, "given"
    steps = {**{n: e["step"] for n, e in experiments.items() if e.get("step", 0.0) > 0}, **own_steps}
    if steps:
        finest = min(steps, key=lambda n: steps[n])
        return float(f"{steps[finest]:.12g}"), f"the step of {finest}"
    if request.usual_step is not None:
        return min(request.usual_step, duration), "the usual one of its rows"
    return _round(duration / STEPS), "no FMU says how fine; a guess"


def _own_step(part: DraftPart) -> float:
    """Return an FMU's required communication step [s], 0 if it accepts any step."""
    parameter = sampled_by(part.path)
    if parameter is not None:
        declared = next((v.start for v in part.description.modelVariables if v.name == parameter), None)
        return float(part.start.get(parameter, declared) or 0.0)
    return 0.0 if takes_any_step(part.description) else experiment_of(part.description).get("step", 0.0)


def _round(step: float) -> float:
    """Return a step rounded down to 1, 2 or 5 × 10^n."""
    power = 10.0 ** math.floor(math.log10(step) + 1e-9)
    return float(f"{max(m * power for m in (1, 2, 5) if m * power <= step * (1 + 1e-9)):.12g}")
