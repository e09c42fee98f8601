"""Files in a folder written by `cosim refine`: model.yaml and FMU of the refined model and of the nearest model."""

from __future__ import annotations

from pathlib import Path

from cosim.core.errors import InputError
from cosim.files.folders import content_of, newest_run

REFINE_RECORD = "refine.json"
REFINED = ("model.yaml", "plant.fmu")
NEAREST = ("nearest.yaml", "nearest.fmu")


def folder_of(path: Path) -> Path | None:
    """Return the folder that `cosim refine` wrote, from its path or the path of a file in it; otherwise None."""
    folder = newest_run(path) if path.is_dir() else path.parent
    return folder if path.exists() and (folder / REFINE_RECORD).is_file() else None


def refined_file(path: Path, *, nearest: bool = False) -> Path:
    """Return the path of the model.yaml or FMU in a folder written by `cosim refine`.

    Args:
        path: The folder, its refine.json or another of its files.
        nearest: Return the nearest model, which equals the refined model if the claim is complete.

    Raises:
        InputError: No nearest model exists.
    """
    folder = folder_of(path)
    if not nearest:
        return folder / REFINED[0] if folder is not None and names_refine(path) else path
    if folder is None:
        reason = "is not a result of `cosim refine`, so it has no nearest model; give the folder of a refine, or omit"
        raise InputError.at(path, f"{reason} nearest")
    kind = 1 if path.suffix == ".fmu" else 0
    if (folder / NEAREST[kind]).is_file():
        return folder / NEAREST[kind]
    if content_of(folder / REFINE_RECORD).get("grade") == "claimed":
        return folder / REFINED[kind]
    raise InputError.at(path, f"has no {NEAREST[kind]}; refine its study again, or omit nearest")


def names_refine(path: Path) -> bool:
    """Return True if a path is the result folder of `cosim refine` or its refine.json, but no other file in it."""
    return (path.is_dir() or path.name == REFINE_RECORD) and folder_of(path) is not None
