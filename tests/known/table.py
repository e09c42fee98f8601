"""A case of the table: a system, its answer with the source, and the runs that must give it."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import cosim
from tests.known.kit import Model, Way

KINDS = (
    "source", "coupling", "interface", "event", "unit", "type", "step control", "loop", "start time", "multi-rate",
    "SSP", "verb",
)  # fmt: skip
Run = Callable[[Path], Any]  # folder for files → a run, or name → value


@dataclass(frozen=True)
class Answer:
    """A value of a signal.

    Attributes:
        time: Time of the row [s]; None for the whole column, or for a value that is no signal.
        value: The right value, or the function that computes it.
        tolerance: Largest absolute difference; 0 for equality.
    """

    signal: str
    time: float | None
    value: Any
    tolerance: float = 1e-9


@dataclass(frozen=True)
class Peer:
    """A run of one FMU by FMPy, with the arguments of its `simulate_fmu`."""

    fmu: Callable[[], Path]
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A system with a known answer.

    Attributes:
        system: The system in a sentence.
        source: The answer and its source.
        runs: Variant → run; all of them give the answers.
        because: Reason for the size of the tolerances.
        differs: Where FMPy gives another number, which one, and why.
        later: Issue that mends a wrong number of today.
    """

    name: str
    kind: str
    system: str
    source: str
    runs: Mapping[str, Run]
    answers: Sequence[Answer]
    because: str = "rounding"
    peer: Peer | None = None
    differs: str = ""
    later: str = ""


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
    value = value_of(outcome, answer)
    wanted = answer.value() if callable(answer.value) else answer.value
    place = f"{answer.signal}({answer.time})"
    if answer.tolerance == 0:
        same = list(value) == list(wanted) if isinstance(wanted, list | np.ndarray) else value == wanted
        assert same, f"{place} is {value!r}; right is {wanted!r}"
        return
    assert np.shape(value) == np.shape(wanted), f"{place} has shape {np.shape(value)}"
    error = np.max(np.abs(np.asarray(value, float) - np.asarray(wanted, float)))
    assert error <= answer.tolerance, f"{place} is {value}; right is {wanted}; off by {error:.3g}"


def at(time: float, tolerance: float = 1e-9, **values: Any) -> list[Answer]:
    """Return answers at a time; a name `m_x` means the signal m.x."""
    return [Answer(name.replace("_", ".", 1), time, value, tolerance) for name, value in values.items()]


def scenario(
    components: Mapping[str, Any],
    connections: Sequence[str | Mapping[str, Any]] = (),
    duration: float = 2,
    step: Any = 0.1,
    **keys: Any,
) -> dict[str, Any]:
    """Return a scenario; a connection may be the text `a.y > b.u`."""
    wires = [
        dict(zip(("from", "to"), c.split(" > "), strict=True)) if isinstance(c, str) else dict(c) for c in connections
    ]
    more = {"connections": wires} if wires else {}
    return {"name": "known", "duration": duration, "step": step, "components": dict(components)} | more | keys


def runs(content: Callable[[Path], Mapping[str, Any]]) -> Run:
    """Return the run of the scenario that a function makes, which may write files into a folder."""
    return lambda folder: cosim.run(content(folder))


def part(model: Model, version: int = 2, way: Way = "cs", **keys: Any) -> dict[str, Any]:
    """Return a component."""
    return {"fmu": str(model.fmu(version, way))} | keys


def table(path: Path, header: str, *rows: Sequence[object]) -> str:
    """Write a CSV file."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        writer.writerows(rows)
    return str(path)
