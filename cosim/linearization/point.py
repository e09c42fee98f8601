"""Option `--at`: values of states and inputs, or times of a scenario's run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, SimulationError, refuse
from cosim.core.scratch import temporary_folder
from cosim.core.text import as_yaml, did_you_mean
from cosim.core.times import rounding, roundings
from cosim.core.units import read_quantity
from cosim.files.results import Results
from cosim.files.yaml_file import short
from cosim.linearization.linear_model import Point
from cosim.linearization.sources import EquationSource, Source
from cosim.model.integrate import Stepper
from cosim.simulation.workflow import run

MAX_OUTPUT_DIFFERENCE = 1e-6  # largest difference between model and component, relative to the output's range
MAX_MISSING_NAMES = 8  # signals listed in a message
SCENARIOS = {".yaml", ".yml", ".json", ".ssp", ".ssd"}
MAX_TIMES = 100_000
AT_OPTION = Path("--at")


def read_at(texts: Sequence[str]) -> tuple[Mapping[str, str], Path | None, Array]:
    """Parse the texts of `--at`.

    Forms: `NAME=VALUE[,NAME=VALUE …]` and at most one `SCENARIO@TIME` or `SCENARIO@START:STOP:STEP`.

    Returns:
        Values by name, which override those of the scenario; the scenario, if any; its times [s].

    Raises:
        InputError: Texts are invalid; the error names all of them.
    """
    values: dict[str, str] = {}
    moments: list[tuple[Path, Array]] = []
    faults: list[str] = []
    for text in texts:
        head, at, tail = text.rpartition("@")
        if at and (Path(head).suffix.lower() in SCENARIOS or "=" not in head):
            numbers = list[float]()
            with suppress(ValueError):
                numbers = [read_quantity(part, "s") for part in tail.split(":")]
            if len(numbers) == 1:
                numbers = [*numbers, *numbers, 1.0]
            first, last, step = numbers if len(numbers) == 3 else (1.0, 0.0, 1.0)
            if not (last >= first and step > 0.0 and last - first < MAX_TIMES * step):
                forms = "a time after @, such as 2.5 or 3 min, or START:STOP:STEP, such as 0:10:0.5"
                faults.append(f"{short(text)}: write {forms}, with at most {MAX_TIMES} increasing times")
            else:
                number = np.arange(math.floor((last - first) / step + 1e-9) + 1)
                moments.append((Path(head), np.asarray(first + step * number)))
            continue
        for part in text.split(","):
            name, _, value = (piece.strip() for piece in part.partition("="))
            if not (name and value) or name in values:
                forms = "give NAME=VALUE once for a state or input, such as level=0.5, or SCENARIO.yaml@TIME"
                faults.append(f"{short(text)}: {forms}")
                break
            values[name] = value
    if len(moments) > 1:
        faults.append(f"{len(moments)} scenarios are given; give one")
    refuse(Fault(AT_OPTION, 0, 0, fault) for fault in faults)
    return values, *(moments[0] if moments else (None, np.zeros(0)))


def move(source: Source, point: Point, values: Mapping[str, str]) -> Point:
    """Return the point with the states and inputs set by `--at`.

    Raises:
        InputError: Names are unknown or values invalid; the error names all of them.
    """
    states, inputs, faults = point.states.copy(), point.inputs.copy(), []
    lists = "; ".join(f"{group}: {', '.join(getattr(source, group)) or 'none'}" for group in ("states", "inputs"))
    for name, text in values.items():
        if name not in (names := (*source.states, *source.inputs)):
            faults.append(f'{source.title} has no state or input "{name}"{did_you_mean(name, names)} ({lists})')
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
    refuse(Fault(AT_OPTION, 0, 0, fault) for fault in faults)
    return replace(point, states=states, inputs=inputs)


def points_along(
    source: Source, scenario: Path, times: Array, component: str, over: Sequence[str]
) -> tuple[Source, list[Point], list[str]]:
    """Return the source with a scenario's parameters, a point for each time of its run, and notes.

    The model replaces a component of the scenario. A model with equations is simulated with the recorded inputs of this
    component; an FMU is simulated in the scenario.

    Args:
        component: Name in the scenario if several components have the model's inputs and outputs.
        over: Parameters that override those of the scenario.
    """
    with temporary_folder("linearize") as folder:
        results, manifest = _run(scenario, folder)
        columns, signals = set(results.columns), (*source.inputs, *source.outputs)
        owners = [component] if component else dict.fromkeys(column.partition(".")[0] for column in results.columns)
        fitting = [owner for owner in owners if columns.issuperset(f"{owner}.{signal}" for signal in signals)]
        if len(fitting) != 1:
            text = f"the components of {scenario} with all inputs and outputs of {source.title}"
            text += f" ({', '.join(signals[:MAX_MISSING_NAMES])}{', …' * (len(signals) > MAX_MISSING_NAMES)})"
            cure = "choose one with --component NAME, or another scenario"
            raise InputError.at(AT_OPTION, f"{text} are: {', '.join(fitting) or 'none'}; {cure}")
        (name,) = fitting
        if source.states and not isinstance(source, EquationSource):
            states = [f"{name}.{state}" for state in source.states]
            record = as_yaml([*(manifest["scenario"].get("record") or ()), *states])
            fmu = json.dumps(str(source.files[0].resolve()))
            results, manifest = _run(scenario, folder, [f"record={record}", f"components.{name}.fmu={fmu}"])
    start = dict(manifest["scenario"]["components"].get(name, {}).get("start") or {})
    source, time, notes = source.with_values(start, over), results.time, list[str]()
    outside = (times < time[0] - rounding(float(time[0]))) | (times > time[-1] + rounding(float(time[-1])))
    if outside.any():
        text = f"{times[outside][0]:g} s is outside the run of {scenario} from {time[0]:g} to {time[-1]:g} s"
        raise InputError.at(AT_OPTION, text)
    step = float(np.min(np.diff(time), initial=1.0))
    rows = np.searchsorted(time, times + roundings(times, step), side="right") - 1
    if (np.abs(time[rows] - times) > roundings(times, 1e3 * step)).any():
        notes.append("each time is moved to the communication point before it")
    inputs = _columns(results, name, source.inputs)
    if isinstance(source, EquationSource):
        values, outputs = _simulate(source, start, time[: max(rows) + 1], inputs)
        recorded = _columns(results, name, source.outputs)[: len(outputs)]
        difference = np.abs(recorded - outputs).max(axis=0)
        span = np.maximum(np.ptp(recorded, axis=0), 1e-3)
        worst = int(np.argmax(difference / span))
        if difference[worst] > MAX_OUTPUT_DIFFERENCE * span[worst]:
            output = source.outputs[worst]
            size = f"{difference[worst]:.3g} {source.units.get(output, '')}".rstrip()
            notes.append(
                f"{name} of the scenario differs from this model: with the same inputs, {output} differs by up to "
                f"{size}; linearize the model from which its FMU was built, with the same parameters"
            )
    else:
        values = _columns(results, name, source.states)
        if names := ", ".join(np.array(source.states)[np.isnan(values).all(axis=0)]):
            raise InputError.at(
                AT_OPTION,
                f"the run of {scenario} has no values of {name}: {names}; give its operating point as NAME=VALUE",
            )
    return source, [Point(float(time[k]), values[k], inputs[k]) for k in rows], notes


def _columns(results: Results, component: str, names: Sequence[str]) -> Array:
    """Return signals of a component as columns; NaN for signals that are not recorded."""
    empty = np.full(len(results.time), np.nan)
    columns = [results[c] if (c := f"{component}.{name}") in results else empty for name in names]
    return np.stack(columns, axis=1) if columns else np.empty((len(empty), 0))


def _simulate(source: EquationSource, start: Mapping[str, Any], time: Array, inputs: Array) -> tuple[Array, Array]:
    """Return the states and outputs of the model, simulated with the inputs."""
    stepper = Stepper(source.model)
    memories = {f"{e.name}.{q.name}": q.unit for e in source.model.awake for q in e.memory}
    units = {**memories, **{n: source.units[n] for n in source.states}}
    starts = {n.removesuffix("_start"): str(v) for n, v in start.items() if n.endswith("_start")}
    moment = stepper.start(float(time[0]), {n: read_quantity(v, units[n]) for n, v in starts.items() if n in units})
    states, outputs = [], []
    for k in range(len(time)):
        if k:
            command, length = tuple(inputs[k - 1].tolist()), float(time[k] - time[k - 1])
            moment = source.computed(float(time[k]), stepper.step, moment, command, length)
        states.append(np.array(moment.state, float))
        outputs.append(source.evaluate(float(time[k]), states[k], inputs[k])[len(source.states) :])
    return np.array(states), np.array(outputs)


def _run(scenario: Path, folder: Path, overrides: Sequence[str] = ()) -> tuple[Results, Mapping[str, Any]]:
    try:
        outcome = run(scenario, folder, overrides, report=False, force=True)
    except SimulationError as error:
        error.left = None  # the temporary folder is deleted
        raise
    return outcome.results, outcome.manifest
