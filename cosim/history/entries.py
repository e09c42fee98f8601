"""Entries of a folder of results: what, when, outcome, and the inputs that changed since the run before."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.base.errors import InputError
from cosim.base.suggestions import did_you_mean
from cosim.history import messages
from cosim.history.inputs import changes_between, input_text, inputs_of, short_input
from cosim.storage.artefact import Artefact, artefacts
from cosim.storage.folders import EARLIER, RESULTS, content_of

OUTCOMES = ("verdict", "status", "sentence")  # keys of a record whose text is an outcome
UNFINISHED, DAMAGED = "unfinished", "damaged record"
MOST_CHANGES = 3  # in a text


@dataclass(frozen=True)
class Entry:
    """Results of one command.

    Attributes:
        number: Number by age, from 1 for the oldest.
        name: Name within the folder of results: `tank` for the newest, `tank/0001` for an earlier run.
        verb: Command that wrote the results, without `cosim`.
        time: Time of writing [s] since 1970.
        outcome: Outcome of criteria, verdict or status, `unfinished`, `damaged record`, or "".
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
        """Return the number and the changed inputs: `run 3 (mass = 440)`."""
        return f"{self.short} ({self.changed or self.name})"

    @property
    def short(self) -> str:
        """Return the number as a short name: `run 3`."""
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
    marks = _marks()
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


def listed_entries(texts: Sequence[str] | None, results: Path) -> list[Entry]:
    """Return the entries of texts, without texts all of a folder.

    Raises:
        InputError: A text matches no entry, or the folder is not the default one and not there.
    """
    if results != RESULTS and not results.is_dir():
        raise InputError.at(results, messages.NO_FOLDER())
    return find_entries(texts, results) if texts else entries(results)


def match_entries(text: str, every: Sequence[Entry], root: Path = RESULTS) -> list[Entry]:
    """Return the entries of a number, a name, a pattern or a folder within the folder of results."""
    if text.isdecimal():
        return [*every[int(text) - 1 : int(text)]] if int(text) > 0 else []
    if "/" in text and (folder := Path(text)).is_dir():
        place = folder.resolve()
        return [e for e in every if e.folder.resolve() == place]
    name = text.removeprefix(f"{root}/").rstrip("/").replace(f"/{EARLIER}/", "/")
    return [e for e in every if e.name == name] or [e for e in every if fnmatch.fnmatchcase(e.name, name)]


def _folders(root: Path) -> Iterator[str]:
    try:
        with os.scandir(root) as items:
            yield from (item.name for item in items if item.is_dir(follow_symlinks=False))
    except OSError:
        return


@dataclass(frozen=True)
class _Marks:
    """Files by which a command is known: of results, of results without their first mark, and all names to look for."""

    finished: Mapping[str, Artefact]
    unfinished: Mapping[str, Artefact]
    names: frozenset[str]


def _marks() -> _Marks:
    finished: dict[str, Artefact] = {}
    unfinished: dict[str, Artefact] = {}
    for artefact in artefacts():
        if artefact.verb:
            finished = {**dict.fromkeys(artefact.marks, artefact), **finished}
            unfinished = {**dict.fromkeys(artefact.unfinished, artefact), **unfinished}
    return _Marks(finished, unfinished, frozenset((*finished, *(path.partition("/")[0] for path in unfinished))))


def _of_name(folder: Path, name: str, marks: _Marks) -> Iterator[tuple[Entry, Mapping[str, Any]]]:
    """Yield entries and inputs of a name, earlier runs first."""
    numbers = sorted((n for n in _folders(folder / EARLIER) if n.isdecimal()), key=int)
    for place, label in (*((folder / EARLIER / n, f"{name}/{n}") for n in numbers), (folder, name)):
        try:
            with os.scandir(place) as items:
                there = {item.name: item.stat().st_mtime for item in items if item.name in marks.names}
        except OSError:  # removed meanwhile
            continue
        mark = next((m for m in marks.finished if m in there), None)
        is_finished = mark is not None
        if mark is None:
            paths = (p for p in marks.unfinished if p.partition("/")[0] in there)
            mark = next((p for p in paths if (place / p).is_file()), None)
        if mark is None:
            continue
        content = content_of(place / mark) if mark.endswith(".json") else {"status": ""}
        outcome = UNFINISHED if not is_finished else _outcome(content) if content else DAMAGED
        verb = (marks.finished if is_finished else marks.unfinished)[mark].verb.removeprefix("cosim ")
        yield Entry(0, label, place, verb, there[mark.partition("/")[0]], outcome, {}), inputs_of(content)


def _outcome(content: Mapping[str, Any]) -> str:
    """Return the outcome in a record: criteria, else verdict, status or sentence."""
    if "sweep" in content and isinstance(runs := content.get("runs"), int):
        met = content.get("met_all") if content.get("criteria") else None
        counts = f"{runs} runs" + (f", {content['failed']} failed" if content.get("failed") else "")
        return counts if met is None else f"{counts}, {met} met all criteria"
    if "signals" in content and "within" in content:  # of a comparison
        return {True: "within the tolerance", False: "beyond the tolerance"}.get(content["within"], "")
    criteria = content.get("criteria")
    judged = [c for c in criteria if isinstance(c, dict) and "met" in c] if isinstance(criteria, list) else []
    if judged:
        return f"{sum(bool(c['met']) for c in judged)} of {len(judged)} criteria met"
    return next((content[key] for key in OUTCOMES if isinstance(content.get(key), str)), "")
