"""A propeller on a test stand as a model of one's own: thrust over speed, without states and without time.

The APC Slow Flyer 10x4.7 of the UIUC propeller data base, standing still. T = C_T·ρ·n²·D⁴ with a constant C_T.
"""

import math
from dataclasses import dataclass

from cosim.model import Bias, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

DIAMETER = 0.254  # [m] 10 in
DENSITY = 1.225  # [kg/m3] the standard one, with which C_T is made a thrust; see README.md
SOUND = 340.3  # [m/s]
REFERENCE = 5000.0 * math.pi / 30.0  # [rad/s] 5000 rpm
TOLD_APART_BY = {
    frozenset({"reynolds_number", "power_law", "tip_mach"}): "more speeds, low and high ones",
    frozenset(
        {"thrust_tare", "speed_offset", "reynolds_number", "power_law"}
    ): "speeds near zero, where an offset is all there is",
}


class PropellerEffect(Effect):
    """What the base model lacks: C_T that changes, or a speed that is off."""

    def turning(self, speed: Number) -> Number:
        """Speed [rad/s] at which it turns when the counter shows `speed`."""
        return speed

    def factor(self, m: Namespace, speed: Number) -> Number:
        """Return the factor of C_T at a speed [rad/s]."""
        return 1.0


@dataclass(frozen=True, kw_only=True)
class ReynoldsNumber(PropellerEffect):
    """Blades lift better at a higher Reynolds number: C_T·(1 + a·(n/n₀ − 1)), n₀ = 5000 rpm."""

    name = "reynolds_number"
    equation = "C_T·(1 + a·(n/n₀ − 1))"

    slope: float = parameter(0.0, unit="1", bounds=(-1, 1), neutral=0.0, typical=0.1, doc="slope a")

    def factor(self, m: Namespace, speed: Number) -> Number:
        """1 + a·(n/n₀ − 1)."""
        return 1.0 + self.slope * (speed / REFERENCE - 1.0)


@dataclass(frozen=True, kw_only=True)
class TipMach(PropellerEffect):
    """Air that gives way at the tips, by the rule of Prandtl and Glauert: C_T·(1 + k·(1/√(1 − Ma²) − 1))."""

    name = "tip_mach"
    equation = "C_T·(1 + k·(1/√(1 − Ma²) − 1))"

    share: float = parameter(0.0, unit="1", bounds=(0, 2), neutral=0.0, typical=1.0, doc="share k; 1 is the rule")

    def factor(self, m: Namespace, speed: Number) -> Number:
        """1 + k·(1/√(1 − Ma²) − 1)."""
        mach = 0.5 * DIAMETER * speed / SOUND
        return 1.0 + self.share * (1.0 / m.sqrt(1.0 - mach * mach) - 1.0)


@dataclass(frozen=True, kw_only=True)
class BladeTwist(PropellerEffect):
    """Slow Flyer blades are thin: the load untwists them, and they bend: C_T·(1 − b·(n/n₀)²)."""

    name = "blade_twist"
    equation = "C_T·(1 − b·(n/n₀)²)"

    share: float = parameter(0.0, unit="1", bounds=(0, 0.5), neutral=0.0, typical=0.05, doc="share b lost at 5000 rpm")

    def factor(self, m: Namespace, speed: Number) -> Number:
        """1 − b·(n/n₀)²."""
        ratio = speed / REFERENCE
        return 1.0 - self.share * ratio * ratio


@dataclass(frozen=True, kw_only=True)
class PowerLaw(PropellerEffect):
    """The same over all speeds without a reference: thrust goes with n^(2 + p), C_T·(n/n₀)^p."""

    name = "power_law"
    equation = "C_T·(n/n₀)^p"

    exponent: float = parameter(0.0, unit="1", bounds=(-1, 1), neutral=0.0, typical=0.1, doc="exponent p")

    def factor(self, m: Namespace, speed: Number) -> Number:
        """(n/n₀)^p."""
        return (speed / REFERENCE) ** self.exponent


@dataclass(frozen=True, kw_only=True)
class SpeedOffset(PropellerEffect):
    """The counter is off by a constant: the propeller turns at n + o."""

    name = "speed_offset"
    equation = "n + o in place of n"

    value: float = parameter(0.0, unit="rad/s", bounds=(-100, 100), neutral=0.0, typical=10.0, doc="offset o")

    def turning(self, speed: Number) -> Number:
        """n + o."""
        return speed + self.value


@dataclass(frozen=True, kw_only=True)
class ThrustTare(Bias):
    """The balance was not zeroed: it reads T + b."""

    name = "thrust_tare"
    output = "thrust"

    value: float = parameter(0.0, unit="N", bounds=(-1, 1), neutral=0.0, typical=0.1, doc="tare b")


@dataclass(frozen=True, kw_only=True)
class Propeller(Model):
    """A constant thrust coefficient."""

    title = "Propeller, standing"
    base_states = ()
    inputs = (Quantity("speed", "rad/s", "speed of the propeller", REFERENCE, (0.0, 1500.0)),)
    outputs = (Quantity("thrust", "N", "thrust of the propeller", 5.0),)
    catalogue = (ReynoldsNumber, PowerLaw, TipMach, BladeTwist, SpeedOffset)
    sensors = (ThrustTare,)
    sensor_variance = {"thrust": 1e-4}  # noqa: RUF012 - a ClassVar of the base; 10 mN, a gram
    forced = ()
    calibrated = ("thrust_coefficient",)
    told_apart_by = TOLD_APART_BY

    thrust_coefficient: float = parameter(
        0.12, unit="1", bounds=(0.01, 0.5), tolerance=0.1, doc="C_T, of the revolutions a second"
    )

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        T = C_T·ρ·(n/2π)²·D⁴, n in rad/s
        """
        unit = DENSITY * DIAMETER**4 / (2.0 * math.pi) ** 2
        speeds = overrides(self.awake, "turning", PropellerEffect)
        factors = overrides(self.awake, "factor", PropellerEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            return ()

        def output(t: Number, state: Values, command: Values) -> Values:
            speed = command[0]
            for term in speeds:
                speed = term.turning(speed)
            coefficient = self.thrust_coefficient
            for term in factors:
                coefficient = coefficient * term.factor(m, speed)
            return (coefficient * unit * speed * speed,)

        return Equations(derivative, output)
