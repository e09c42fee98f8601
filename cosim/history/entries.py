"""Entries of a folder of results: what, when, outcome, and the inputs that changed since the run before."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.base.errors import InputError
from cosim.history import messages
from cosim.history.inputs import changes_between, input_text, scenario_inputs, short_input
from cosim.storage.artefact import Artefact, artefacts
from cosim.storage.folders import EARLIER, RESULTS, content_of
from cosim.storage.yaml_file import did_you_mean

OUTCOMES = ("verdict", "status", "sentence")  # keys of a record whose text is an outcome
MOST_CHANGES = 3  # in a text


@dataclass(frozen=True)
class Entry:
    """Results of one command.

    Attributes:
        number: Number by age, from 1 for the oldest.
        name: Name within the folder of results: `tank` for the newest, `tank/0001` for an earlier run.
        verb: Command that wrote the results, without `cosim`.
        time: Time of writing [s] since 1970.
        outcome: Outcome of criteria, verdict or status; "" if the record has none.
        changes: Input → value, where it differs from the run before of the same name; None for a removed input.
    """

    number: int
    name: str
    folder: Path
    verb: str
    time: float
    outcome: str
    changes: Mapping[str, Any]

    @property
    def is_newest(self) -> bool:
        """Return whether no later run of the same name exists."""
        return "/" not in self.name

    @property
    def label(self) -> str:
        """Return a name that differs from those of other entries, with the changes: `run 3 (mass = 440)`."""
        return f"{self.short} ({self.changed or self.name})"

    @property
    def short(self) -> str:
        """Return a short name that differs from those of other entries: `run 3`."""
        return f"run {self.number}"

    @property
    def changed(self) -> str:
        """Return the changes as a text."""
        names = ((short_input(key), value) for key, value in self.pairs)
        texts = [f"{name} = {input_text(value)}" if value is not None else f"no {name}" for name, value in names]
        return ", ".join(texts[:MOST_CHANGES]) + (
            f" and {len(texts) - MOST_CHANGES} more" * (len(texts) > MOST_CHANGES)
        )

    @property
    def pairs(self) -> Sequence[tuple[str, Any]]:
        """Return inputs and values that changed."""
        return [*self.changes.items()]


def entries(results: Path | None = None) -> list[Entry]:
    """Return all results in a folder, the oldest first.

    Folders that are links and folders without results of a command are left out.

    Args:
        results: Folder of results, by default `results`.
    """
    root = RESULTS if results is None else results
    declared = [a for a in artefacts() if a.marks and a.verb]
    marks: dict[str, Artefact] = {}
    for artefact in declared:
        for mark in artefact.marks:
            marks.setdefault(mark, artefact)
    every: list[Entry] = []
    for name in sorted(_folders(root)):
        before: Mapping[str, Any] | None = None
        for entry, inputs in _of_name(root / name, name, marks):
            changes = {} if before is None or not inputs else changes_between(before, inputs)
            before = inputs or before
            every.append(replace(entry, changes=changes))
    every.sort(key=lambda e: (e.time, e.name))
    return [replace(entry, number=number) for number, entry in enumerate(every, 1)]


def find_entries(texts: Sequence[str], results: Path | None = None) -> list[Entry]:
    """Return the entries of numbers, names and patterns such as `tank/*`, in this order, each once.

    Raises:
        InputError: A text matches no entry.
    """
    every = entries(results)
    root = RESULTS if results is None else results
    if not every:
        raise InputError.at(root, messages.NO_RESULTS())
    found: dict[str, Entry] = {}
    for text in texts:
        matches = match_entries(text, every, root)
        if not matches and text.isdecimal():
            raise InputError.at(Path(text), messages.UNKNOWN_NUMBER(number=text, last=len(every)))
        if not matches:
            raise InputError.at(Path(text), messages.NO_MATCH(hint=did_you_mean(text, [e.name for e in every])))
        found |= {entry.name: entry for entry in matches}
    return [*found.values()]


def match_entries(text: str, every: Sequence[Entry], root: Path = RESULTS) -> list[Entry]:
    """Return the entries of a number, a name, a pattern or a folder within the folder of results."""
    if text.isdecimal():
        return [*every[int(text) - 1 : int(text)]] if int(text) > 0 else []
    name = text.removeprefix(f"{root}/").rstrip("/").replace(f"/{EARLIER}/", "/")
    return [e for e in every if e.name == name] or [e for e in every if fnmatch.fnmatchcase(e.name, name)]


def _folders(root: Path) -> Iterator[str]:
    try:
        with os.scandir(root) as items:
            yield from (item.name for item in items if item.is_dir(follow_symlinks=False))
    except OSError:
        return


def _of_name(folder: Path, name: str, marks: Mapping[str, Artefact]) -> Iterator[tuple[Entry, Mapping[str, Any]]]:
    """Yield entries and inputs of a name, earlier runs first."""
    numbers = sorted((n for n in _folders(folder / EARLIER) if n.isdecimal()), key=int)
    for place, label in (*((folder / EARLIER / n, f"{name}/{n}") for n in numbers), (folder, name)):
        try:
            with os.scandir(place) as items:
                there = {item.name: item.stat().st_mtime for item in items if item.name in marks}
        except OSError:  # removed meanwhile
            continue
        mark = next((m for m in marks if m in there), None)
        if mark is None:
            continue
        content = content_of(place / mark) if mark.endswith(".json") else {}
        verb = marks[mark].verb.removeprefix("cosim ")
        yield Entry(0, label, place, verb, there[mark], _outcome(content), {}), scenario_inputs(content)


def _outcome(content: Mapping[str, Any]) -> str:
    """Return the outcome in a record: criteria, else verdict, status or sentence."""
    criteria = content.get("criteria")
    judged = [c for c in criteria if isinstance(c, dict) and "met" in c] if isinstance(criteria, list) else []
    if judged:
        return f"{sum(bool(c['met']) for c in judged)} of {len(judged)} criteria met"
    return next((content[key] for key in OUTCOMES if isinstance(content.get(key), str)), "")
