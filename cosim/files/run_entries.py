"""Entries of a folder of results: what, when, outcome, and the inputs that changed since the run before."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.core.errors import InputError
from cosim.core.version import __version__
from cosim.files.artefact import artefacts
from cosim.files.folders import (
    COMMAND,
    INTERRUPTED,
    RESULTS,
    RUN_NUMBER,
    SCHEMA_VERSION,
    STARTED,
    content_of,
    state_of,
    version_of,
)
from cosim.files.record_types import sound_part
from cosim.files.run_inputs import changes_between, input_leaves, input_text, short_input

OUTCOMES = ("verdict", "status", "sentence")  # keys of a record whose text is an outcome
UNFINISHED, DAMAGED, ROWS_ONLY = "unfinished", "damaged record", "rows without a record"
NO_ROWS = "rows are gone"
MOST_CHANGES = 3  # in a text
DEEPEST = 6  # levels of folders below the folder of results: results/a/b/c/d/runs/0001
EARLIER = "runs"  # folder within results of cosim 0.9 and before, with the earlier runs of a name: 0001, 0002
NUMBERS = ".run-numbers"  # line k has the name of the results with the number k; lines are only added


@dataclass(frozen=True)
class Entry:
    """Results of one command.

    Attributes:
        number: Number for good: by age when results were first listed, the next one for new results.
        name: Path within the folder of results: `tank/0001`, or `sub/tank` for a folder that was named by --out.
        of: Name without the number of the run, the same for all runs of it.
        verb: Command that wrote the results, without `cosim`; "" if unknown.
        time: Time of writing [s] since 1970.
        outcome: Outcome of criteria, verdict or status, `unfinished`, `running`, `interrupted`, `damaged record`,
            `rows without a record`, `rows are gone`, or "".
        record: File by which the results are known, whose time is `time`.
        changes: Input → value, where it differs from the run before of the same name; None for a removed input.
        version: Version of cosim that wrote the record, or its schema, if it is another one; otherwise "".
        warnings: Values of wrong types in the record.
        is_newest: Whether no later run has the same name.
    """

    number: int
    name: str
    of: str
    folder: Path
    verb: str
    time: float
    outcome: str
    record: Path
    changes: Mapping[str, Any]
    version: str = ""
    warnings: tuple[str, ...] = ()
    is_newest: bool = False

    def check_current(self) -> None:
        """Raise InputError if the results were removed or replaced since they were listed."""
        with suppress(OSError):
            if self.record.stat().st_mtime == self.time:
                return
        reason = f"run {self.number} was removed or replaced after it was listed; repeat the command"
        raise InputError.at(self.folder, reason)

    @property
    def label(self) -> str:
        """Return number and changed inputs: `run 3 (mass = 440)`."""
        return f"{self.short} ({self.changed or self.name})"

    @property
    def short(self) -> str:
        """Return the number as a short name: `run 3`."""
        return f"run {self.number}"

    @property
    def changed(self) -> str:
        """Return the changes as a text."""
        names = ((short_input(key), value) for key, value in self.changes.items())
        texts = [f"{name} = {input_text(value)}" if value is not None else f"no {name}" for name, value in names]
        more = f" and {len(texts) - MOST_CHANGES} more" * (len(texts) > MOST_CHANGES)
        return ", ".join(texts[:MOST_CHANGES]) + more


def entries(results: Path | None = None) -> list[Entry]:
    """Return all results in a folder and in the folders within, the oldest first.

    Folders that are links, hidden folders within and folders without results of a command are left out.

    Args:
        results: Folder of results, by default `results`.
    """
    root = RESULTS if results is None else results
    by_name: dict[str, list[tuple[Entry, Mapping[str, Any]]]] = {}
    for entry, content in _results_within(root, Path(root.resolve().name), 0):
        by_name.setdefault(entry.of, []).append((entry, content))
    every: list[Entry] = []

    def age(found: tuple[Entry, Mapping[str, Any]]) -> tuple[int, int]:
        *before, last = found[0].name.split("/")
        if not RUN_NUMBER.fullmatch(last):  # between runs of cosim 0.9 and new ones
            return 1, 0
        return (0 if before and before[-1] == EARLIER else 2), int(last)

    for group in by_name.values():
        group.sort(key=age)
        before: Mapping[str, Any] = {}
        for entry, content in group:
            inputs = input_leaves(content)
            changes = changes_between(before, inputs) if before and inputs else {}
            every.append(replace(entry, changes=changes, is_newest=entry is group[-1][0]))
            before = inputs or before
    every.sort(key=lambda entry: (entry.time, entry.name))
    lines = [entry.name.replace("\n", "\0") for entry in every]
    known = numbered_lines(root)
    if new := [line for line in lines if line not in known]:  # They get the next numbers, in their order.
        with suppress(OSError):  # Commands that add lines at the same time agree: the first line of a name counts.
            with (root / NUMBERS).open("a", encoding="utf-8", errors="surrogateescape") as stream:
                stream.write("".join(f"{line}\n" for line in new))
            known = numbered_lines(root)
        for line in new:  # where the file cannot be written
            known.setdefault(line, len(known) + 1)
    return [replace(entry, number=known[line]) for entry, line in zip(every, lines, strict=True)]


def _results_within(place: Path, name: Path, depth: int) -> Iterator[tuple[Entry, Mapping[str, Any]]]:
    """Yield the results in a folder and in the folders within, with their records.

    Args:
        name: Path of the folder from the folder of results, or that of the latter.
    """
    try:
        with os.scandir(place) as listed:
            items = {item.name: item for item in listed}
        found = _recorded(place, name, items)
    except OSError:  # removed meanwhile, or closed to this user
        return
    parts: set[str] = set()
    if found is not None:
        yield found
        parts = {"figures", *(folder for a in artefacts() if a.verb for folder in a.folders)}
    for inner, item in sorted(items.items() if depth < DEEPEST else ()):
        if inner not in parts and not inner.startswith(".") and item.is_dir(follow_symlinks=False):
            is_run = depth == 0 and (inner == EARLIER or RUN_NUMBER.fullmatch(inner))
            yield from _results_within(place / inner, name / inner if depth or is_run else Path(inner), depth + 1)


def _recorded(place: Path, name: Path, items: Mapping[str, os.DirEntry[str]]) -> tuple[Entry, Mapping[str, Any]] | None:
    """Return the results in a folder and their record, if there are any."""
    written = [a for a in artefacts() if a.verb]
    marks = [(mark, a) for a in written for mark in a.marks if mark in items]
    parts = [(m, a) for a in written for m in a.unfinished if m.split("/")[0] in items and (place / m).is_file()]
    mark, artefact = [*marks, *parts, (STARTED, None)][0]
    has_rows = any(n.startswith("results.") for n in items)
    content: Mapping[str, Any] = {}
    warnings: tuple[str, ...] = ()
    if artefact is not None or STARTED in items:
        record = place / mark
        read = content_of(record) if mark.endswith(".json") else {"status": ""}
        content, warnings = sound_part(record, read)
        outcome = state_of(place) if STARTED in items else ""
        if not outcome and artefact is not None and mark in artefact.unfinished:
            outcome = UNFINISHED
        elif not outcome and artefact is not None and artefact.tables and content.get("rows") and not has_rows:
            outcome = NO_ROWS
        outcome = outcome or _outcome(content) or (DAMAGED if warnings or not read else "")
        if "no_report" in content and "report.html" not in items:
            outcome += f", no report: {content['no_report']}"
    elif has_rows:
        from cosim.files.results import rows_in  # with numpy, which a list seldom needs

        if (rows := rows_in(place)) is None:
            return None
        record, outcome = rows, ROWS_ONLY
    elif RUN_NUMBER.fullmatch(place.name) and not items:  # killed before its first file
        record, outcome = place, INTERRUPTED
    else:
        return None
    schema, by = content.get("schema_version", SCHEMA_VERSION), version_of(content)
    version = by if by != __version__ else ""
    of = name.parent if RUN_NUMBER.fullmatch(name.name) and len(name.parts) > 1 else name
    entry = Entry(
        number=0,
        name=name.as_posix(),
        of=(of.parent if of.name == EARLIER and of != name else of).as_posix(),
        folder=place,
        verb=content.get(COMMAND, artefact.verb if artefact else "").removeprefix("cosim "),
        time=record.stat().st_mtime,
        outcome=outcome,
        record=record,
        changes={},
        version=version if schema == SCHEMA_VERSION else f"{by or '?'} (schema {schema})",
        warnings=warnings,
    )
    return entry, content


def _outcome(content: Mapping[str, Any]) -> str:
    """Return the outcome in a record: criteria, else verdict, status or sentence."""
    if "sweep" in content and isinstance(runs := content.get("runs"), int):
        counts = f"{runs} runs" + (f", {content['failed']} failed" if content.get("failed") else "")
        met = content.get("met_all") if content.get("criteria") else None
        return counts if met is None else f"{counts}, {met} met all criteria"
    if "signals" in content and "within" in content:  # of a comparison
        return {True: "within the tolerance", False: "beyond the tolerance"}.get(content["within"], "")
    criteria = content.get("criteria")
    judged = [c for c in criteria if isinstance(c, dict) and "met" in c] if isinstance(criteria, list) else []
    if judged:
        return f"{sum(bool(c['met']) for c in judged)} of {len(judged)} criteria met"
    return next((content[key] for key in OUTCOMES if isinstance(content.get(key), str)), "")


def numbered_lines(root: Path) -> dict[str, int]:
    """Return name → number of all results that were ever listed, in the order of numbers."""
    try:
        lines = (root / NUMBERS).read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    except OSError:
        return {}
    known: dict[str, int] = {}
    for number, line in enumerate(lines[:-1], 1):
        known.setdefault(line, number)
    return known
