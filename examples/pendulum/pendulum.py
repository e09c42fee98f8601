"""A pendulum that swings freely as a model of one's own: gravity, and viscous friction of its bearing.

The single pendulum of Kaheman, Fasel, Bramburger, Strom, Kutz and Brunton (2022), with the base model that its authors
fit to it. What they call friction is one viscous coefficient.
"""

from dataclasses import dataclass

from cosim.model import Bias, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

REVERSAL_SPEED = 0.02  # [rad/s] below which dry friction is smoothed; the pendulum moves at up to 12 rad/s
GRAVITY = 9.81  # [m/s2]
SWINGS = "one swing from a large angle to rest"
TOLD_APART_BY = {
    frozenset({"coulomb_friction", "stribeck_friction", "load_friction", "viscous"}): SWINGS,
    frozenset({"air_drag", "viscous"}): "swings from larger angles",
}


class PendulumEffect(Effect):
    """An acceleration that the base model lacks: a moment over the moment of inertia."""

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """Acceleration [rad/s2]; `stiffness` [1/s2] is that of gravity at rest, m·g·l/J."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(PendulumEffect):
    """Dry friction of the bearing: −F·tanh(ω/0.02)."""

    name = "coulomb_friction"
    equation = "acceleration −F·tanh(ω/0.02)"

    level: float = parameter(0.0, unit="rad/s2", bounds=(0, 5), neutral=0.0, typical=0.1, doc="dry friction F over J")

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """−F·tanh(ω/0.02)."""
        return -self.level * m.tanh(rate / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class LoadFriction(PendulumEffect):
    """Dry friction that grows with the force the bearing carries: −F·(cos α + ω²/Ω²)·tanh(ω/0.02)."""

    name = "load_friction"
    equation = "acceleration −F·(cos α + ω²/Ω²)·tanh(ω/0.02), Ω² = m·g·l/J"

    level: float = parameter(0.0, unit="rad/s2", bounds=(0, 5), neutral=0.0, typical=0.1, doc="F over J, at rest")

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """−F·(cos α + ω²/Ω²)·tanh(ω/0.02)."""
        load = m.cos(angle) + rate * rate / stiffness
        return -self.level * load * m.tanh(rate / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(PendulumEffect):
    """What dry friction is more at low speed, beside its level: −B·e^(−(ω/ω_s)²)·tanh(ω/0.02), B ≥ 0."""

    name = "stribeck_friction"
    equation = "acceleration −B·e^(−(ω/ω_s)²)·tanh(ω/0.02)"

    breakaway: float = parameter(0.0, unit="rad/s2", bounds=(0, 5), neutral=0.0, typical=0.3, doc="breakaway B over J")
    speed: float = parameter(0.3, unit="rad/s", bounds=(0.1, 0.6), doc="Stribeck speed ω_s, well above the smoothing")

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """−B·e^(−(ω/ω_s)²)·tanh(ω/0.02)."""
        return -self.breakaway * m.exp(-((rate / self.speed) ** 2)) * m.tanh(rate / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class AirDrag(PendulumEffect):
    """Drag of the air: −k·|ω|·ω."""

    name = "air_drag"
    equation = "acceleration −k·|ω|·ω"

    coefficient: float = parameter(
        0.0, unit="1/rad", bounds=(0, 1), neutral=0.0, typical=0.02, doc="drag coefficient k over J"
    )

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """−k·|ω|·ω."""
        return -self.coefficient * m.where(rate >= 0.0, rate, -rate) * rate


@dataclass(frozen=True, kw_only=True)
class CableSpring(PendulumEffect):
    """A cable or a seal that pulls it back to rest: −k·α."""

    name = "cable_spring"
    equation = "acceleration −k·α"

    stiffness: float = parameter(0.0, unit="1/s2", bounds=(0, 20), neutral=0.0, typical=3.0, doc="stiffness k over J")

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """−k·α."""
        return -self.stiffness * angle


@dataclass(frozen=True, kw_only=True)
class Tilt(PendulumEffect):
    """A constant moment: a frame that does not stand upright, a cable."""

    name = "moment_offset"
    equation = "acceleration f"

    value: float = parameter(0.0, unit="rad/s2", bounds=(-5, 5), neutral=0.0, typical=0.1, doc="moment f over J")

    def acceleration(self, m: Namespace, stiffness: Number, angle: Number, rate: Number) -> Number:
        """f."""
        return self.value


@dataclass(frozen=True, kw_only=True)
class EncoderZero(Bias):
    """The encoder does not read zero where the pendulum hangs: α + b."""

    name = "encoder_zero"
    output = "angle"

    value: float = parameter(0.0, unit="rad", bounds=(-0.2, 0.2), neutral=0.0, typical=2e-3, doc="offset b")


@dataclass(frozen=True, kw_only=True)
class Pendulum(Model):
    """One rigid arm, gravity, viscous friction."""

    title = "Pendulum"
    base_states = (Quantity("angle", "rad", "angle from where it hangs"), Quantity("rate", "rad/s", "its rate"))
    inputs = (Quantity("cart", "m/s2", "acceleration of the cart that carries the pivot"),)
    outputs = (Quantity("angle", "rad", "angle from where it hangs"),)
    catalogue = (CoulombFriction, LoadFriction, StribeckFriction, AirDrag, CableSpring, Tilt)
    sensors = (EncoderZero,)
    sensor_variance = {"angle": 1e-8}  # noqa: RUF012 - a ClassVar of the base; 0.1 mrad, see README.md
    forced = ("rate",)
    calibrated = ("length", "viscous")
    told_apart_by = TOLD_APART_BY
    substep, rate = 0.0025, 0.01
    horizon = float("inf")  # judged by the free run

    length: float = parameter(
        0.153, unit="m", bounds=(0.05, 1), tolerance=0.02, doc="length of the mathematical pendulum that swings as fast"
    )
    viscous: float = parameter(0.067, unit="1/s", bounds=(0, 5), tolerance=0.5, doc="viscous friction over J")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        α̇ = ω
        ω̇ = −(g·sin α + a·cos α)/l − d·ω + accelerations of the effects
        """
        length, d = self.length, self.viscous
        terms = overrides(self.awake, "acceleration", PendulumEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            angle, rate = state
            total = -(GRAVITY * m.sin(angle) + command[0] * m.cos(angle)) / length - d * rate
            for term in terms:
                total = total + term.acceleration(m, GRAVITY / length, angle, rate)
            return rate, total

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
