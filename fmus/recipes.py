"""Recipes of the craft's own FMUs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from types import ModuleType

from controller.settings import Settings
from cosim.core.registry import resolve
from cosim.fmi.fmu_build import Recipe, about_model
from cosim.fmi.model_description import Description, docstrings_html, model_text
from cosim.model import Model
from fmus import FMU_PACKAGES

# A second plant for scenarios/swap.yaml: a heavier craft whose servos overshoot (observed in §4.5.4).
HEAVY = {
    "mass": 0.8,
    "izz": 0.0116,
    "actuator_second_order.natural_frequency": 16.0,
    "actuator_second_order.damping_ratio": 0.5,
}
Numbers = Mapping[str, float | bool]


def plant_recipe(values: Numbers | None = None) -> Recipe:
    """Return the recipe of the plant, with defaults from `values`."""
    import cosim.model.planar as planar
    import plant.hovercraft as craft

    about = "Thrust-vectoring hovercraft on an air table: two tilting propellers with lag and ground effect"
    slave = ("fmus.plant_fmu", "HovercraftPlant")
    return _model(slave, craft.Hovercraft(), values, about, "An unconnected plant hovers.", craft, planar)


def bench_recipe(values: Numbers | None = None) -> Recipe:
    """Return the build recipe of the testing bench's FMU; `values` replace default parameters."""
    import plant.bench as bench

    about = "Testing bench: one tilting propeller on three load cells, converted by 12 bit and low-passed"
    slave = ("fmus.bench_fmu", "PropellerBench")
    return _model(slave, bench.Bench(), values, about, "An unconnected bench is at rest.", bench)


def _model(
    slave: tuple[str, str], model: Model, values: Numbers | None, about: str, text: str, *modules: ModuleType
) -> Recipe:
    description = about_model(model.with_values(values or {}), about)
    whole = f"<p>{text}</p>{model_text(model)}{docstrings_html(*modules)}"
    return Recipe(slave, FMU_PACKAGES, description, whole, tuple(sorted((values or {}).items())))


heavy_recipe = partial(plant_recipe, HEAVY)


def _sampled(slave: str, about: str, *documented: str, printed: bool = False) -> Recipe:
    """Return the recipe of a controller or estimator with the docstrings of its parts.

    Args:
        printed: True to include generated Jacobians, so that the FMU does not need sympy.
    """
    kind = resolve(f"fmus.{slave}")
    step, (at_sample, at_start) = Settings().sample_time, kind.depends
    description = Description(
        about, kind.ports, at_sample, at_start, step=step, stop=10.0, variable_step=False, sampled="sample_time"
    )
    parts = (resolve(f"controller.{name}") for name in documented)
    recipe = Recipe((kind.__module__, kind.__name__), FMU_PACKAGES, description, docstrings_html(*parts, kind))
    return replace(recipe, printed=(("controller.printed", jacobians()),)) if printed else recipe


LOOP_FUNCTION, MODEL_FUNCTION, EXTENDED_FILTER = "loop:Loop", "design_model:discrete_model", "observers:ExtendedFilter"
FLIGHT = "Flight controller of the hovercraft: "
controller_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftController",
    f"{FLIGHT}Kalman filter and LQR with tilt saturation",
    LOOP_FUNCTION,
    MODEL_FUNCTION,
)
poles_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftPolesController",
    f"{FLIGHT}Kalman filter and poles placed, with tilt saturation",
    LOOP_FUNCTION,
    MODEL_FUNCTION,
)
integral_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftIntegralController",
    f"{FLIGHT}Kalman filter and LQR with integrals of position and heading",
    LOOP_FUNCTION,
    MODEL_FUNCTION,
    "loop:IntegralFeedback",
)
predictive_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftPredictiveController",
    f"{FLIGHT}Kalman filter and model predictive control with limits",
    LOOP_FUNCTION,
    MODEL_FUNCTION,
    "predictive:PredictiveLaw",
    "observers:HoverFilter",
)
time_variant_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftTimeVariantController",
    f"{FLIGHT}extended Kalman filter and predictive control along the planned motion",
    LOOP_FUNCTION,
    "predictive:PredictiveLaw",
    EXTENDED_FILTER,
    printed=True,
)
filter_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftFilter",
    "Estimators of the hovercraft: three Kalman filters, double integration",
    "observers:LinearFilter",
    MODEL_FUNCTION,
    "observers:DoubleIntegration",
)
extended_recipe = partial(
    _sampled,
    "controller_fmu:HovercraftEkf",
    "Extended Kalman filter of the hovercraft on the plant's equations",
    EXTENDED_FILTER,
    printed=True,
)


def jacobians() -> str:
    """Return ∂f/∂x, ∂f/∂u and ∂a_x/∂x of the craft as a cached Python module."""
    from cosim.files.cache import fingerprint, load_or_make
    from cosim.model.symbolic.linearize import printed_jacobians
    from plant.hovercraft import Hovercraft

    code = fingerprint(("cosim.model", "cosim.model.symbolic", "plant"))
    outputs, effects = ("ax",), ("yaw_damping",)
    key = f"jacobians of the hovercraft, {(outputs, effects)} {code}"
    return str(load_or_make(key, lambda: printed_jacobians(Hovercraft(), outputs, effects)))
