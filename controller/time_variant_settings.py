"""Parameters of the predictive law with A(t), B(t): craft for the prediction, noise of the filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from controller.extended import ExtendedSettings
from controller.gains import CRAFT, declared, variance
from controller.variants import PredictionSettings
from cosim.model import SCALAR, parameters_of
from plant.hovercraft import Hovercraft
from plant.powertrain import ground_effect

NOISE = {p.name: p for p in parameters_of(ExtendedSettings)}
# The equations are assumed accurate to 1 % of a propeller's thrust, 25 mN at its arm, independently at each sample of
# 0.02 s: (0.025 N/m·Δt)², (0.025 N·L/I·Δt)². Positions and angles follow exactly from their rates.
PUSH, TURN, ROLL = 5e-7, 7e-5, 8.4e-5


def equation_noise(default: float, unit: str, of: str) -> float:
    """Declare the variance of the equations' error at each sample."""
    return variance(default, unit, f"process noise of {of} per step, what 1 % of a propeller's thrust makes")


@dataclass(frozen=True, kw_only=True)
class TimeVariantSettings(PredictionSettings):
    """Parameters of the craft's equations besides the design model, and noise of the extended filter.

    The thrust line passes through `thrust_nominal` at `duty_nominal`. Unused: `k_i_j`, `process_variance_a`.
    """

    estimators: ClassVar[tuple[str, ...]] = ("extended",)

    ixx: float = declared(CRAFT, "ixx")
    propeller_radius: float = declared(CRAFT, "propeller_radius")
    height: float = declared(CRAFT, "height")
    thrust_slope: float = declared(CRAFT, "thrust_slope")
    ground_effect_exponent: float = declared(CRAFT, "ground_effect_exponent")
    gravity: float = declared(CRAFT, "gravity")
    table_roll_stiffness: float = declared(CRAFT, "table_roll_stiffness")
    table_roll_damping: float = declared(CRAFT, "table_roll_damping")
    process_variance_x: float = equation_noise(0.0, "m2", "x")
    process_variance_y: float = equation_noise(0.0, "m2", "y")
    process_variance_psi: float = equation_noise(0.0, "rad2", "psi")
    process_variance_vx: float = equation_noise(PUSH, "m2/s2", "vx")
    process_variance_vy: float = equation_noise(PUSH, "m2/s2", "vy")
    process_variance_psi_dot: float = equation_noise(TURN, "rad2/s2", "psi_dot")
    process_variance_phi: float = equation_noise(0.0, "rad2", "phi")
    process_variance_phi_dot: float = equation_noise(ROLL, "rad2/s2", "phi_dot")
    process_variance_thrust_right: float = declared(NOISE, "process_variance_thrust_right")
    process_variance_thrust_left: float = declared(NOISE, "process_variance_thrust_left")
    process_variance_tilt_right: float = declared(NOISE, "process_variance_tilt_right")
    process_variance_tilt_left: float = declared(NOISE, "process_variance_tilt_left")
    measurement_variance_y: float = declared(NOISE, "measurement_variance_y")

    estimator: str = "extended"

    def __post_init__(self) -> None:
        super().__post_init__()
        if names := craft_faults(self):
            raise ValueError("; ".join(said for _, said in names))

    @cached_property
    def craft(self) -> Hovercraft:
        """Return the craft with these parameters."""
        return craft_of(self)

    @cached_property
    def noise(self) -> ExtendedSettings:
        """Return the filter's assumed noise."""
        return ExtendedSettings(**{name: getattr(self, name) for name in NOISE})


OF_CRAFT = tuple(p.name for p in parameters_of(TimeVariantSettings) if p.name in CRAFT)


def craft_of(p: Any) -> Hovercraft:
    """Return the craft with these parameters.

    Raises:
        ValueError: The parameters are invalid for a craft.
    """
    values = {name: getattr(p, name) for name in OF_CRAFT}
    return Hovercraft(**values, thrust_offset=_thrust_offset(p)).with_values({"yaw_damping.coefficient": p.yaw_damping})


def craft_faults(p: Any) -> list[tuple[tuple[str, ...], str]]:
    """Return names and reasons of parameters invalid for a craft."""
    low, high = CRAFT["thrust_offset"].bounds
    if not low <= _thrust_offset(p) <= high:
        names = "thrust_nominal", "thrust_slope", "duty_nominal"
        said = (
            f"a thrust line of {p.thrust_slope:g} gf/% through thrust_nominal {p.thrust_nominal:g} N at"
            f" {p.duty_nominal:g} % has {_thrust_offset(p):.4g} gf at no duty; take numbers that give"
            f" {low:g} to {high:g} gf"
        )
        return [(names, said)]
    try:
        craft_of(p)
    except ValueError as error:
        return [(("yaw_damping",), str(error))]
    return []


def _thrust_offset(p: Any) -> float:
    """Return the offset a [gf] of the thrust line T_OGE = a + b·δ, eq 4.20, so that Γ·T_OGE(δ_N) = T_N."""
    gain = ground_effect(SCALAR, p.height, p.propeller_radius, p.ground_effect_exponent)
    return float(1000.0 * p.thrust_nominal / (p.gravity * gain) - p.thrust_slope * p.duty_nominal)
