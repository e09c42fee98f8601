"""FMUs of a model: the work of `cosim build`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shutil import copyfile

from cosim.core.drafts import draft_of
from cosim.core.registry import entry_of, is_model, resolve
from cosim.core.scratch import temporary_folder
from cosim.core.settings import ModelName, Names
from cosim.files.files import FilePath, check_folder, named_path
from cosim.fmi.building.build_native import build_native, designed_model

PLANT = "plant.fmu"


def build(
    folder: FilePath = Path("build"),
    model: ModelName | None = None,
    *,
    nearest: bool = False,
    native: bool = False,
    fmi: int = 2,
    platforms: Names = (),
    design: FilePath | None = None,
    tell: Callable[[str], None] = lambda text: None,
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
        design: File of weights and numbers, by which start values of the model's controllers are designed.
        tell: Function that shows a warning of the design.

    Returns:
        Paths of the FMUs.

    Raises:
        InputError: Every fault of the input.
    """
    from cosim.fmi.fmu_build import Recipe
    from cosim.fmi.fmu_build import build as build_fmu

    folder = named_path(folder)
    check_folder(folder)
    if native:
        natives = build_native(folder, model, nearest=nearest, fmi=fmi, platforms=platforms, design=design, tell=tell)
        return [fmu.path for fmu in natives]

    loaded, starts = designed_model(model, nearest, design, tell)
    entry = entry_of(type(loaded.model))
    if entry is not None and entry.built and model in (None, entry.name):
        recipes, places = {}, dict(entry.built)
    else:
        every = {} if entry is None else entry.beside
        recipes = {PLANT: loaded.recipe()}
        places = {name: place for name, place in every.items() if name in starts or is_model(loaded.source)}
    for name, place in places.items():
        recipe: Recipe = resolve(place)()
        recipes[name] = recipe.with_starts(starts[name]) if name in starts else recipe
    with temporary_folder("build") as drafts:
        for name, recipe in recipes.items():
            draft = build_fmu(recipe, drafts / name)
            with draft_of(folder / name) as target:
                copyfile(draft, target)
    return [folder / name for name in recipes]
