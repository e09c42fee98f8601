"""What a refine left in a folder: the refined model and its FMU, and those that come nearest."""

from __future__ import annotations

import json
from pathlib import Path

ANSWER = "refine.json"
REFINED = ("model.yaml", "plant.fmu")
NEAREST = ("nearest.yaml", "nearest.fmu")


class NoNearest(ValueError):
    """There is no nearest model: why, and the cure."""


def folder_of(path: Path) -> Path | None:
    """The folder that a refine left, if that is what is named: itself, or a file in it."""
    folder = path if path.is_dir() else path.parent
    return folder if path.exists() and (folder / ANSWER).is_file() else None


def refined_file(path: Path, *, nearest: bool = False) -> Path:
    """The model.yaml or FMU that is meant where a refine is named by its folder, its refine.json or a file in it.

    nearest: the one that comes nearest, which is the refined one where all is claimed; NoNearest where there is none
    """
    if not nearest:
        return (path if path.is_dir() else path.parent) / REFINED[0] if names_refine(path) else path
    folder = folder_of(path)
    if folder is None:
        cure = "name the folder that `cosim refine` left, or leave nearest out"
        raise NoNearest(f"{path} is of no refine, so there is no nearest model; {cure}")
    kind = 1 if path.suffix == ".fmu" else 0
    if (folder / NEAREST[kind]).is_file():
        return folder / NEAREST[kind]
    if _grade(folder / ANSWER) == "claimed":
        return folder / REFINED[kind]
    raise NoNearest(f"{folder} holds no {NEAREST[kind]}; refine its study again, or leave nearest out")


def names_refine(path: Path) -> bool:
    """A refine is named as a whole, by its folder or its refine.json."""
    return path.name == ANSWER if path.is_file() else (path / ANSWER).is_file()


def _grade(answer: Path) -> object:
    """`claimed`, `part` or `nearest`, as a refine.json has it; None of one that says nothing of it."""
    try:
        content = json.loads(answer.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content.get("grade") if isinstance(content, dict) else None
