"""Parameters of the running controllers and estimators, declared once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from cosim.model import SCALAR, parameters_of
from cosim.model.model import Parametric
from plant.effects import bounded, frozen
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft
from plant.powertrain import ground_effect

Floats = tuple[float, ...]
Numbers = Sequence[float]
ESTIMATORS, DOUBLE_INTEGRATION = ("appendix_f", "lagged", "consistent"), "double_integration"
SENSED = ("psi", "psi_dot", "ax")
SIDES = ("right", "left")
GAINS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in range(1, 6))  # K, row by row
CRAFT_PARAMETERS = {p.name: p for p in parameters_of(Hovercraft)}
DESIGN = "design model: "  # beginning of meanings

# Eq 6.5 with all digits: LQR gain of eqs 5.33/5.34 with the weights of eq 6.4. A test repeats the design.
K_X = math.sqrt(0.5)
K_VX = 0.6593433035062245
K_PSI = math.sqrt(0.05)
K_PSI_DOT = 0.1016985602839789
K_A = 0.0495788342133304


def gain(default: float, tilt: str, state: str, source: str = ", eq 6.5") -> Any:
    """Declare an entry of K or K_i: tilt command [rad] per unit of a state."""
    units = {"x": "rad/m", "vx": "rad.s/m", "psi": "1", "psi_dot": "s", "a": "rad.s2/m"}
    unit = (units | {"the integral of x": "rad/m/s", "the integral of psi": "1/s"})[state]
    return bounded(default, unit, (-1e4, 1e4), f"gain from {state} to the {tilt} tilt{source}")


def of_craft(name: str, about: str = "") -> Any:
    """Declare a parameter of the craft for a controller; `about` precedes its description."""
    p = CRAFT_PARAMETERS[name]
    return bounded(p.default, p.unit, p.bounds, about + p.doc)


def variance(default: float, unit: str, doc: str) -> Any:
    """Declare a noise variance."""
    return bounded(default, unit, (0, 1e6), doc)


def variances_of(p: Any, kind: str, names: Sequence[str]) -> Floats:
    """Return the variances of named states or readings; 0 for those without noise."""
    return tuple(getattr(p, f"{kind}_variance_{name}", 0.0) for name in names)


@frozen
class Noise(Parametric):
    """Noise that every filter assumes, by step or reading, and its sample time.

    Attributes:
        choices: Name of a text parameter → its allowed values.
    """

    choices: ClassVar[Mapping[str, Sequence[str]]] = {}

    process_variance_x: float = variance(1e-4, "m2", "variance of the process noise of x per step (thesis, eq 5.47)")
    process_variance_vx: float = variance(
        1e-4, "m2/s2", "variance of the process noise of vx per step (thesis, eq 5.47)"
    )
    process_variance_psi: float = variance(
        2.613e-5, "rad2", "variance of the process noise of psi per step (thesis, eq 5.47)"
    )
    process_variance_psi_dot: float = variance(
        4.564e-4, "rad2/s2", "variance of the process noise of psi_dot per step (thesis, eq 5.47)"
    )
    measurement_variance_psi: float = variance(
        SENSOR_VARIANCE["psi"], "rad2", "variance of the measurement noise of psi (thesis, eq 5.46)"
    )
    measurement_variance_psi_dot: float = variance(
        SENSOR_VARIANCE["psi_dot"], "rad2/s2", "variance of the measurement noise of psi_dot (thesis, eq 5.46)"
    )
    measurement_variance_ax: float = variance(
        SENSOR_VARIANCE["ax"], "m2/s4", "variance of the measurement noise of ax (thesis, eq 5.46)"
    )
    measurement_variance_x: float = variance(
        1e-4, "m2", "variance of the noise of a fix of x; the thesis has no fixes, §7.1"
    )
    fix_latency: float = bounded(0.0, "s", (0, 1), "age of a fix when it arrives, §7.1")
    sample_time: float = bounded(0.02, "s", (1e-4, 1), "sample time, Fig 4.8")

    def invalid_values(self) -> list[str]:
        """Return a sentence on each invalid value."""
        texts = ((name, getattr(self, name), allowed) for name, allowed in self.choices.items())
        wrong = [f"{n} is {v!r}; allowed: {', '.join(allowed)}" for n, v, allowed in texts if v not in allowed]
        return [*super().invalid_values(), *wrong]


@frozen
class FilterSettings(Noise):
    """Parameters of a filter that uses the design model, or of double integration."""

    choices = {"estimator": (*ESTIMATORS, DOUBLE_INTEGRATION)}  # noqa: RUF012 - a ClassVar of the base

    mass: float = of_craft("mass", DESIGN)
    izz: float = of_craft("izz", DESIGN)
    arm: float = of_craft("arm", DESIGN)
    friction: float = of_craft("friction", DESIGN)
    lag: float = of_craft("lag", DESIGN)
    duty_nominal: float = of_craft("duty_nominal", DESIGN)
    thrust_nominal: float = bounded(
        2.4973, "N", (0.01, 100), "design model: thrust per propeller in ground effect T_N, eq 5.36"
    )
    yaw_damping: float = bounded(
        0.0, "N.m.s/rad", (0, 10), "design model: viscous yaw moment per yaw rate; the thesis has none"
    )
    process_variance_a: float = variance(1e-4, "m2/s4", "process noise of the thrust acceleration per step, eq 5.47")

    estimator: str = "appendix_f"

    @property
    def process_variances(self) -> Floats:
        """Return the diagonal of V, eq 5.47, shape (5,)."""
        return variances_of(self, "process", ("x", "vx", "psi", "psi_dot", "a"))

    @property
    def measurement_variances(self) -> Floats:
        """Return the diagonal of W, eq 5.46, shape (3,)."""
        return variances_of(self, "measurement", SENSED)


@frozen
class Settings(FilterSettings):
    """Parameters of the controller FMU."""

    choices = {"estimator": ESTIMATORS}  # noqa: RUF012 - a ClassVar of the base
    fed_back: ClassVar[int] = 5  # states

    k_1_1: float = gain(K_X, "right", "x")
    k_1_2: float = gain(K_VX, "right", "vx")
    k_1_3: float = gain(K_PSI, "right", "psi")
    k_1_4: float = gain(K_PSI_DOT, "right", "psi_dot")
    k_1_5: float = gain(K_A, "right", "a")
    k_2_1: float = gain(K_X, "left", "x")
    k_2_2: float = gain(K_VX, "left", "vx")
    k_2_3: float = gain(-K_PSI, "left", "psi")
    k_2_4: float = gain(-K_PSI_DOT, "left", "psi_dot")
    k_2_5: float = gain(K_A, "left", "a")
    tilt_max: float = bounded(math.radians(12), "rad", (0, math.pi / 2), "tilt saturation, App G")

    @property
    def gain_matrix(self) -> tuple[Floats, ...]:
        """Return K, shape (2, `fed_back`)."""
        return tuple(tuple(getattr(self, f"k_{i}_{j + 1}") for j in range(self.fed_back)) for i in (1, 2))


# -- other laws --------------------------------------------------------------------------------

# Gains of the poles -2, -4, -11 (forward) and -4, -5 rad/s (turn), and of the LQR with integral weights 0.3 and 0.05.
# Tests repeat the design.
PLACED_GAINS = (1.098053097345133, 0.8497106634030005, 0.2389282086946114, 0.10751769391257515, 0.06654667040403645)
INTEGRAL_GAINS = (1.065117707211288, 0.7494112674097084, 0.2908023505812724, 0.10930731206491429, 0.05538288175826896)
OF_X_INTEGRAL, OF_PSI_INTEGRAL = 0.3872983346207414, 0.15811388300841878


def weight(default: float, unit: str, doc: str) -> Any:
    """Declare a weight of the predictive law."""
    return bounded(default, unit, (0, 1e6), f"weight of {doc}")


def mirrored(row: Numbers) -> dict[str, Any]:
    """Return ten gains from the right tilt's five; ψ and ψ̇ change sign for the left."""
    signs = (1.0, 1.0, -1.0, -1.0, 1.0)
    left = (sign * k for sign, k in zip(signs, row, strict=True))
    return dict(zip(GAINS, (*row, *left), strict=True))


PLACED_SETTINGS = Settings(**mirrored(PLACED_GAINS))


@frozen
class IntegralSettings(Settings):
    """Parameters of the LQR with integrals of measured x and ψ as states six and seven."""

    fed_back = 7

    k_1_6: float = gain(OF_X_INTEGRAL, "right", "the integral of x", "")
    k_1_7: float = gain(OF_PSI_INTEGRAL, "right", "the integral of psi", "")
    k_2_6: float = gain(OF_X_INTEGRAL, "left", "the integral of x", "")
    k_2_7: float = gain(-OF_PSI_INTEGRAL, "left", "the integral of psi", "")


INTEGRAL_SETTINGS = IntegralSettings(**mirrored(INTEGRAL_GAINS))


@frozen
class PredictiveSettings(Settings):
    """Parameters of predictive laws: weights, limits, horizon, and the craft besides the design model.

    The thrust line passes through `thrust_nominal` at `duty_nominal`. The gains `k_i_j` are unused.
    """

    weight_x: float = weight(1.0, "1/m2", "x")
    weight_vx: float = weight(0.5, "s2/m2", "vx")
    weight_psi: float = weight(0.1, "1/rad2", "psi")
    weight_psi_dot: float = weight(0.01, "s2/rad2", "psi_dot")
    weight_y: float = weight(1.0, "1/m2", "y")
    weight_vy: float = weight(0.5, "s2/m2", "vy")
    weight_tilt: float = weight(1.0, "1/rad2", "each tilt")
    weight_duty: float = weight(1.0, "1/%2", "the deviation of each duty from its nominal value")
    duty_min: float = bounded(6.0, "%", (0, 100), "smallest duty; eq 4.20 was fitted on 6-7 %")
    duty_max: float = bounded(7.0, "%", (0, 100), "largest duty; eq 4.20 was fitted on 6-7 %")
    speed_max: float = bounded(0.0, "m/s", (0, 100), "largest speed forward or backward, 0: no limit; a soft limit")
    prediction_step: float = bounded(0.02, "s", (0.01, 1), "step of the prediction")
    horizon: float = bounded(2.0, "s", (0.1, 20), "horizon of the prediction; the LQR follows after it")
    iterations_max: float = bounded(
        200.0, "1", (1, 1e5), "largest number of iterations per sample; beyond it, the command is clipped to the limits"
    )
    ixx: float = of_craft("ixx")
    propeller_radius: float = of_craft("propeller_radius")
    height: float = of_craft("height")
    thrust_slope: float = of_craft("thrust_slope")
    ground_effect_exponent: float = of_craft("ground_effect_exponent")
    gravity: float = of_craft("gravity")
    table_roll_stiffness: float = of_craft("table_roll_stiffness")
    table_roll_damping: float = of_craft("table_roll_damping")

    def invalid_values(self) -> list[str]:
        """Return a sentence on each invalid value, which names it; with valid ones, on an impossible craft."""
        faults, nominal = super().invalid_values(), self.duty_nominal
        for name, wrong in (("duty_min", self.duty_min >= nominal), ("duty_max", self.duty_max <= nominal)):
            if wrong:
                limits = f"duty_min {self.duty_min:g} % and duty_max {self.duty_max:g} %"
                faults.append(f"{name} excludes hovering at duty_nominal {nominal:.6g} %; widen the limits {limits}")
        positive = ("weight_tilt", "weight_duty", "weight_x", "weight_y", "weight_psi", "tilt_max")
        faults += [f"{n} is {getattr(self, n):g}; it must be above 0" for n in positive if not getattr(self, n) > 0]
        if not self.prediction_step <= self.horizon <= 1000 * self.prediction_step:
            text = f"must have 1 to 1000 steps of prediction_step = {self.prediction_step:g} s"
            faults.append(f"horizon is {self.horizon:g} s; it {text}")
        if faults:
            return faults
        try:
            craft_of(self)
        except ValueError as error:
            line = f"{self.thrust_nominal:g} N at {self.duty_nominal:g} % and {self.thrust_slope:g} gf/%"
            return [f"thrust_nominal {line} are not possible for the craft: {error}"]
        return []


# -- extended filter and A(t), B(t) -------------------------------------------------------------

AXES = {"own": ("x", "y"), "world": ("x_world", "y_world")}
PLANT_STATES = tuple(q.name for q in Hovercraft.base_states)


@frozen
class ExtendedSettings(Noise):
    """Assumed noise of the extended filter, and the axes of its fixes.

    Process noise is per sample; noise of the five design states is from eq 5.47, the rest is chosen here. Motion along
    the craft's axes also moves the world position, which has no noise of its own.
    """

    process_variance_y: float = variance(1e-4, "m2", "process noise of y per step, as of x")
    process_variance_vy: float = variance(1e-4, "m2/s2", "process noise of vy per step, as of vx")
    process_variance_phi: float = variance(1e-8, "rad2", "process noise of phi per step")
    process_variance_phi_dot: float = variance(1e-6, "rad2/s2", "process noise of phi_dot per step")
    process_variance_thrust_right: float = variance(1e-6, "N2", "process noise of the right thrust per step")
    process_variance_thrust_left: float = variance(1e-6, "N2", "process noise of the left thrust per step")
    process_variance_tilt_right: float = variance(4e-6, "rad2", "process noise of the right tilt per step, a's 1e-4")
    process_variance_tilt_left: float = variance(4e-6, "rad2", "process noise of the left tilt per step, a's 1e-4")
    measurement_variance_y: float = variance(1e-4, "m2", "noise of a fix of y, §7.1; 1e6 where y is not measured")

    choices = {"axes": tuple(AXES)}  # noqa: RUF012 - a ClassVar of the base
    axes: str = "own"


# The equations are assumed accurate to 1 % of a propeller's thrust, 25 mN at its arm, independently at each sample of
# 0.02 s: (0.025 N/m·Δt)², (0.025 N·L/I·Δt)². Positions and angles follow exactly from their rates.
PUSH_VARIANCE, TURN_VARIANCE, ROLL_VARIANCE = 5e-7, 7e-5, 8.4e-5


def equation_noise(default: float, unit: str, of: str) -> Any:
    """Declare the variance of the equations' error at each sample."""
    return variance(default, unit, f"process noise of {of} per step, as 1 % of a propeller's thrust causes")


@frozen
class TimeVariantSettings(PredictiveSettings, ExtendedSettings):
    """Parameters of the predictive law along its plan. Unused: `process_variance_a`."""

    choices = {"estimator": ("extended",), "axes": tuple(AXES)}  # noqa: RUF012 - a ClassVar of the base

    process_variance_x: float = equation_noise(0.0, "m2", "x")
    process_variance_y: float = equation_noise(0.0, "m2", "y")
    process_variance_psi: float = equation_noise(0.0, "rad2", "psi")
    process_variance_vx: float = equation_noise(PUSH_VARIANCE, "m2/s2", "vx")
    process_variance_vy: float = equation_noise(PUSH_VARIANCE, "m2/s2", "vy")
    process_variance_psi_dot: float = equation_noise(TURN_VARIANCE, "rad2/s2", "psi_dot")
    process_variance_phi: float = equation_noise(0.0, "rad2", "phi")
    process_variance_phi_dot: float = equation_noise(ROLL_VARIANCE, "rad2/s2", "phi_dot")

    estimator: str = "extended"


OF_CRAFT = tuple(p.name for p in parameters_of(PredictiveSettings) if p.name in CRAFT_PARAMETERS)


def craft_of(p: Any) -> Hovercraft:
    """Return the craft with these parameters, whose thrust line (eq 4.20) satisfies Γ·T_OGE(δ_N) = T_N.

    Raises:
        ValueError: The parameters are invalid for a craft.
    """
    values = {name: getattr(p, name) for name in OF_CRAFT}
    gain = ground_effect(SCALAR, p.height, p.propeller_radius, p.ground_effect_exponent)
    offset = float(1000.0 * p.thrust_nominal / (p.gravity * gain) - p.thrust_slope * p.duty_nominal)
    return Hovercraft(**values, thrust_offset=offset).with_values({"yaw_damping.coefficient": p.yaw_damping})
