"""Inputs of recorded runs: parameters, FMUs, scenario values, seed and versions, and the differences between runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

OWN = ("fmu", "log", "logs", "sealed", "start", "given", "study", "sweep", "a", "b", "tolerance")  # without a scenario
UNCHANGED = {"sha256", "name", "description"}  # keys of a scenario that are no inputs
PARAMETER, FMU, SCENARIO, SEED, VERSION = "parameter", "FMU", "scenario", "seed", "version"
KINDS = (PARAMETER, SCENARIO, FMU, SEED, VERSION)  # the order of a label and of a table
MOST_IN_LABEL = 3  # inputs
DIGITS = 12  # of a SHA-256
LONGEST = 24  # characters of a value in a label


@dataclass(frozen=True)
class DifferingInput:
    """An input whose value is not the same in all runs.

    Attributes:
        kind: parameter, scenario, FMU, seed or version.
        values: Value in each run; None if the run does not have the input.
    """

    kind: str
    name: str
    values: tuple[Any, ...]


def input_leaves(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return path → value of the inputs in a command's record: scenario, files and settings."""
    scenario, leaves = record.get("scenario"), dict[str, Any]()
    tree = {**(scenario if isinstance(scenario, dict) else {}), **{key: record[key] for key in OWN if key in record}}
    _add_leaves(tree, "", leaves)
    return leaves


def changes_between(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Return path → value of the inputs that differ; None for a removed input."""
    changed = {path: value for path, value in after.items() if path not in before or before[path] != value}
    return changed | {path: None for path in before if path not in after}


def differing_inputs(records: Sequence[Mapping[str, Any]]) -> list[DifferingInput]:
    """Return the inputs that differ between recorded runs, those of a label first.

    Runs without a record, for example tables of other tools, have no inputs and are not compared.
    """
    inputs = [_inputs(record) for record in records]
    recorded = [each for each in inputs if each]
    names = dict.fromkeys(name for each in recorded for name in each)
    differing = [name for name in names if any(each.get(name) != recorded[0].get(name) for each in recorded)]
    rows = [DifferingInput(*name, tuple(each.get(name) for each in inputs)) for name in differing]
    return sorted(rows, key=lambda row: KINDS.index(row.kind))


def labels_of(
    names: Sequence[str],
    inputs: Sequence[DifferingInput],
    *,
    unique: Sequence[str],
    longer: Sequence[str] = (),
    baseline: int | None = None,
) -> list[str]:
    """Return a label that differs from all others for each run: `run 3 (mass = 440)`.

    Args:
        baseline: Index of a run whose inputs are not repeated in the labels of runs that have the same.
        unique: A text for each run, such as its path, that tells runs with equal labels apart.
        longer: Labels of runs without an input that differs, by default their names.
    """
    listed = [row for row in inputs if row.kind != VERSION]
    labels = []
    for k, name in enumerate(names):
        chosen = [row for row in listed if baseline in {None, k} or row.values[k] != row.values[baseline]]
        rows = [row for row in chosen if row.values[k] is not None][:MOST_IN_LABEL]
        texts = [f"{row.name} = {_short_value(row.values[k])}" for row in rows]
        labels.append(f"{name} ({', '.join(texts)})" if texts else (longer or names)[k])
    return [f"{t}, {u}" if labels.count(t) > 1 else t for t, u in zip(labels, unique, strict=True)]


def short_input(path: str) -> str:
    """Return an input without the parts of its path that every component has."""
    return path.removeprefix("components.").replace(".start.", ".")


def input_text(value: Any) -> str:
    """Return the value of an input as text, a dash if there is none."""
    if value is None:
        return "–"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _short_value(value: Any) -> str:
    text = input_text(value)
    name = text.rpartition("/")[2] if text.startswith("/") else text
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"


def _inputs(record: Mapping[str, Any]) -> dict[tuple[str, str], Any]:
    """Return (kind, name) → value of all inputs in a record."""
    inputs = {(_kind_of(path), short_input(path)): value for path, value in input_leaves(record).items()}
    for name, fmu in _mapping(record.get("fmus")).items():
        inputs[FMU, f"{name}.sha256"] = str(_mapping(fmu).get("sha256", ""))[:DIGITS]
    if not inputs:
        return {}
    versions = {"cosim": record.get("cosim_version"), **_mapping(record.get("versions"))}
    versions["cosim revision"] = _mapping(record.get("git")).get("revision")
    return inputs | {(VERSION, name): text for name, text in versions.items() if text is not None}


def _kind_of(path: str) -> str:
    parts = path.split(".")
    if parts[0] != "components":
        return {"seed": SEED, "fmu": FMU, "start": PARAMETER}.get(parts[0], SCENARIO)
    return PARAMETER if "start" in parts[2:3] else FMU if parts[2:3] == ["fmu"] else SCENARIO


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _add_leaves(value: Any, place: str, leaves: dict[str, Any]) -> None:
    """Add each scalar and each list of scalars in a nested value under its path."""
    if isinstance(value, dict):
        start = f"{place}." if place else ""
        for key, each in value.items():
            if isinstance(each, (dict, list)):
                _add_leaves(each, f"{start}{key}", leaves)
            elif key not in UNCHANGED:
                leaves[f"{start}{key}"] = each
    elif isinstance(value, list) and any(isinstance(each, (dict, list)) for each in value):
        for number, each in enumerate(value):
            _add_leaves(each, f"{place}[{number}]", leaves)
    else:
        leaves[place] = value
