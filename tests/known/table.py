"""A case of the table: a system, its answer with the source, and the runs that must give it."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.core.errors import SimulationError
from tests.known.kit import Model, Way

WAYS: tuple[Way, ...] = ("cs", "me")
ALGORITHMS = ("gauss-seidel", "jacobi")
Kinds = Sequence[tuple[int, Way]]  # version of FMI and interface
ALL: Kinds = [(version, way) for version in (1, 2, 3) for way in WAYS]
EXCHANGE, THREE, OTHERS = ALL[1::2], (ALL[1], ALL[2], ALL[5]), (ALL[0], ALL[3], ALL[4])
Door = Callable[[Any, Path], Any]  # scenario, folder for files → a run, or name → value


@dataclass(frozen=True)
class Answer:
    """A value of a signal.

    Attributes:
        time: Time of the row [s]; None for the whole column, or for a value that is no signal.
        tolerance: Largest absolute difference; 0 for equality.
    """

    signal: str
    time: float | None
    value: Any
    tolerance: float


@dataclass(frozen=True)
class Run:
    """A run of a scenario; what can be called in a component writes a file into a folder and returns its name."""

    content: Mapping[str, Any]
    door: Door

    def written(self, folder: Path) -> dict[str, Any]:
        """Return the scenario, with its files written."""
        components = {
            name: {key: value(folder) if callable(value) else value for key, value in component.items()}
            for name, component in self.content["components"].items()
        }
        return {**self.content, "components": components}

    def __call__(self, folder: Path) -> Any:
        return self.door(self.written(folder), folder)


@dataclass(frozen=True)
class Case:
    """A system with a known answer.

    Attributes:
        system: The system in a sentence.
        source: The answer and its source.
        runs: A run, or variant → run; all of them give the answers.
        fmpy: "same", or where FMPy gives another number, which one, and why; nothing where it cannot run the last run.
        later: Issue that mends a wrong number of today.
    """

    name: str
    system: str
    source: str
    runs: Callable[[Path], Any] | Mapping[str, Callable[[Path], Any]]
    answers: Sequence[Answer]
    fmpy: str = ""
    later: str = ""

    @property
    def variants(self) -> Mapping[str, Callable[[Path], Any]]:
        """Return the runs by their variants."""
        return self.runs if isinstance(self.runs, Mapping) else {"": self.runs}


def value_of(outcome: Any, answer: Answer) -> Any:
    """Return the value that a run has in the place of an answer."""
    if isinstance(outcome, Mapping):
        return outcome[answer.signal]
    exact = outcome.results.exact.get(answer.signal)
    column = outcome[answer.signal] if exact is None else exact
    if answer.time is None:
        return column
    row = int(np.argmin(np.abs(outcome.time - answer.time)))
    spacing = max(1e-9, 4 * float(np.spacing(abs(answer.time))))
    assert abs(outcome.time[row] - answer.time) <= spacing, f"no row at {answer.time} s: {outcome.time[row]} s"
    return column[row]


def check(outcome: Any, answer: Answer) -> None:
    """Compare a run with an answer."""
    value, wanted = value_of(outcome, answer), answer.value
    place = f"{answer.signal}({answer.time})"
    if answer.tolerance == 0:
        same = list(value) == list(wanted) if isinstance(wanted, list | np.ndarray) else value == wanted
        assert same, f"{place} is {value!r}; right is {wanted!r}"
        return
    assert np.shape(value) == np.shape(wanted), f"{place} has shape {np.shape(value)}"
    error = np.max(np.abs(np.asarray(value, float) - np.asarray(wanted, float)))
    assert error <= answer.tolerance, f"{place} is {value}; right is {wanted}; off by {error:.3g}"


def at(time: float | None, tolerance: float = 1e-9, **values: Any) -> list[Answer]:
    """Return answers at a time, or of columns; a name `m_x` means the signal m.x."""
    return [Answer(name.replace("_", ".", 1), time, value, tolerance) for name, value in values.items()]


def found(values: Mapping[str, Any], tolerance: float = 1e-9) -> list[Answer]:
    """Return answers of columns and other values by their names."""
    return [Answer(name, None, value, tolerance) for name, value in values.items()]


# -- runs -------------------------------------------------------------------------------------------


def simulated(content: Any, _: Path) -> Any:
    """Run one FMU with an input file or until the end by `cosim.simulate`."""
    part_, *sources = content["components"].values()
    ends = {"input": sources[0]["file"]} if sources else {"stop": content["duration"]}
    return cosim.simulate(part_["fmu"], set=part_.get("start"), step=content["step"], **ends)


def failing(content: Any, folder: Path) -> dict[str, int]:
    """Return the exit code of a run that does not come to its end."""
    with pytest.raises(SimulationError) as error:
        cosim.run(content, folder / "out")
    return {"exit code": error.value.exit_code}


def run(
    components: Mapping[str, Mapping[str, Any]],
    connections: str | Mapping[str, Mapping[str, Any]] = "",
    duration: float = 2,
    step: Any = 0.1,
    door: Door = lambda content, _: cosim.run(content),
    **keys: Any,
) -> Run:
    """Return a run; connections are `a.y > b.u, b.y > c.u`, or such texts with the keys of each."""
    if isinstance(connections, str):
        connections = {text: {} for text in connections.split(", ") if text}
    wires = [
        {**dict(zip(("from", "to"), text.split(" > "), strict=True)), **more} for text, more in connections.items()
    ]
    head = {"name": "known", "duration": duration, "step": step, "components": components, "connections": wires}
    return Run(head | keys, door)


def part(model: Model, version: int = 2, way: Way = "cs", **keys: Any) -> dict[str, Any]:
    """Return a component."""
    return {"fmu": lambda _: str(model.fmu(version, way))} | keys


def table(path: Path, header: str, *rows: Sequence[object]) -> str:
    """Write a CSV file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        writer.writerows(rows)
    return str(path)


def recorded(header: str, *rows: Sequence[object], **keys: Any) -> dict[str, Any]:
    """Return the block of a recording."""
    return {"block": "playback", "file": lambda folder: table(folder / "u.csv", header, *rows)} | keys


def reference(start: float, *changes: Mapping[str, Any], **keys: Any) -> dict[str, Any]:
    """Return the block of a reference u."""
    return {"block": "reference", "signals": {"u": {"start": start, "changes": list(changes)} | keys}}


def put(
    way: str, component: dict[str, Any], values: Mapping[str, Any], time: float = 0,
    before: Mapping[str, Any] | None = None, **keys: Any,
) -> Run:  # fmt: skip
    """Return the run of a component m whose inputs get values in `start`, or from a time on by another way."""
    if way == "start":
        return run({"m": component | {"start": values}}, **keys)
    if way == "event":
        return run({"m": component}, events=[{"at": time, "set": {f"m.{n}": v for n, v in values.items()}}], **keys)
    first, last = ([int(v) if v is True else v for v in row.values()] for row in (before or values, values))
    source = recorded(",".join(["time", *values]), (keys.get("start_time", 0), *first), (time, *last))
    if way == "reference":
        source = reference(first[0], {"at": time, "to": last[0]})
    return run({"m": component, "r": source}, ", ".join(f"r.{n} > m.{n}" for n in values), **keys)


def jump(
    component: dict[str, Any], way: str, time: float = 1, before: float = 0, after: float = 1, **keys: Any
) -> Run:  # fmt: skip
    """Return the run of a component m whose input u jumps."""
    return put(way, component, {"u": after}, time, {"u": before}, **keys)


def everywhere(
    model: Model, kinds: Kinds = THREE, duration: float = 1, step: float = 0.1, *, tolerance: float = 1e-10,
    of_part: Mapping[str, Any] | None = None, **keys: Any,
) -> dict[str, Run]:  # fmt: skip
    """Return the runs of a model by several interfaces."""
    return {
        f"FMI {version} {way}": run(
            {"m": part(model, version, way, **of_part or {})}, "", duration, step, tolerance=tolerance, **keys
        )
        for version, way in kinds
    }


def solved(model: Model, duration: float, step: float, tolerance: float = 1e-10, **keys: Any) -> dict[str, Run]:
    """Return the runs of model exchange by both solvers."""
    return {
        solver: run({"m": part(model, 2, "me", solver=solver, **keys)}, "", duration, step, tolerance=tolerance)
        for solver in ("cvode", "solve_ivp")
    }
