"""Whether a refine.json agrees with itself: its verdict with its grade, its claims, its numbers and its files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

CLAIMS = {"effect_found", "parameter_error", "sensor_error"}
FILES = {"claimed": ("model.yaml", "plant.fmu"), "other": ("model.yaml", "plant.fmu", "nearest.yaml", "nearest.fmu")}
NOISE = 0.03  # of the excess error: what replays by the kernel, as the verdict has them, and through the FMU may differ
PART = 0.1
Record = Mapping[str, Any]


def contradictions(record: Record, folder: Path | None = None) -> list[str]:
    """Return all contradictions within a record, and with the files beside it."""
    said = [text for rule in (_names, _intervals, _grade, _rivals, _left, _floors) for text in rule(record)]
    return said + (list(_files(record, folder)) if folder is not None else [])


def _claimed(record: Record) -> list[str]:
    return [e["name"] for e in record["effects"]]


def _names(record: Record) -> Iterator[str]:
    """Yield contradictions of claimed names with hidden names, ranking and sentence."""
    claimed = _claimed(record)
    if both := set(claimed) & set(record["hidden"]):
        yield f"claimed, and not to be seen: {sorted(both)}"
    ranked = [set(c["names"]) for c in record["candidates"] if c["why"] == "claimed"]
    if record["verdict"] in CLAIMS:  # base numbers may be fitted beside the claim
        ranked = [names - {n for n in record["inclusion"] if n not in claimed} for names in ranked]
    if ranked != ([set(claimed)] if claimed and record["verdict"] != "ambiguous" else []):
        yield f"claimed {claimed}, in the ranking {ranked}"
    if record["verdict"] in CLAIMS:
        yield from (f"{name} is claimed and not in the sentence" for name in claimed if name not in record["sentence"])


def _intervals(record: Record) -> Iterator[str]:
    """Yield estimates that are not in the middle of their interval, unless the sentence gives its limits."""
    for entry in record["effects"]:
        for name, p in entry["parameters"].items():
            low, high = p["ci95"]
            away = abs(p["value"] - 0.5 * (low + high))
            is_limit = re.search(rf"\b{name} (at most|at least|between) ", record["sentence"])
            if not (low <= p["value"] <= high if is_limit else away <= 1e-6 * (high - low) + 1e-12 * abs(p["value"])):
                yield f"{entry['name']}.{name} is {p['value']}, and its interval {p['ci95']}"


def _grade(record: Record) -> Iterator[str]:
    verdict, grade, claimed, error = record["verdict"], record["grade"], _claimed(record), record["error"]
    if (grade in ("claimed", "part")) != (verdict in CLAIMS or (verdict == "ambiguous" and bool(claimed))):
        yield f"{verdict} is {grade}"
    if verdict in CLAIMS and not claimed:
        yield f"{verdict}, and nothing is claimed"
    if verdict in ("no_effect", "unexplained") and claimed:
        yield f"{verdict}, and {claimed} is claimed"
    changed = any(error["before"][part] != error["after"][part] for part in error["before"])
    if changed and not claimed and verdict != "ambiguous":
        yield "nothing is claimed, and the error after is another than before"
    if (grade == "claimed") != (error.get("nearest") is None):
        yield f"the grade is {grade}, nearest {error.get('nearest')}"


def _rivals(record: Record) -> Iterator[str]:
    """Yield contradictions of rivals with verdict and experiment."""
    rivals = record["rivals"]
    if (record["verdict"] == "ambiguous") != bool(rivals):
        yield f"{record['verdict']} with rivals {rivals}"
    if rivals and (len(rivals) < 2 or not record["experiment"]):
        yield f"rivals {rivals}, experiment {record['experiment']!r}"


def _left(record: Record) -> Iterator[str]:
    """Yield what a claim as a whole leaves: more than a tenth of the excess error of a channel."""
    before, after, floor = (
        x["estimation"] for x in (record["error"]["before"], record["error"]["after"], record["noise_floors"])
    )
    excess = {n: (before[n], after[n], floor[n]) for n in floor if before.get(n, 0.0) > 2.0 * floor[n]}
    left = {n: (a * a - f * f) / (b * b - f * f) for n, (b, a, f) in excess.items()}
    if record["grade"] == "claimed" and max(left.values(), default=0.0) > PART + NOISE:
        yield f"claimed as a whole, and {left} of the excess is left"


def _floors(record: Record) -> Iterator[str]:
    if record["noise_floor"] != record["noise_floors"].get("validation", record["noise_floors"]["estimation"]):
        yield "noise_floor is none of noise_floors"


def _files(record: Record, folder: Path) -> Iterator[str]:
    wanted = FILES["claimed" if record["grade"] == "claimed" else "other"]
    there = {p.name for p in folder.iterdir()} - {"report.html", "refine.json", "runs"}
    if there != set(wanted):
        yield f"the grade is {record['grade']}, the files are {sorted(there)}"
