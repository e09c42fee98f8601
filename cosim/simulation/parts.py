"""FMUs of a scenario that is not written yet: their names there, and when and how finely they run."""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.blocks.description import takes_any_step
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.interface import Signal
from cosim.blocks.summary import experiment_of, read_fmus
from cosim.simulation.matching import Port
from fmus.sampled import sampled_by

STOP, STEPS = 1.0, 500  # [s] where no FMU says how long; steps where none says how fine
LONGEST = 24  # characters of a component's name, which is read in every signal
SPELT = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "ø": "o", "Ø": "O"})
MOST_STEPS = 20_000  # of a first run, which is to answer soon


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

    @property
    def sizes(self) -> dict[str, int]:
        """Its arrays, `component.variable` → number of elements."""
        block = self.block
        every = (*block.inputs, *block.exact_inputs, *block.outputs, *block.exact_outputs)
        return dict(Counter(f"{self.name}.{s.array}" for s in every if s.array and not s.local))


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


def component_name(stem: str, model: str = "") -> str:
    """What an FMU is called: its file's name; where that is long, the last part of its model's name, shortened."""
    name = _identifier(stem)
    if len(name) > LONGEST:
        name = _identifier(model.rpartition(".")[2]) or name
    if len(name) > LONGEST:
        whole = name.rfind("_", LONGEST // 2, LONGEST + 1)  # between words
        name = name[: whole if whole > 0 else LONGEST]
    return (f"fmu_{name}" if name[:1].isdigit() else name) or "fmu"


def _identifier(text: str) -> str:
    """Letters of ASCII, digits and underscores: accents are left off, ä is ae."""
    plain = unicodedata.normalize("NFKD", text.translate(SPELT))
    return re.sub(r"[\W_]+", "_", "".join(c for c in plain if not unicodedata.combining(c)), flags=re.ASCII).strip("_")


def parts_of(paths: Sequence[Path], start: Mapping[str, Any] | None = None) -> list[Part]:
    """FMUs with names that a scenario takes, each its own; InputError with what is wrong with every one."""
    found: list[Part] = []
    for path, description in zip(paths, read_fmus(paths), strict=True):
        stem = component_name(path.stem, description.modelName or "")
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
