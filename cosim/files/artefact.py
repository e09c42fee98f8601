"""Kinds of files and folders, each declared once in the room that reads or writes it.

Declarations are `ARTEFACTS` of a room's module `artefacts`, or part of an installed package's `Verb`. They determine
the kind of a file, the command that reads it, the verb that wrote a folder, the kinds that `cosim check`, `cosim
schema` and `cosim.read` accept, and the files that `--force` replaces.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.core.registry import VERBS_GROUP, Verb, attempt, registered

ROOMS = Path(__file__).resolve().parent.parent
DECLARATIONS = "artefacts"  # module of a room
# Names of the kinds of files, for declarations and messages
LOG, FMU, SSP, SCENARIO = "a log", "an FMU", "an SSP", "a scenario"
MANIFEST, STUDY, MODEL, ANSWER = "a manifest", "a study", "a model file", "an answer of `cosim refine`"
FIT_STUDY = "a study of a fit"
CODE, SWEEP, RESULTS, TABLE = "a model's Python file", "a sweep", "the rows of a run", "a table of runs"
TEXT, BINARY = "a text", "a binary file"


@dataclass(frozen=True)
class Checking:
    """Settings of `cosim check`.

    Attributes:
        model: Name or file of the model for logs, if any.
        columns: Name in a log → name in its model, or `time`.
        worker: Worker process for FMUs; None forbids loading and execution.
    """

    model: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    worker: Any = None


@dataclass(frozen=True)
class Artefact:
    """A kind of file, or a folder written by a verb.

    Attributes:
        kind: Noun phrase for messages, e.g. "a scenario".
        next_step: Advice, beginning with the command that reads the file; {file} is its path.
        keys: Alternative sets of keys that identify a YAML or JSON file.
        without: Keys absent from every file of this kind.
        endings: Endings of the names of its files, e.g. ".csv".
        member: File that identifies a ZIP archive of this kind.
        beside: (file name, name of another file that must be in the same folder).
        taken_as: Another kind: where it is accepted, files of this kind are accepted too.
        verb: Command that writes the kind, e.g. "cosim refine".
        marks: Files that only this verb writes, the most specific first; they identify its folders.
        unfinished: Files that identify a folder whose command was stopped before it wrote a mark.
        files: Names or patterns of further files written by the verb.
        tables: Names, without ending, of files with rows, in any format of tables.
        folder: Noun phrase for the folder.
        folder_step: Advice for the folder; {file} is its path.
        schema: Place, `module:name`, of the pydantic model of its keys; `schema_name` and `title` name the schema.
        check: Place of a function of (path, Checking) that returns notes and raises InputError with faults.
        reader: Place of a function of (folder) that returns the result of `cosim.read`, None for an incomplete folder.
    """

    kind: str
    next_step: str
    keys: tuple[frozenset[str], ...] = ()
    without: frozenset[str] = frozenset()
    endings: tuple[str, ...] = ()
    member: str = ""
    beside: tuple[str, str] | None = None
    taken_as: str = ""
    verb: str = ""
    marks: tuple[str, ...] = ()
    unfinished: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    folder: str = ""
    folder_step: str = ""
    schema: str = ""
    schema_name: str = ""
    title: str = ""
    check: str = ""
    reader: str = ""

    def matched_keys(self, keys: Set[str]) -> int:
        """Return how many of the keys that identify this kind a file has; 0 if some are missing or excluded."""
        if self.without & keys:
            return 0
        return max((len(needed) for needed in self.keys if needed <= keys), default=0)

    @property
    def folders(self) -> set[str]:
        """Return the subfolders of results that the verb writes into."""
        return {name.partition("/")[0] for name in self.files if "/" in name}

    def is_left_in(self, folder: Path, *, unfinished: bool = False) -> bool:
        """Return True if a folder contains results of the verb.

        `unfinished` also accepts results of a stopped command.
        """
        return any((folder / mark).is_file() for mark in (*self.marks, *self.unfinished * unfinished))


skipped_files: ContextVar[list[Path] | None] = ContextVar("files of Python that are not executed", default=None)


@contextmanager
def without_execution() -> Iterator[list[Path]]:
    """Prevent the execution of model files; yield skipped files.

    A model in such a file raises NotExecuted.
    """
    skipped: list[Path] = []
    token = skipped_files.set(skipped)
    try:
        yield skipped
    finally:
        skipped_files.reset(token)


@functools.cache
def artefacts() -> tuple[Artefact, ...]:
    """Return all declared kinds, those of installed packages first."""
    declared: list[Artefact] = []
    for name, verb in registered(VERBS_GROUP, Verb):
        if verb.artefacts:
            declared += attempt(name, verb.artefacts) or ()
    for room in pkgutil.iter_modules([str(ROOMS)], "cosim."):
        module = f"{room.name}.{DECLARATIONS}"
        if (ROOMS / room.name.partition(".")[2] / f"{DECLARATIONS}.py").is_file():  # find_spec would import the room
            declared += importlib.import_module(module).ARTEFACTS
    return tuple(declared)


def of_kind(kind: str) -> Artefact | None:
    """Return the declaration of a kind, if any."""
    return next((a for a in artefacts() if a.kind == kind), None)


def kind_by_keys(root: Any) -> str | None:
    """Return the best matching kind of a YAML or JSON file. The kind with the most required keys matches best."""
    keys = frozenset(root) if isinstance(root, dict) else frozenset()
    best = max(artefacts(), key=lambda a: a.matched_keys(keys), default=None)
    return best.kind if best is not None and best.matched_keys(keys) else None


def folder_kind(folder: Path) -> Artefact | None:
    """Return the kind of folder written by a verb, if any."""
    return next((a for a in artefacts() if a.folder and a.is_left_in(folder)), None)
