"""Controllers with other laws than LQR as FMI slaves, with the same estimator and ports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from controller.laws import IntegralFeedback, Law
from controller.time_variant_settings import TimeVariantSettings
from controller.variants import PredictiveSettings, integral_settings, placed_settings
from cosim.fmi.ports import Port, Value
from fmus.controller_fmu import DEPENDENCIES, INITIAL_DEPENDENCIES, HovercraftController, controller_ports
from fmus.craft_ports import ESTIMATES

Dependencies = Mapping[str, Sequence[str]]
INTEGRALS = (
    Port("x_integral", "output", 0.0, "m.s", "integral of the error of the measured position"),
    Port("psi_integral", "output", 0.0, "rad.s", "integral of the error of the measured heading"),
)
LATERAL = (
    Port("y_hat", "output", 0.0, "m", "estimated drift to the right"),
    Port("y_sigma", "output", 0.0, "m", "standard deviation of y_hat the filter believes in"),
    Port("iterations", "output", 0.0, "1", "iterations of the solver at this sample"),
    Port("solved", "output", 1.0, "1", "1 where the solver ended in a solution, 0 by its limit of iterations"),
)
Y_REF = Port("y_ref", "input", 0.0, "m", "reference of the drift to the right", optional=True)
Y_START = Port("y_hat_start", "parameter", 0.0, "m", "start value of y_hat; the filter knows where it starts")


def extended(ports: Sequence[Port], *more: Port) -> tuple[Port, ...]:
    """Return ports with further ones inserted by causality."""
    every = (*ports, *more)
    return tuple(p for causality in ("input", "output", "parameter") for p in every if p.causality == causality)


class HovercraftPolesController(HovercraftController):
    """Pole placement: −2, −4, −11 rad/s of the forward axis, −4, −5 rad/s of the turn.

    The common tilt drives the forward axis, the tilt difference the turn, so that the gain of each is unique. At most
    two poles are equal, one in each axis.
    """

    settings = placed_settings()
    ports = controller_ports(settings)


class HovercraftIntegralController(HovercraftController):
    """LQR with integral action on measured errors: of x from position fixes, of ψ from the IMU."""

    settings = integral_settings()
    ports = extended(controller_ports(settings), *INTEGRALS)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return state feedback with integrals."""
        return IntegralFeedback(settings)


class HovercraftPredictiveController(HovercraftController):
    """Model predictive control with limits of tilt and duty, and with control of y by position fixes.

    The host also needs the solver daqp.
    """

    settings = PredictiveSettings()
    ports = extended(controller_ports(settings), Y_REF, *LATERAL, Y_START)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the predictive law.

        The solver is imported here, since other controllers do not need it.
        """
        from controller.predictive import PredictiveLaw

        return PredictiveLaw(settings, float(given.get("y_hat_start", 0.0)))


class HovercraftTimeVariantController(HovercraftController):
    """Predictive control with A(t), B(t) along the planned motion, and its own extended Kalman filter.

    Tilt and duty are limited. With position fixes, y is controlled too. The host also needs the solver daqp.
    """

    settings = TimeVariantSettings()
    ports = extended(controller_ports(settings), Y_REF, *LATERAL, Y_START)

    def law(self, settings: Any, given: dict[str, Value]) -> Law:
        """Return the time-variant law, with the Jacobian functions that were printed when the FMU was built."""
        from controller import printed  # type: ignore[attr-defined]
        from controller.time_variant import TimeVariantLaw

        return TimeVariantLaw(settings, vars(printed), float(given.get("y_hat_start", 0.0)))


def integral_dependencies() -> tuple[Dependencies, Dependencies]:
    """Return output dependencies at a sample and in initialization mode."""
    tilts = DEPENDENCIES["tilt_right"]
    # saturation of a tilt affects both integrals
    at_sample = {**DEPENDENCIES, "x_integral": tilts, "psi_integral": tilts}
    return at_sample, {**INITIAL_DEPENDENCIES, "x_integral": (), "psi_integral": ()}


def predictive_dependencies(slave: type[HovercraftController]) -> tuple[Dependencies, Dependencies]:
    """Return output dependencies; commands depend on all inputs and parameters."""
    inputs = tuple(p.name for p in slave.ports if p.causality == "input")
    parameters = [p.name for p in slave.ports if p.causality == "parameter" and p.kind == "Real"]
    known = ("x_ref", "psi_ref", "y_ref", *(name for name in parameters if not name.startswith("k_")))
    solved = ("duty_right", "duty_left", "tilt_right", "tilt_left", "iterations", "solved")
    at_sample = {**DEPENDENCIES, "y_hat": ("y_meas", "fix"), "y_sigma": ("fix",), **dict.fromkeys(solved, inputs)}
    at_start = {**INITIAL_DEPENDENCIES, "y_hat": ("y_hat_start",), "y_sigma": (), **dict.fromkeys(solved, known)}
    return at_sample, at_start


def time_variant_dependencies() -> tuple[Dependencies, Dependencies]:
    """Return dependencies with an own filter, which couples all estimates."""
    at_sample, at_start = predictive_dependencies(HovercraftTimeVariantController)
    measured = tuple(n for n in at_sample["tilt_right"] if not n.endswith("_ref"))
    estimates = (*(p.name for p in ESTIMATES), "x_sigma", "psi_sigma", "y_hat", "y_sigma")
    known = tuple(n for n in at_start["tilt_right"] if not n.endswith("_ref"))
    return {**at_sample, **dict.fromkeys(estimates, measured)}, {**at_start, "a_hat": known}
