"""Files of a refine's folder: the refined model and FMU, and the nearest ones."""

from __future__ import annotations

from pathlib import Path

from cosim.files.folders import content_of, newest_run

ANSWER = "refine.json"
REFINED = ("model.yaml", "plant.fmu")
NEAREST = ("nearest.yaml", "nearest.fmu")


class NoNearest(ValueError):
    """A missing nearest model, with reason and remedy."""


def folder_of(path: Path) -> Path | None:
    """Return the folder of a refine from its path or the path of a file in it."""
    folder = newest_run(path) if path.is_dir() else path.parent
    return folder if path.exists() and (folder / ANSWER).is_file() else None


def refined_file(path: Path, *, nearest: bool = False) -> Path:
    """Return the model.yaml or FMU in a refine.

    Args:
        path: Folder of the refine, its refine.json or another of its files.
        nearest: Whether to return the nearest model, equal to the refined model for a complete claim.

    Raises:
        NoNearest: No nearest model exists.
    """
    if not nearest:
        return (newest_run(path) if path.is_dir() else path.parent) / REFINED[0] if names_refine(path) else path
    folder = folder_of(path)
    if folder is None:
        raise NoNearest(
            f"{path} is of no refine, so there is no nearest model; name the folder that `cosim refine` left, or "
            "leave nearest out"
        )
    kind = 1 if path.suffix == ".fmu" else 0
    if (folder / NEAREST[kind]).is_file():
        return folder / NEAREST[kind]
    if content_of(folder / ANSWER).get("grade") == "claimed":
        return folder / REFINED[kind]
    raise NoNearest(f"{folder} holds no {NEAREST[kind]}; refine its study again, or leave nearest out")


def names_refine(path: Path) -> bool:
    """Return whether a path is the results folder of `cosim refine` or its refine.json, and not another file in it."""
    return path.name == ANSWER if path.is_file() else (newest_run(path) / ANSWER).is_file()
