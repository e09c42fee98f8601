"""Kinds of files and folders, each declared once by the room that reads or leaves it.

A room declares its kinds as `ARTEFACTS` in its module `artefacts`, an installed package in its `Extension`. Which kind
a file is, which command reads it, whose folder one is, the JSON schema of a file and what `cosim.read` returns all
follow from the declarations.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import pkgutil
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.registry import attempt, extensions

ROOMS = Path(__file__).resolve().parent.parent
DECLARATIONS = "artefacts"  # module of a room


@dataclass(frozen=True)
class Artefact:
    """A kind of file, or a folder that a verb leaves.

    kind:        noun phrase for messages, such as "a scenario"
    next_step:   what to do with one; {file} is its path
    keys:        alternatives: a YAML or JSON file with all keys of one of them is of this kind
    without:     keys that a file of this kind never has
    verb:        command that leaves one, such as "cosim refine"
    marks:       names of files that this verb alone leaves in a folder, the telling one first
    folder:      noun phrase for such a folder
    folder_step: what to do with the folder; {file} is its path
    sources:     keys of the first mark that say what it was made from
    schema:      place, `module:name`, of the pydantic model of its keys, and `schema_name` and `title` of the schema
    check:       place of a function of (path) that raises InputError with its faults, and returns notes
    reader:      place of a function of (folder) that returns what `cosim.read` gives
    """

    kind: str
    next_step: str
    keys: tuple[frozenset[str], ...] = ()
    without: frozenset[str] = frozenset()
    verb: str = ""
    marks: tuple[str, ...] = ()
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


@functools.cache
def artefacts() -> tuple[Artefact, ...]:
    """Return all kinds that are declared, those of installed packages first."""
    declared: list[Artefact] = []
    for name, extension in extensions():
        if extension.artefacts:
            declared += attempt(name, extension.artefacts) or ()
    for room in pkgutil.iter_modules([str(ROOMS)], "cosim."):
        module = f"{room.name}.{DECLARATIONS}"
        if room.ispkg and importlib.util.find_spec(module) is not None:
            declared += importlib.import_module(module).ARTEFACTS
    return tuple(declared)


def of_kind(kind: str) -> Artefact:
    """Return the declaration of a kind."""
    return next(a for a in artefacts() if a.kind == kind)


def kind_by_keys(root: Any) -> str | None:
    """Return the kind of a YAML or JSON file by its keys, the one that needs most of them; None where none fits."""
    keys = frozenset(root) if isinstance(root, dict) else frozenset()
    best = max(artefacts(), key=lambda a: a.matched_keys(keys), default=None)
    return best.kind if best is not None and best.matched_keys(keys) else None


def left_in(folder: Path) -> Artefact | None:
    """Return what a verb left in a folder, None where no verb did."""
    return next((a for a in artefacts() if a.folder and any((folder / mark).is_file() for mark in a.marks)), None)
