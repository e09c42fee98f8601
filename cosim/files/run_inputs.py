"""Inputs of recorded runs: parameters, FMUs, scenario values, seed and versions, and the differences between runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

# keys of records without a scenario
RECORD_KEYS = ("fmu", "log", "logs", "sealed", "start", "given", "study", "sweep", "a", "b", "tolerance")
IGNORED_KEYS = {"sha256", "name", "description"}  # keys of a scenario that are no inputs
PARAMETER, FMU, SCENARIO, SEED, VERSION = "parameter", "FMU", "scenario", "seed", "version"
INPUT_KINDS = (PARAMETER, SCENARIO, FMU, SEED, VERSION)  # the order of a label and of a table
MOST_IN_LABEL = 3  # inputs
HASH_DIGITS = 12  # of a SHA-256
MAX_LABEL_CHARACTERS = 24  # characters of a value in a label


@dataclass(frozen=True)
class DifferingInput:
    """An input whose value differs between runs.

    Attributes:
        kind: Kind of the input: parameter, scenario, FMU, seed or version.
        values: Value in each run; None if the run does not have the input.
    """

    kind: str
    name: str
    values: tuple[Any, ...]


def input_leaves(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the inputs in a command's record (scenario, files and settings) as path → value."""
    scenario = record.get("scenario")
    tree = {
        **(scenario if isinstance(scenario, dict) else {}),
        **{key: record[key] for key in RECORD_KEYS if key in record},
    }
    return dict(_leaves(tree, ""))


def _leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Yield the path and value of each scalar, and of each list of scalars, in a nested value."""
    if isinstance(value, dict):
        for key, each in value.items():
            if isinstance(each, (dict, list)) or key not in IGNORED_KEYS:
                yield from _leaves(each, f"{place}.{key}" if place else key)
    elif isinstance(value, list) and any(isinstance(each, (dict, list)) for each in value):
        for number, each in enumerate(value):
            yield from _leaves(each, f"{place}[{number}]")
    else:
        yield place, value


def changes_between(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Return path → value of the inputs that differ; None for an input that only `before` has."""
    changed = {path: value for path, value in after.items() if path not in before or before[path] != value}
    return changed | {path: None for path in before if path not in after}


def differing_inputs(records: Sequence[Mapping[str, Any]]) -> list[DifferingInput]:
    """Return the inputs that differ between recorded runs, in the order of INPUT_KINDS.

    Runs without a record, for example tables of other tools, have no inputs and are not compared.
    """
    inputs: list[dict[tuple[str, str], Any]] = []
    for record in records:
        found: dict[tuple[str, str], Any] = {}
        for path, value in input_leaves(record).items():
            parts = path.split(".")
            kind = {"seed": SEED, "fmu": FMU, "start": PARAMETER}.get(parts[0], SCENARIO)
            if parts[0] == "components":
                kind = PARAMETER if parts[2:3] == ["start"] else FMU if parts[2:3] == ["fmu"] else SCENARIO
            found[kind, short_input(path)] = value
        fmus, versions, git = (
            each if isinstance(each := record.get(k), dict) else {} for k in ("fmus", "versions", "git")
        )
        for name, fmu in fmus.items():
            found[FMU, f"{name}.sha256"] = str(fmu.get("sha256", "") if isinstance(fmu, dict) else "")[:HASH_DIGITS]
        versions = {"cosim": record.get("cosim_version"), **versions, "cosim revision": git.get("revision")}
        if found:
            found |= {(VERSION, name): text for name, text in versions.items() if text is not None}
        inputs.append(found)
    recorded = [each for each in inputs if each]
    names = dict.fromkeys(name for each in recorded for name in each)
    differing = [name for name in names if any(each.get(name) != recorded[0].get(name) for each in recorded)]
    rows = [DifferingInput(*name, tuple(each.get(name) for each in inputs)) for name in differing]
    return sorted(rows, key=lambda row: INPUT_KINDS.index(row.kind))


def labels_of(
    names: Sequence[str],
    inputs: Sequence[DifferingInput],
    *,
    unique: Sequence[str],
    longer: Sequence[str] = (),
    baseline: int | None = None,
) -> list[str]:
    """Return a unique label for each run: `run 3 (mass = 440)`.

    Args:
        names: Short names of the runs.
        inputs: Inputs that differ between the runs.
        unique: Text for each run that is appended if labels would be equal, such as its path.
        longer: Labels of runs without a differing input, by default their names.
        baseline: Index of a run; inputs equal to those of this run are left out of the labels.
    """
    listed = [row for row in inputs if row.kind != VERSION]
    labels = []
    for k, name in enumerate(names):
        chosen = [row for row in listed if baseline in {None, k} or row.values[k] != row.values[baseline]]
        rows = [row for row in chosen if row.values[k] is not None][:MOST_IN_LABEL]
        values = [input_text(row.values[k]) for row in rows]
        shorts = [v.rpartition("/")[2] if v.startswith("/") else v for v in values]  # file names instead of paths
        texts = [
            f"{row.name} = {v if len(v) <= MAX_LABEL_CHARACTERS else f'{v[: MAX_LABEL_CHARACTERS - 1]}…'}"
            for row, v in zip(rows, shorts, strict=True)
        ]
        labels.append(f"{name} ({', '.join(texts)})" if texts else (longer or names)[k])
    return [f"{t}, {u}" if labels.count(t) > 1 else t for t, u in zip(labels, unique, strict=True)]


def short_input(path: str) -> str:
    """Return the path of an input without the leading parts that it shares with the inputs of all components."""
    return path.removeprefix("components.").replace(".start.", ".")


def input_text(value: Any) -> str:
    """Return the value of an input as text, or a dash if it is missing."""
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
