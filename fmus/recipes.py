"""Recipes of the craft's own FMUs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from controller.settings import Settings
from cosim.core.registry import resolve
from cosim.fmi.fmu_build import Recipe, model_recipe
from cosim.fmi.model_description import Description, docstrings_html
from fmus import FMU_PACKAGES

# A second plant for scenarios/swap.yaml: a heavier craft whose servos overshoot (observed in §4.5.4).
HEAVY = {
    "mass": 0.8,
    "izz": 0.0116,
    "actuator_second_order.natural_frequency": 16.0,
    "actuator_second_order.damping_ratio": 0.5,
}


def _model(place: str, values: Mapping[str, float | bool] | None = None) -> Recipe:
    """Return the recipe of a model's FMU, with defaults from `values`; `place` is `module:class` in `plant`."""
    module = resolve(f"plant.{place.partition(':')[0]}")
    model = resolve(f"plant.{place}")()
    return replace(model_recipe(model, Path(module.__file__), values), packages=FMU_PACKAGES)


plant_recipe = partial(_model, "hovercraft:Hovercraft")
heavy_recipe = partial(plant_recipe, HEAVY)
bench_recipe = partial(_model, "bench:Bench")


def _sampled(name: str) -> Recipe:
    """Return the recipe of a controller or estimator with the docstrings of its parts."""
    kind = resolve(f"fmus.controller_fmu:{name}")
    step, (at_sample, at_start) = Settings().sample_time, kind.depends
    description = Description(
        kind.about, kind.ports, at_sample, at_start, step=step, stop=10.0, variable_step=False, sampled="sample_time"
    )
    parts = (resolve(f"controller.{part}") for part in kind.parts)
    recipe = Recipe((kind.__module__, name), FMU_PACKAGES, description, docstrings_html(*parts, kind))
    return replace(recipe, printed=(("controller.printed", jacobians()),)) if kind.needs_jacobians else recipe


controller_recipe = partial(_sampled, "HovercraftController")
poles_recipe = partial(_sampled, "HovercraftPolesController")
integral_recipe = partial(_sampled, "HovercraftIntegralController")
predictive_recipe = partial(_sampled, "HovercraftPredictiveController")
time_variant_recipe = partial(_sampled, "HovercraftTimeVariantController")
filter_recipe = partial(_sampled, "HovercraftFilter")
extended_recipe = partial(_sampled, "HovercraftEkf")


def jacobians() -> str:
    """Return ∂f/∂x, ∂f/∂u and ∂a_x/∂x of the craft as a cached Python module."""
    from cosim.files.cache import fingerprint, load_or_make
    from cosim.model.symbolic.linearize import printed_jacobians
    from plant.hovercraft import Hovercraft

    code = fingerprint(("cosim.model", "cosim.model.symbolic", "plant"))
    outputs, effects = ("ax",), ("yaw_damping",)
    key = f"jacobians of the hovercraft, {(outputs, effects)} {code}"
    return str(load_or_make(key, lambda: printed_jacobians(Hovercraft(), outputs, effects)))
