"""The FMUs of a model: what `cosim build` makes."""

from __future__ import annotations

from pathlib import Path

from cosim.errors import Fault, InputError
from cosim.files import FilePath
from cosim.models.file import LoadedModel, load_model
from cosim.models.refined import NoNearest, names_refine, refined_file
from cosim.registry import BASE_NAME, MODELS, resolve


def build(folder: FilePath, model: str | None = None, *, nearest: bool = False) -> list[Path]:
    """Build in `folder` the FMUs of a model: base, a model.yaml, file.py:Class, a refine; without one, all there are.

    nearest: of the model that came nearest in the refine that is named. Raises InputError.
    """
    from fmus.build import build as build_fmu

    if model is None and nearest:
        cure = "name the folder of a refine as --model, or leave it out"
        raise InputError([Fault(Path("--nearest"), 0, 0, f"says nothing without a model; {cure}")])
    if model is None:
        recipes = {name: resolve(recipe)() for name, recipe in MODELS[BASE_NAME].built.items()}
    else:
        loaded = meant(model, nearest=nearest)
        recipes = {"plant.fmu": loaded.recipe()}
        if loaded.source in MODELS:
            recipes |= {name: resolve(recipe)() for name, recipe in MODELS[loaded.source].beside.items()}
    return [build_fmu(recipe, Path(folder) / name) for name, recipe in recipes.items()]


def meant(model: str, *, nearest: bool) -> LoadedModel:
    """The model that is named; of a refine the refined one, or the one that came nearest."""
    try:
        file = refined_file(Path(model), nearest=nearest) if nearest or names_refine(Path(model)) else model
    except NoNearest as error:
        raise InputError([Fault(Path(model), 0, 0, str(error))]) from None
    return load_model(str(file), Path())
