"""The FMUs of a model: what `cosim build` makes."""

from __future__ import annotations

from pathlib import Path

from cosim.files import FilePath
from cosim.models.file import load_model
from cosim.registry import BASE_NAME, MODELS, resolve


def build(folder: FilePath, model: str | None = None) -> list[Path]:
    """Build the FMUs of a model (base, a model.yaml, file.py:Class) in `folder`; without one, all of this package.

    Raises InputError.
    """
    from fmus.build import build as build_fmu

    if model is None:
        recipes = {name: resolve(recipe)() for name, recipe in MODELS[BASE_NAME].built.items()}
    else:
        loaded = load_model(model, Path())
        recipes = {"plant.fmu": loaded.recipe()}
        if loaded.source in MODELS:
            recipes |= {name: resolve(recipe)() for name, recipe in MODELS[loaded.source].beside.items()}
    return [build_fmu(recipe, Path(folder) / name) for name, recipe in recipes.items()]
