"""Kinds of files and folders, each declared once by the room that reads or writes it.

A room declares its kinds as `ARTEFACTS` in its module `artefacts`, an installed package in its `Verb`. Which kind a
file is, which command reads it, whose folder one is, what `cosim check`, `cosim schema` and `cosim.read` do with it and
which files are kept of an earlier run all follow from the declarations.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.registry import added_verbs, attempt

ROOMS = Path(__file__).resolve().parent.parent
DECLARATIONS = "artefacts"  # module of a room


@dataclass(frozen=True)
class Checking:
    """Settings of `cosim check`.

    model:   name or file of the model whose logs are checked; None if none is named
    columns: name in a log → name in its model, or `time`
    worker:  worker process that loads FMUs; None if nothing may be loaded or executed
    """

    model: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    worker: Any = None


@dataclass(frozen=True)
class Artefact:
    """A kind of file, or a folder that a verb leaves.

    kind:        noun phrase for messages, such as "a scenario"
    next_step:   what to do with one, the command that reads it first; {file} is its path
    keys:        alternatives: a YAML or JSON file with all keys of one of them is of this kind
    without:     keys that a file of this kind never has
    endings:     of the names of such files, such as ".csv"
    heads:       alternatives for the first bytes of such a file
    text:        regular expression that the beginning of such a text matches
    member:      file in a ZIP archive of this kind, or the beginning of its name; "*" is any
    beside:      name of such a file, and of a file in the same folder that makes it one of this kind
    taken_as:    kind in whose place a file of this kind is accepted
    verb:        command that leaves one, such as "cosim refine"
    marks:       names of files that this verb alone leaves in a folder, the telling one first
    files:       names or patterns of the files that the verb leaves in the folder, besides
    tables:      names, without an ending, of files of rows in any format
    folder:      noun phrase for such a folder
    folder_step: what to do with the folder; {file} is its path
    sources:     keys of the first mark that say what it was made from
    schema:      place, `module:name`, of the pydantic model of its keys, and `schema_name` and `title` of the schema
    check:       place of a function of (path, Checking) that raises InputError with the faults of a file, and returns
                 notes, a line each
    reader:      place of a function of (folder) that returns what `cosim.read` gives, None if the verb came to no end
    """

    kind: str
    next_step: str
    keys: tuple[frozenset[str], ...] = ()
    without: frozenset[str] = frozenset()
    endings: tuple[str, ...] = ()
    heads: tuple[bytes, ...] = ()
    text: str = ""
    member: str = ""
    beside: tuple[str, str] | None = None
    taken_as: str = ""
    verb: str = ""
    marks: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    folder: str = ""
    folder_step: str = ""
    sources: tuple[str, ...] = ()
    schema: str = ""
    schema_name: str = ""
    title: str = ""
    check: str = ""
    reader: str = ""

    def matched_keys(self, keys: Set[str]) -> int:
        """Return how many keys make a file with these keys one of this kind; 0 if it is none."""
        if self.without & keys:
            return 0
        return max((len(needed) for needed in self.keys if needed <= keys), default=0)

    def is_left_in(self, folder: Path) -> bool:
        """Return whether the verb left a folder."""
        return any((folder / mark).is_file() for mark in self.marks)


@functools.cache
def artefacts() -> tuple[Artefact, ...]:
    """Return all kinds that are declared, those of installed packages first."""
    declared: list[Artefact] = []
    for name, verb in added_verbs():
        if verb.artefacts:
            declared += attempt(name, verb.artefacts) or ()
    for room in pkgutil.iter_modules([str(ROOMS)], "cosim."):
        module = f"{room.name}.{DECLARATIONS}"
        if room.ispkg and importlib.util.find_spec(module) is not None:
            declared += importlib.import_module(module).ARTEFACTS
    return tuple(declared)


def of_kind(kind: str) -> Artefact | None:
    """Return the declaration of a kind; None of a kind that no verb declares."""
    return next((a for a in artefacts() if a.kind == kind), None)


def kind_where(is_of: Callable[[Artefact], object]) -> str | None:
    """Return the first kind whose declaration fulfils a condition; None if none does."""
    return next((a.kind for a in artefacts() if is_of(a)), None)


def kind_by_keys(root: Any) -> str | None:
    """Return the kind of a YAML or JSON file by its keys, the one that needs most of them; None where none fits."""
    keys = frozenset(root) if isinstance(root, dict) else frozenset()
    best = max(artefacts(), key=lambda a: a.matched_keys(keys), default=None)
    return best.kind if best is not None and best.matched_keys(keys) else None


def left_in(folder: Path) -> Artefact | None:
    """Return what a verb left in a folder, None where no verb did."""
    return next((a for a in artefacts() if a.folder and a.is_left_in(folder)), None)
