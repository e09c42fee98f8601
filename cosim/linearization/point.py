"""Option `--at`: values of states and inputs, or times of a scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, refuse
from cosim.base.units import read_quantity
from cosim.linearization.linear_model import Point
from cosim.linearization.linear_sources import LinearizableSystem
from cosim.storage.yaml_file import did_you_mean, short

SCENARIOS = {".yaml", ".yml", ".json", ".ssp", ".ssd"}
MAX_TIMES = 100_000
AT = Path("--at")


@dataclass(frozen=True)
class LinearizationTimes:
    """Times of a scenario's run at which a model is linearized [s]."""

    scenario: Path
    times: Array


@dataclass(frozen=True)
class Where:
    """Content of `--at`: values by name, which override those of the moment or the start."""

    values: Mapping[str, str]
    moment: LinearizationTimes | None


def read_at(texts: Sequence[str]) -> Where:
    """Return the values and the moment of `--at` texts.

    Forms: `NAME=VALUE[,NAME=VALUE …]` and at most one `SCENARIO@TIME` or `SCENARIO@START:STOP:STEP`.

    Raises:
        InputError: Every invalid text.
    """
    values: dict[str, str] = {}
    moments: list[LinearizationTimes] = []
    faults: list[str] = []
    for text in texts:
        head, at, tail = text.rpartition("@")
        if at and (Path(head).suffix.lower() in SCENARIOS or "=" not in head):
            try:
                moments.append(LinearizationTimes(Path(head), _times(tail)))
            except ValueError as error:
                faults.append(f"{short(text)}: {error}")
            continue
        for part in text.split(","):
            name, _, value = (piece.strip() for piece in part.partition("="))
            if not (name and value):
                faults.append(
                    f"{short(text)} is neither NAME=VALUE of a state or input, such as level=0.5, nor "
                    "SCENARIO.yaml@TIME"
                )
                break
            if name in values:
                faults.append(f"{name} is given twice, {short(values[name])} and {short(value)}; give it once")
            values.setdefault(name, value)
    if len(moments) > 1:
        faults.append(f"{len(moments)} scenarios are named; name one")
    refuse(Fault(AT, 0, 0, fault) for fault in faults)
    return Where(values, moments[0] if moments else None)


def _times(text: str) -> Array:
    try:
        first, *more = (read_quantity(part, "s") for part in text.split(":"))
    except ValueError:
        more = [math.nan]
    if len(more) not in {0, 2}:
        raise ValueError("write a time after @, such as 2.5 or 3 min, or several as START:STOP:STEP, such as 0:10:0.5")
    if not more:
        return np.array([first])
    last, step = more
    if not (last >= first and step > 0.0):
        raise ValueError("STOP of START:STOP:STEP is before START, or STEP is not above 0; write times that go forward")
    count = math.floor((last - first) / step + 1e-9) + 1
    if count > MAX_TIMES:
        raise ValueError(f"{count} times are more than {MAX_TIMES}; take a longer step")
    return np.asarray(first + step * np.arange(count))


def move(source: LinearizableSystem, point: Point, values: Mapping[str, str]) -> Point:
    """Return the point with states and inputs of `--at`.

    Raises:
        InputError: Every unknown name and unsuitable value.
    """
    states, inputs, faults = point.states.copy(), point.inputs.copy(), []
    lists = {group: ", ".join(getattr(source, group)) or "none" for group in ("states", "inputs")}
    for name, text in values.items():
        if name not in (names := (*source.states, *source.inputs)):
            cure = did_you_mean(name, names)
            faults.append(
                '{model} has no state or input "{name}"{cure} (states: {states}; inputs: {inputs})'.format(
                    model=source.title, name=name, cure=cure, **lists
                )
            )
            continue
        try:
            value = read_quantity(text, source.units.get(name, ""))
        except ValueError as error:
            faults.append(f"{name}={short(text)}: {error}")
            continue
        if name in source.states:
            states[source.states.index(name)] = value
        if name in source.inputs:
            inputs[source.inputs.index(name)] = value
    refuse(Fault(AT, 0, 0, fault) for fault in faults)
    return replace(point, states=states, inputs=inputs)
