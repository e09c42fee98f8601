"""Recipes of the craft's estimator FMUs."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.fmi.documentation import docstrings_html
from cosim.fmi.fmu_build import Recipe
from cosim.fmi.model_description import Description
from cosim.fmi.ports import Port
from fmus import PACKAGES


def filter_recipe() -> Recipe:
    """Return the build recipe of the FMU with linear filters and double integration."""
    from controller.kalman import discrete_model
    from controller.observers import DoubleIntegration, LinearFilter
    from fmus.estimator_fmu import HovercraftFilter

    about = _about("Estimators of the hovercraft: three Kalman filters, double integration", HovercraftFilter.ports)
    text = docstrings_html(LinearFilter, discrete_model, DoubleIntegration, HovercraftFilter)
    slave = ("fmus.estimator_fmu", "HovercraftFilter")
    return Recipe(slave, PACKAGES, about, text)


def extended_recipe() -> Recipe:
    """Return the recipe of the extended Kalman filter, with printed Jacobians instead of sympy."""
    from controller.extended import ExtendedFilter, FilterEquations
    from fmus.estimator_fmu import HovercraftEkf

    about = _about("Extended Kalman filter of the hovercraft on the plant's equations", HovercraftEkf.ports)
    text = docstrings_html(ExtendedFilter, FilterEquations, HovercraftEkf)
    slave = ("fmus.estimator_fmu", "HovercraftEkf")
    printed = (("controller.printed", jacobians()),)
    return Recipe(slave, PACKAGES, about, text, printed=printed)


def jacobians() -> str:
    """Return ∂f/∂x, ∂f/∂u and ∂a_x/∂x of the craft as a cached Python module."""
    from cosim.model.symbolic.jacobian import printed_jacobians
    from cosim.storage.cache import fingerprint, load_or_make
    from plant.hovercraft import Hovercraft

    code = fingerprint(("cosim.model", "cosim.model.symbolic", "plant", "plant.effects"))
    outputs, effects = ("ax",), ("yaw_damping",)
    key = f"jacobians of the hovercraft, {(outputs, effects)} {code}"
    return str(load_or_make(key, lambda: printed_jacobians(Hovercraft(), outputs, effects)))


def _about(text: str, ports: Sequence[Port]) -> Description:
    from fmus.estimator_fmu import DEPENDENCIES, initial_dependencies

    starting = initial_dependencies(ports)
    return Description(text, ports, DEPENDENCIES, starting, 0.02, 10.0, variable_step=False, sampled="sample_time")
