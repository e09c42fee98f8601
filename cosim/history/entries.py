"""Entries of a folder of results: what, when, outcome, and the inputs that changed since the run before."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cosim.base.errors import InputError
from cosim.base.suggestions import did_you_mean
from cosim.base.version import __version__
from cosim.history.inputs import changes_between, input_text, input_tree, short_input
from cosim.history.numbers import numbers_of, unknown_number
from cosim.storage.artefact import Artefact, artefacts
from cosim.storage.folders import (
    EARLIER,
    RESULTS,
    SCHEMA_VERSION,
    content_of,
    has_results,
    next_number,
    version_of,
)
from cosim.storage.record_types import sound_part
from cosim.storage.started import COMMAND, START, STARTED, is_running

OUTCOMES = ("verdict", "status", "sentence")  # keys of a record whose text is an outcome
UNFINISHED, DAMAGED, ROWS_ONLY = "unfinished", "damaged record", "rows without a record"
RUNNING, UNKNOWN = "running", "running or killed"  # UNKNOWN: of another user, or on a disk without locks
NO_ROWS = "rows are gone"
MOST_CHANGES = 3  # in a text
ROWS = "results"  # name, without ending, of the rows of a run
DEEPEST = 4  # levels of folders below the folder of results: results/a/b/c/d


@dataclass(frozen=True)
class Entry:
    """Results of one command.

    Attributes:
        number: Number for good: by age when results were first listed, the next one for new results.
        name: Name within the folder of results: `tank` or `sub/tank` for the newest, `tank/0001` for an earlier run.
        of: Name of the newest results, of which this is an earlier run or which this is.
        verb: Command that wrote the results, without `cosim`; "" if unknown.
        time: Time of writing [s] since 1970.
        outcome: Outcome of criteria, verdict or status, `unfinished`, `running`, `damaged record`,
            `rows without a record`, `rows are gone`, or "".
        changes: Input → value, where it differs from the run before of the same name; None for a removed input.
        record: File by which the results are known, whose time is `time`.
        version: Version of cosim that wrote the record, or its schema, if it is another one; otherwise "".
        warnings: Values of wrong types in the record.
        lasting_name: Name for good: `tank/0003` also for the newest results `tank`, which will move to that number.
    """

    number: int
    name: str
    of: str
    folder: Path
    verb: str
    time: float
    outcome: str
    changes: Mapping[str, Any]
    record: Path
    version: str = ""
    warnings: tuple[str, ...] = ()
    lasting_name: str = ""

    def check_current(self) -> None:
        """Raise InputError if the results were removed or replaced since they were listed."""
        with suppress(OSError):
            if self.record.stat().st_mtime == self.time:
                return
        raise InputError.at(
            self.folder, f"run {self.number} was removed or replaced after it was listed; repeat the command"
        )

    @property
    def is_newest(self) -> bool:
        """Return whether the results are no earlier run."""
        return self.name == self.of or self.folder.name == STARTED

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
    """Return all results in a folder and in the folders within, the oldest first.

    Folders that are links, hidden folders within and folders without results of a command are left out.

    Args:
        results: Folder of results, by default `results`.
    """
    root = RESULTS if results is None else results
    marks = _marks()
    every: list[tuple[_Recorded, Content]] = []
    for of, folder, scanned in _every_folder(root, marks):
        before: Mapping[str, Any] | None = None
        for recorded, content in _of_name(folder, of, scanned, marks):
            inputs = input_tree(content)
            every.append((recorded, {} if before is None or not inputs else changes_between(before, inputs)))
            before = inputs or before
    every.sort(key=lambda each: (each[0].time, each[0].name))
    numbers = numbers_of([r.lasting_name for r, _ in every], root)
    return [
        Entry(number, *r[:6], changes, *r[6:])  # the fields have the same order
        for number, (r, changes) in zip(numbers, every, strict=True)
    ]


def find_entries(texts: Sequence[str], results: Path | None = None) -> list[Entry]:
    """Return the entries of numbers, names and patterns such as `tank/*`, in this order, each once.

    Raises:
        InputError: A text matches no entry.
    """
    every = entries(results)
    root = RESULTS if results is None else results
    if not every:
        raise InputError.at(
            root, "no results here; run a command without --out first, or name their folder as --results"
        )
    found: dict[str, Entry] = {}
    for text in texts:
        matches = match_entries(text, every, root)
        if not matches and text.isdecimal():
            raise InputError.at(Path(text), unknown_number(text, root))
        if not matches:
            raise InputError.at(
                Path(text), f"no results match{did_you_mean(text, [e.name for e in every])}; `cosim list` shows all"
            )
        found |= {entry.name: entry for entry in matches}
    return [*found.values()]


def listed_entries(texts: Sequence[str] | None, results: Path) -> list[Entry]:
    """Return the entries of texts, without texts all of a folder.

    Raises:
        InputError: A text matches no entry, or the folder is not the default one and not there.
    """
    if results != RESULTS and not results.is_dir():
        raise InputError.at(results, "no such folder; give the folder that has the results as --results")
    return find_entries(texts, results) if texts else entries(results)


def named_entries(text: str, root: Path) -> list[Entry]:
    """Return the entries that a text names, none if it is the path of a folder.

    Raises:
        InputError: The text is no path, and matches no entry.
    """
    path = Path(text)
    if text.isdecimal() or not path.is_dir():
        return find_entries([text], root)
    return match_entries(text, entries(root), root) if hides_results(path) else []


def warnings_of(found: Iterable[Entry]) -> list[str]:
    """Return the warnings on the records of entries."""
    return [text for entry in found for text in entry.warnings]


def match_entries(text: str, every: Sequence[Entry], root: Path = RESULTS) -> list[Entry]:
    """Return the entries of a name, a number, a pattern or a folder within the folder of results."""
    if text.isdecimal() and not any(e.name == text for e in every):
        return [e for e in every if str(e.number) == text.lstrip("0")]
    if "/" in text and (folder := Path(text)).is_dir():
        place = folder.resolve()
        return [e for e in every if e.folder.resolve() == place]
    return _match_names(text.removeprefix(f"{root}/").rstrip("/").replace(f"/{EARLIER}/", "/"), every)


def _match_names(name: str, every: Sequence[Entry]) -> list[Entry]:
    """Return the entry of a name, or those matched."""
    by_name = {**{e.lasting_name: e for e in every}, **{e.name: e for e in every}}
    return [by_name[name]] if name in by_name else [e for e in every if fnmatch.fnmatchcase(e.name, name)]


def hides_results(path: Path) -> bool:
    """Return whether a path is a folder without results."""
    return path.is_dir() and not has_results(path)


def _folders(root: Path) -> Iterator[str]:
    try:
        with os.scandir(root) as items:
            yield from (item.name for item in items if item.is_dir(follow_symlinks=False))
    except OSError:
        return


@dataclass(frozen=True)
class _Marks:
    """Files by which a command is known, and all names to look for.

    Attributes:
        finished: Marks of results.
        unfinished: Marks of results without their first mark.
        rows: Names, without ending, of tables of rows.
        parts: Names of folders that are part of results, and so hold no results of their own.
    """

    finished: Mapping[str, Artefact]
    unfinished: Mapping[str, Artefact]
    names: frozenset[str]
    rows: frozenset[str]
    parts: frozenset[str]


Content = Mapping[str, Any]  # of a record


class _Scanned(NamedTuple):
    """A folder: times of the marks in it, tables of rows, and folders."""

    there: Mapping[str, float]
    tables: Sequence[str]
    folders: Sequence[str]


class _Recorded(NamedTuple):
    """Results of one command without their number and changes."""

    name: str
    of: str
    folder: Path
    verb: str
    time: float
    outcome: str
    record: Path
    version: str = ""
    warnings: tuple[str, ...] = ()
    lasting_name: str = ""


def _marks() -> _Marks:
    finished: dict[str, Artefact] = {}
    unfinished: dict[str, Artefact] = {}
    rows: set[str] = set()
    parts = {EARLIER, STARTED}
    for artefact in artefacts():
        if artefact.verb:
            parts |= artefact.folders
            finished = {**dict.fromkeys(artefact.marks, artefact), **finished}
            unfinished = {**dict.fromkeys(artefact.unfinished, artefact), **unfinished}
            rows |= {*artefact.tables}
    names = frozenset((START, *finished, *(path.partition("/")[0] for path in unfinished)))
    return _Marks(finished, unfinished, names, frozenset(rows), frozenset(parts))


def _every_folder(root: Path, marks: _Marks) -> Iterator[tuple[str, Path, _Scanned]]:
    """Yield name, path and content of the folder of results, if it holds results itself, and of all folders within."""
    own = _scan(root, marks)
    if own is None:
        return
    is_result = bool(own.there or own.tables or STARTED in own.folders)
    if is_result:  # as named by --out
        yield root.resolve().name, root, own
    for name in sorted(own.folders):
        if not (is_result and name in marks.parts):
            yield from _nested(root / name, name, marks)


def _nested(folder: Path, name: str, marks: _Marks) -> Iterator[tuple[str, Path, _Scanned]]:
    """Yield name, path and content of a folder and of the folders within that may hold results of their own."""
    scanned = _scan(folder, marks)
    if scanned is None:
        return
    yield name, folder, scanned
    if name.count("/") + 1 < DEEPEST:
        for inner in sorted(scanned.folders):
            if inner not in marks.parts and not inner.startswith("."):
                yield from _nested(folder / inner, f"{name}/{inner}", marks)


def _scan(place: Path, marks: _Marks) -> _Scanned | None:
    """Return the content of a folder; None if it was removed meanwhile or cannot be read."""
    there: dict[str, float] = {}
    tables: list[str] = []
    folders: list[str] = []
    try:
        with os.scandir(place) as items:
            for item in items:
                if item.name in marks.names:
                    there[item.name] = item.stat().st_mtime
                elif "." in item.name and item.name.partition(".")[0] in marks.rows:
                    tables.append(item.name)
                if item.is_dir(follow_symlinks=False):
                    folders.append(item.name)
    except OSError:
        return None
    return _Scanned(there, tables, folders)


def _of_name(folder: Path, name: str, newest: _Scanned, marks: _Marks) -> Iterator[tuple[_Recorded, Content]]:
    """Yield the results of a name by age, with records."""
    earlier, following = folder / EARLIER, 1
    if EARLIER in newest.folders:
        names = [*_folders(earlier)]
        following = next_number(earlier, names)
        for number in sorted((n for n in names if n.isdecimal()), key=int):
            label, place = f"{name}/{number}", earlier / number
            if (scanned := _scan(place, marks)) is not None:
                yield from _recorded((place, label, name), scanned, marks, label)
    for each in _recorded((folder, name, name), newest, marks, f"{name}/{following:04d}"):
        following += 1
        yield each
    if STARTED in newest.folders and (scanned := _scan(folder / STARTED, marks)) is not None:
        label = f"{name}/{following:04d}"
        yield from _recorded((folder / STARTED, label, name), scanned, marks, label)


def _recorded(
    about: tuple[Path, str, str], scanned: _Scanned, marks: _Marks, lasting_name: str
) -> Iterator[tuple[_Recorded, Content]]:
    """Yield the results in a folder, if there are any."""
    found = _by_mark(about, scanned, marks) or (_by_rows(about) if scanned.tables else None)
    if found is not None:
        yield found[0]._replace(lasting_name=lasting_name), found[1]


def _by_mark(about: tuple[Path, str, str], scanned: _Scanned, marks: _Marks) -> tuple[_Recorded, Content] | None:
    """Return results with a mark of their command, and the content of their record.

    Args:
        about: Folder, name, and name of the newest results.
    """
    for mark, artefact in marks.finished.items():
        if mark in scanned.there:
            return _by_record(about, scanned, mark, artefact)
    for mark, artefact in marks.unfinished.items():
        name = mark.partition("/")[0]
        if name in scanned.there and (about[0] / mark).is_file():
            content = content_of(about[0] / mark) if mark.endswith(".json") else {}
            verb, written = artefact.verb.removeprefix("cosim "), scanned.there[name]
            about_record = about[0] / name, _other_version(content)
            return _Recorded(about[1], about[2], about[0], verb, written, UNFINISHED, *about_record), content
    return _by_record(about, scanned, START) if START in scanned.there else None


def _by_record(
    about: tuple[Path, str, str], scanned: _Scanned, mark: str, artefact: Artefact | None = None
) -> tuple[_Recorded, Content] | None:
    """Return results with a record and its content.

    Args:
        artefact: Declaration of the record; None for that of a start.
    """
    place, label, of = about
    record = place / mark
    content = content_of(record) if mark.endswith(".json") else {"status": ""}
    if not content and not record.is_file():
        return None  # removed meanwhile
    content, warnings = sound_part(record, content)
    verb = content.get(COMMAND, artefact.verb if artefact else "").removeprefix("cosim ")
    has_tables = artefact is not None and artefact.tables
    outcome = _unended(place) or (_missing_rows(scanned.tables, content) if has_tables else "")
    outcome = outcome or _outcome_of(content, warnings)
    if "no_report" in content and not (place / "report.html").is_file():
        outcome += f", no report: {content['no_report']}"
    written = scanned.there[mark], outcome, record, _other_version(content), warnings
    return _Recorded(label, of, place, verb, *written), content if artefact else {}


def _unended(place: Path) -> str:
    """Return the outcome of a running command, else ""."""
    return {True: RUNNING, False: "", None: UNKNOWN}[is_running(place)] if place.name == STARTED else ""


def _outcome_of(content: Content, warnings: Sequence[str]) -> str:
    """Return the outcome in a sound record."""
    return _outcome(content) or (DAMAGED if warnings or not content else "")


def _missing_rows(tables: Sequence[str], content: Content) -> str:
    """Return `rows are gone` if a record has rows and the folder has none, else ""."""
    is_there = any(name.startswith(f"{ROWS}.") for name in tables)
    return NO_ROWS if content.get("rows") and not is_there else ""


def _other_version(content: Content) -> str:
    """Return the version of cosim that wrote a record; "" for the present version."""
    schema, by = content.get("schema_version", SCHEMA_VERSION), version_of(content)
    if schema != SCHEMA_VERSION:
        return f"{by or '?'} (schema {schema})"
    return by if by != __version__ else ""


def _by_rows(about: tuple[Path, str, str]) -> tuple[_Recorded, Content] | None:
    """Return results with rows, but without a record."""
    from cosim.storage.results import rows_in  # with numpy, which a list seldom needs

    place, label, of = about
    rows = rows_in(place)
    with suppress(OSError):  # removed meanwhile
        return None if rows is None else (_Recorded(label, of, place, "", rows.stat().st_mtime, ROWS_ONLY, rows), {})
    return None


def _outcome_of_sweep(content: Mapping[str, Any], runs: int) -> str:
    counts = f"{runs} runs" + (f", {content['failed']} failed" if content.get("failed") else "")
    met = content.get("met_all") if content.get("criteria") else None
    return counts if met is None else f"{counts}, {met} met all criteria"


def _outcome(content: Mapping[str, Any]) -> str:
    """Return the outcome in a record: criteria, else verdict, status or sentence."""
    if "sweep" in content and isinstance(runs := content.get("runs"), int):
        return _outcome_of_sweep(content, runs)
    if "signals" in content and "within" in content:  # of a comparison
        return {True: "within the tolerance", False: "beyond the tolerance"}.get(content["within"], "")
    criteria = content.get("criteria")
    judged = [c for c in criteria if isinstance(c, dict) and "met" in c] if isinstance(criteria, list) else []
    if judged:
        return f"{sum(bool(c['met']) for c in judged)} of {len(judged)} criteria met"
    return next((content[key] for key in OUTCOMES if isinstance(content.get(key), str)), "")
