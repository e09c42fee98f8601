"""FMUs of a model: the work of `cosim build`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shutil import copyfile

from cosim.base.drafts import draft_of
from cosim.base.registry import is_model, model_entry, resolve
from cosim.base.scratch import temporary_folder
from cosim.base.settings import ModelName
from cosim.loading.file import meant_model
from cosim.loading.substep import with_substep
from cosim.storage.files import FilePath, check_folder, named_path

PLANT = "plant.fmu"


def build(
    folder: FilePath,
    model: ModelName | None = None,
    *,
    nearest: bool = False,
    native: bool = False,
    fmi: int = 2,
    platforms: Sequence[str] = (),
) -> list[Path]:
    """Build the FMUs of a model.

    Args:
        folder: Folder for the FMUs.
        model: Registered model, model.yaml, file.py:Class, or the folder of a refine; None takes all FMUs of the base
            model.
        nearest: Use nearest.yaml instead of model.yaml of the refine folder.
        native: Build compiled FMUs, which need no Python.
        fmi: FMI version of native FMUs, 2 or 3.
        platforms: Platforms of native FMUs; none means this machine.

    Returns:
        Paths of the FMUs.

    Raises:
        InputError: Every fault of the input.
    """
    from cosim.fmi.fmu_build import build as build_fmu

    folder = named_path(folder)
    check_folder(folder)
    if native:
        from cosim.loading.build_native import build_native

        return [fmu.path for fmu in build_native(folder, model, nearest=nearest, fmi=fmi, platforms=platforms)]

    loaded, _ = with_substep(meant_model(model, nearest=nearest))
    if model is None and not nearest:
        recipes = {name: resolve(recipe)() for name, recipe in model_entry().built.items()}
    else:
        recipes = {PLANT: loaded.recipe()}
        if is_model(loaded.source):
            recipes |= {name: resolve(recipe)() for name, recipe in model_entry(loaded.source).beside.items()}
    with temporary_folder("build") as drafts:
        for name, recipe in recipes.items():
            draft = build_fmu(recipe, drafts / name)
            with draft_of(folder / name) as target:
                copyfile(draft, target)
    return [folder / name for name in recipes]
