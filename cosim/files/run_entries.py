"""The list of results: command, time, outcome, and inputs changed since the previous run.

A path, number, name or pattern selects results; earlier runs can be removed.
"""

from __future__ import annotations

import fnmatch
import math
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cosim.core.errors import Fault, InputError, refuse
from cosim.core.text import amount, did_you_mean, is_difference, showing, some
from cosim.core.version import __version__
from cosim.files.artefact import artefacts
from cosim.files.folders import (
    COMMAND_KEY,
    INTERRUPTED,
    RESULTS_FOLDER,
    RUN_NUMBER,
    SCHEMA_VERSION,
    STARTED,
    content_of,
    has_results,
    newest_run,
    run_name,
    sound_part,
    state_of,
)
from cosim.files.run_inputs import changes_between, input_leaves, input_text, short_input

OUTCOMES = ("verdict", "status", "sentence")  # keys of a record that may contain the outcome
UNFINISHED, DAMAGED, ROWS_ONLY = "unfinished", "damaged record", "rows without a record"
ROWS_GONE = "rows are gone"
MOST_CHANGES = 3  # in a text
DAY = 86_400.0  # [s]
MAX_FOLDER_DEPTH = 6  # levels of folders below the folder of results: results/a/b/c/d/runs/0001
RUN_NUMBERS_FILE = ".run-numbers"  # line k has the name of the results with the number k; lines are only added


@dataclass(frozen=True)
class Entry:
    """Results of one command.

    Attributes:
        number: Permanent number. The first listing numbers all results by age; later results get the next free numbers.
        name: Path within the folder of results: `tank/0001`, or `sub/tank` for a folder given by --out.
        of: Name without the run number, shared by all runs of a series.
        verb: Command that wrote the results, without `cosim`; "" if unknown.
        time: Time of writing [s] since 1970.
        outcome: Result of criteria, verdict or status; `unfinished`, `running`, `interrupted`, `damaged record`, `rows
            without a record`, `rows are gone`, or "".
        changes: Input → value, for inputs that differ from the previous run of the same name; None for a removed input.
        version: Version of cosim, or of the schema, that wrote the record, if it differs from the current one; else "".
        warnings: A warning for each value of a wrong type in the record.
        is_newest: True if no later run has the same name.
        criteria: Entries of the record with a criterion, its value, and whether it is met.
        display: Unit → name of its display unit, factor and offset to its values.
    """

    number: int
    name: str
    of: str
    folder: Path
    verb: str
    time: float
    outcome: str
    changes: Mapping[str, Any]
    version: str = ""
    warnings: tuple[str, ...] = ()
    is_newest: bool = False
    criteria: tuple[Mapping[str, Any], ...] = ()
    display: Mapping[str, Any] = field(default_factory=dict)

    @property
    def merits(self) -> dict[str, tuple[float, str]]:
        """Return title → (value, value in its display unit) for each criterion."""
        found = {}
        with showing({"display": self.display}):
            for c in self.criteria:
                title = f"{str(c.get('kind', 'criterion')).replace('_', ' ')} of {c.get('of', '?')}"
                value, unit = c.get("value"), str(c.get("unit") or "")
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    found[title] = float(value), amount(float(value), unit, difference=is_difference(c))
                else:
                    found[title] = math.inf, "never"
        return found

    @property
    def met(self) -> bool | None:
        """Return True if all criteria were met; None if the run has no criteria."""
        return all(bool(c["met"]) for c in self.criteria) if self.criteria else None

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
        """Return the changed inputs as text, such as `mass = 440`."""
        names = ((short_input(key), value) for key, value in self.changes.items())
        return some([f"{name} = {input_text(v)}" if v is not None else f"no {name}" for name, v in names], MOST_CHANGES)


def entries(results: Path | None = None) -> list[Entry]:
    """Return all results in a folder and its subfolders, the oldest first.

    Links, hidden subfolders, and folders without results of a command are left out.

    Args:
        results: Folder of results, by default `results`.
    """
    root = RESULTS_FOLDER if results is None else results
    by_name: dict[str, list[tuple[Entry, Mapping[str, Any]]]] = {}
    for entry, content in _results_within(root, Path(root.resolve().name), 0):
        by_name.setdefault(entry.of, []).append((entry, content))
    every: list[Entry] = []
    for group in by_name.values():  # a folder without a number precedes the numbered runs
        group.sort(key=lambda found: int(last) if RUN_NUMBER.fullmatch(last := found[0].folder.name) else 0)
        before: Mapping[str, Any] = {}
        for entry, content in group:
            inputs = input_leaves(content)
            changes = changes_between(before, inputs) if before and inputs else {}
            every.append(replace(entry, changes=changes, is_newest=entry is group[-1][0]))
            before = inputs or before
    every.sort(key=lambda entry: (entry.time, entry.name))
    lines = [entry.name.replace("\n", "\0") for entry in every]
    known = _numbered_lines(root)
    if new := [line for line in lines if line not in known]:  # They get the next numbers, in their order.
        with suppress(OSError):  # Commands that add lines at the same time agree: the first line of a name counts.
            with (root / RUN_NUMBERS_FILE).open("a", encoding="utf-8", errors="surrogateescape") as stream:
                stream.write("".join(f"{line}\n" for line in new))
            known = _numbered_lines(root)
        for line in new:  # if the file cannot be written
            known.setdefault(line, len(known) + 1)
    return [replace(entry, number=known[line]) for entry, line in zip(every, lines, strict=True)]


def _results_within(place: Path, name: Path, depth: int) -> Iterator[tuple[Entry, Mapping[str, Any]]]:
    """Yield the results in a folder and its subfolders, with their records.

    Args:
        name: Path of the folder relative to the folder of results.
    """
    try:
        with os.scandir(place) as listed:
            items = {item.name: item for item in listed}
        found = _recorded(place, name, items)
    except OSError:  # removed meanwhile, or without read permission
        return
    parts: set[str] = set()
    if found is not None:
        yield found
        parts = {"figures", *(folder for a in artefacts() if a.verb for folder in a.folders)}
    for inner, item in sorted(items.items() if depth < MAX_FOLDER_DEPTH else ()):
        if inner not in parts and not inner.startswith(".") and item.is_dir(follow_symlinks=False):
            is_run = depth == 0 and RUN_NUMBER.fullmatch(inner)
            yield from _results_within(place / inner, name / inner if depth or is_run else Path(inner), depth + 1)


def _recorded(place: Path, name: Path, items: Mapping[str, os.DirEntry[str]]) -> tuple[Entry, Mapping[str, Any]] | None:
    """Return the results in a folder and their record; None if the folder has no results."""
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
            outcome = ROWS_GONE
        outcome = outcome or _outcome(content) or (DAMAGED if warnings or not read else "")
        if "no_report" in content and "report.html" not in items:
            outcome += f", no report: {content['no_report']}"
    elif has_rows:
        from cosim.files.results import rows_in  # imports numpy, which the list seldom needs

        if (rows := rows_in(place)) is None:
            return None
        record, outcome = rows, ROWS_ONLY
    elif RUN_NUMBER.fullmatch(place.name) and not items:  # killed before its first file
        record, outcome = place, INTERRUPTED
    else:
        return None
    schema, by = content.get("schema_version", SCHEMA_VERSION), content.get("cosim_version", "")
    version = by if by != __version__ else ""
    of = name.parent if RUN_NUMBER.fullmatch(name.name) and len(name.parts) > 1 else name
    entry = Entry(
        number=0,
        name=name.as_posix(),
        of=of.as_posix(),
        folder=place,
        verb=content.get(COMMAND_KEY, artefact.verb if artefact else "").removeprefix("cosim "),
        time=record.stat().st_mtime,
        outcome=outcome,
        changes={},
        version=version if schema == SCHEMA_VERSION else f"{by or '?'} (schema {schema})",
        warnings=warnings,
        criteria=_judged(content),
        display=content.get("display") or {},
    )
    return entry, content


def _outcome(content: Mapping[str, Any]) -> str:
    """Return the outcome in a record as text: of its criteria, or else its verdict, status or sentence."""
    if "sweep" in content and isinstance(runs := content.get("runs"), int):
        counts = f"{runs} runs" + (f", {content['failed']} failed" if content.get("failed") else "")
        met = content.get("met_all") if content.get("criteria") else None
        return counts if met is None else f"{counts}, {met} met all criteria"
    if "signals" in content and "within" in content:  # a comparison
        return {True: "within the tolerance", False: "beyond the tolerance"}.get(content["within"], "")
    if judged := _judged(content):
        return f"{sum(bool(c['met']) for c in judged)} of {len(judged)} criteria met"
    return next((content[key] for key in OUTCOMES if isinstance(content.get(key), str)), "")


def _judged(content: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """Return the entries of a record with a criterion that was met or missed."""
    criteria = content.get("criteria")
    if not isinstance(criteria, list) or "sweep" in content:
        return ()
    return tuple(c for c in criteria if isinstance(c, dict) and "met" in c)


def _numbered_lines(root: Path) -> dict[str, int]:
    """Return name → number of all results that were ever listed, ordered by number."""
    try:
        lines = (root / RUN_NUMBERS_FILE).read_text(encoding="utf-8", errors="surrogateescape").split("\n")
    except OSError:
        return {}
    known: dict[str, int] = {}
    for number, line in enumerate(lines[:-1], 1):
        known.setdefault(line, number)
    return known


# -- selection ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Selected:
    """Results that a text of the user selects.

    Attributes:
        path: Folder of a command, or a table of rows.
        entry: Entry of the folder of results; None for other paths.
        by_pattern: True if a pattern selected the results; results without rows may then be left out.
    """

    path: Path
    entry: Entry | None = None
    by_pattern: bool = False

    @property
    def short(self) -> str:
        """Return a short name: `run 3`, or the file name of the path."""
        own = run_name(self.path) if self.path.is_dir() else self.path.stem
        return own if self.entry is None else self.entry.short

    @property
    def longer(self) -> str:
        """Return a longer name: `run 3 (tank/0001)`, or the file name of the path."""
        return self.short if self.entry is None else f"{self.short} ({self.entry.name})"


def select_groups(texts: Sequence[str], results: Path | None = None) -> list[list[Selected]]:
    """Return the results that each text selects: a path, number, name, or pattern such as `tank/*`.

    An existing path takes precedence over a name, unless it is a folder without results. A folder of numbered runs, or
    its name, means the newest run. A pattern selects its matches from the oldest to the newest, except results already
    selected.

    Args:
        results: Folder of results, by default `results`.

    Raises:
        InputError: A text selects no results; every such text is reported.
    """
    root = RESULTS_FOLDER if results is None else results
    inside = root.resolve() if root.is_dir() else None
    is_entry = (not Path(text).is_file() or inside in Path(text).resolve().parents for text in texts)
    every = entries(root) if any(is_entry) else []
    by_folder = {entry.folder.resolve(): entry for entry in every}
    faults: list[Fault] = []
    groups: list[list[Selected]] = []
    there: set[Path] = set()
    for text in texts:
        path = newest_run(Path(text))
        group: list[Selected] = []
        if path.exists() and (not path.is_dir() or has_results(path)):
            group = [Selected(path, by_folder.get(path.resolve()))]
        elif matches := match_entries(text, every, root):
            several = len(matches) > 1
            new = [e for e in matches if not (several and e.folder.resolve() in there)]
            group = [Selected(entry.folder, entry, several) for entry in new]
        elif path.exists():
            group = [Selected(path)]
        else:
            faults.append(Fault(path, 0, 0, _no_match(text, every)))
        there |= {selected.path.resolve() for selected in group}
        groups.append(group)
    refuse(faults)
    return groups


def find_entries(texts: Sequence[str] | None, results: Path) -> list[Entry]:
    """Return the entries that numbers, names and patterns select, each once; without texts, all entries.

    Raises:
        InputError: A text matches no entry, or a folder other than the default does not exist.
    """
    if results != RESULTS_FOLDER and not results.is_dir():
        raise InputError.at(results, "no such folder; give the folder of the results as --results")
    every = entries(results)
    if not texts:
        return every
    found: dict[str, Entry] = {}
    for text in texts:
        matches = match_entries(text, every, results)
        if not matches:
            raise InputError.at(Path(text), _no_match(text, every))
        found |= {entry.name: entry for entry in matches}
    return [*found.values()]


def match_entries(text: str, every: Sequence[Entry], root: Path = RESULTS_FOLDER) -> list[Entry]:
    """Return the entries selected by a name, a number, a pattern or a subfolder of the folder of results.

    A name that several runs share selects the newest run.
    """
    if text.isdecimal() and not any(e.name == text for e in every):
        return [e for e in every if str(e.number) == text.lstrip("0")]
    if "/" in text and (folder := Path(text)).is_dir():
        place = newest_run(folder).resolve()
        return [e for e in every if e.folder.resolve() == place]
    name = text.removeprefix(f"{root}/").rstrip("/")
    exact = [e for e in every if e.of == name and e.is_newest] or [e for e in every if e.name == name]
    return exact or [e for e in every if fnmatch.fnmatchcase(e.name, name)]


def _no_match(text: str, every: Sequence[Entry]) -> str:
    """Return the message for a text that selects no results."""
    hint = did_you_mean(text, [name for entry in every for name in (entry.of, entry.name)])
    return (
        "no such folder, file or results; give the folder of a run, a table of its rows, or a number, name or pattern "
        f"in `cosim list`{hint}"
    )


# -- removal --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Removal:
    """Earlier runs that are or were removed, their size in bytes, and the reasons why other runs cannot be removed."""

    entries: tuple[Entry, ...]
    size: int
    faults: tuple[Fault, ...] = ()


def plan_removal(
    entries: Sequence[Entry], *, keep: int = 0, older: float = 0.0, chosen: Iterable[Entry] | None = None
) -> Removal:
    """Return the earlier runs to remove. The newest results of each name and unfinished runs are kept.

    Args:
        entries: All results, the oldest first.
        keep: Number of earlier runs of each name to keep: the latest ones.
        older: Minimum age [days] of runs to remove.
        chosen: Entries that may be removed; by default all.
    """
    by_name: dict[str, list[Entry]] = {}
    for entry in entries:
        if not entry.is_newest:
            by_name.setdefault(entry.of, []).append(entry)
    limit = time.time() - DAY * older
    names = {entry.name for entry in (entries if chosen is None else chosen)}
    outdated = [e for runs in by_name.values() for e in runs[: max(0, len(runs) - keep)] if e.time <= limit]
    around = {folder for entry in entries for folder in entry.folder.parents}  # folders that contain other results
    idle = [e for e in outdated if state_of(e.folder) in {"", INTERRUPTED} and e.folder not in around]
    removed = tuple(entry for entry in idle if entry.name in names)
    return Removal(removed, sum(_size(entry.folder) for entry in removed))


def remove(entries: Iterable[Entry]) -> Removal:
    """Remove earlier runs; return the removed ones."""
    removed, size, faults = list[Entry](), 0, list[Fault]()
    for entry in entries:
        taken = _size(entry.folder)
        try:
            shutil.rmtree(entry.folder)
        except FileNotFoundError:  # Another command has removed the folder.
            continue
        except OSError as error:
            faults.append(Fault(entry.folder, 0, 0, f"cannot be removed: {error.strerror or error}"))
            continue
        removed.append(entry)
        size += taken
    return Removal(tuple(removed), size, tuple(faults))


def _size(folder: Path) -> int:
    files = (os.path.join(place, name) for place, _, names in os.walk(folder) for name in names)
    return sum(os.lstat(file).st_size for file in files)
