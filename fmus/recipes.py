"""Recipes of the craft's own FMUs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cosim.fmi.documentation import docstrings_html, model_text
from cosim.fmi.fmu_build import Recipe, about_model, sort_values
from cosim.fmi.model_description import Description
from fmus import PACKAGES

# A second plant for scenarios/swap.yaml: a heavier craft whose servos overshoot (observed in §4.5.4).
HEAVY = {
    "mass": 0.8,
    "izz": 0.0116,
    "actuator_second_order.natural_frequency": 16.0,
    "actuator_second_order.damping_ratio": 0.5,
}

Dependencies = Mapping[str, Sequence[str]]


def plant_recipe(values: Mapping[str, float | bool] | None = None) -> Recipe:
    """Return the recipe of the plant, with defaults from `values`."""
    import cosim.model.planar as planar
    import plant.hovercraft as craft

    model = craft.Hovercraft()
    about = about_model(
        model.with_values(values or {}),
        "Thrust-vectoring hovercraft on an air table: two tilting propellers with lag and ground effect",
    )
    text = f"<p>An unconnected plant hovers.</p>{model_text(model)}{docstrings_html(craft, planar)}"
    return Recipe(("fmus.plant_fmu", "HovercraftPlant"), PACKAGES, about, text, sort_values(values))


def heavy_recipe() -> Recipe:
    """Return the build recipe of the FMU of the heavier craft."""
    return plant_recipe(HEAVY)


def controller_recipe() -> Recipe:
    """Return the recipe of the controller."""
    from fmus.controller_fmu import DEPENDENCIES, INITIAL_DEPENDENCIES, HovercraftController

    text = "Flight controller of the hovercraft: Kalman filter and LQR with tilt saturation"
    return _controller(HovercraftController, text, (DEPENDENCIES, INITIAL_DEPENDENCIES))


def poles_recipe() -> Recipe:
    """Return the recipe of the controller by pole placement."""
    from fmus.controller_fmu import DEPENDENCIES, INITIAL_DEPENDENCIES
    from fmus.controller_laws import HovercraftPolesController

    text = "Flight controller of the hovercraft: Kalman filter and poles placed, with tilt saturation"
    return _controller(HovercraftPolesController, text, (DEPENDENCIES, INITIAL_DEPENDENCIES))


def integral_recipe() -> Recipe:
    """Return the recipe of the controller with integrals."""
    from controller.laws import IntegralFeedback
    from fmus.controller_laws import HovercraftIntegralController, integral_dependencies

    text = "Flight controller of the hovercraft: Kalman filter and LQR with integrals of position and heading"
    return _controller(HovercraftIntegralController, text, integral_dependencies(), IntegralFeedback)


def predictive_recipe() -> Recipe:
    """Return the recipe of the predictive controller."""
    from controller.predictive import PredictiveLaw
    from fmus.controller_laws import HovercraftPredictiveController, predictive_dependencies

    text = "Flight controller of the hovercraft: Kalman filter and model predictive control with limits"
    depends = predictive_dependencies(HovercraftPredictiveController)
    return _controller(HovercraftPredictiveController, text, depends, PredictiveLaw)


def time_variant_recipe() -> Recipe:
    """Return the recipe of the predictive controller with A(t), B(t)."""
    from controller.extended import ExtendedFilter, FilterEquations
    from controller.time_variant import TimeVariantLaw
    from fmus.controller_laws import HovercraftTimeVariantController, time_variant_dependencies
    from fmus.estimator_recipes import jacobians

    text = "Flight controller of the hovercraft: extended Kalman filter and predictive control along the planned motion"
    more = TimeVariantLaw, ExtendedFilter, FilterEquations
    slave = HovercraftTimeVariantController
    recipe = _controller(slave, text, time_variant_dependencies(), *more, linear=False)
    return replace(recipe, printed=(("controller.printed", jacobians()),))


def _controller(
    slave: Any, about: str, dependencies: tuple[Dependencies, Dependencies], *more: object, linear: bool = True
) -> Recipe:
    """Return the recipe of a controller; `linear` if its filter predicts by the linear model."""
    from controller.kalman import discrete_model
    from controller.loop import Loop

    times = {"step": slave.settings.sample_time, "stop": 10.0, "variable_step": False, "sampled": "sample_time"}
    description = Description(about, slave.ports, *dependencies, **times)
    own = (discrete_model,) if linear else ()
    text = docstrings_html(Loop, *own, *more, slave)
    return Recipe((slave.__module__, slave.__name__), PACKAGES, description, text)


def bench_recipe(values: Mapping[str, float | bool] | None = None) -> Recipe:
    """Return the build recipe of the testing bench's FMU; `values` replace default parameters."""
    import plant.bench as bench

    model = bench.Bench()
    about = about_model(
        model.with_values(values or {}),
        "Testing bench: one tilting propeller on three load cells, converted by 12 bit and low-passed",
    )
    text = f"<p>An unconnected bench is at rest.</p>{model_text(model)}{docstrings_html(bench)}"
    return Recipe(("fmus.bench_fmu", "PropellerBench"), PACKAGES, about, text, sort_values(values))
