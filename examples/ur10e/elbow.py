"""The elbow of a UR10e robot arm, moved alone: one joint, driven by its motor current.

All parameters are relative to the motor's torque constant, so that torques are in ampere.
"""

from dataclasses import dataclass

from cosim.model import Bias, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

CREEP = 0.02  # [rad/s] below which dry friction is smoothed


class JointEffect(Effect):
    """A torque of the joint that the base model lacks."""

    def torque(self, m: Namespace, angle: Number, rate: Number) -> Number:
        """Torque [A] on the joint."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class Coulomb(JointEffect):
    """Dry friction: −F·tanh(ω/0.02)."""

    name = "coulomb"
    equation = "torque −F·tanh(ω/0.02)"

    level: float = parameter(0.0, unit="A", bounds=(0, 10), neutral=0.0, typical=0.5, doc="dry friction F")

    def torque(self, m: Namespace, angle: Number, rate: Number) -> Number:
        """−F·tanh(ω/0.02)."""
        return -self.level * m.tanh(rate / CREEP)


@dataclass(frozen=True, kw_only=True)
class Drag(JointEffect):
    """Quadratic friction: −k·|ω|·ω."""

    name = "drag"
    equation = "torque −k·|ω|·ω"

    coefficient: float = parameter(
        0.0, unit="A.s2/rad2", bounds=(-10, 10), neutral=0.0, typical=0.3, doc="coefficient k"
    )

    def torque(self, m: Namespace, angle: Number, rate: Number) -> Number:
        """−k·|ω|·ω."""
        return -self.coefficient * m.where(rate >= 0.0, rate, -rate) * rate


@dataclass(frozen=True, kw_only=True)
class Spring(JointEffect):
    """The cables turn the joint back: −k·q."""

    name = "cable_spring"
    equation = "torque −k·q"

    stiffness: float = parameter(0.0, unit="A/rad", bounds=(-5, 5), neutral=0.0, typical=0.1, doc="stiffness k")

    def torque(self, m: Namespace, angle: Number, rate: Number) -> Number:
        """−k·q."""
        return -self.stiffness * angle


@dataclass(frozen=True, kw_only=True)
class CurrentBias(JointEffect):
    """A constant torque, as of a current sensor that does not read 0."""

    name = "current_bias"
    equation = "torque B"

    offset: float = parameter(0.0, unit="A", bounds=(-5, 5), neutral=0.0, typical=0.1, doc="constant torque B")

    def torque(self, m: Namespace, angle: Number, rate: Number) -> Number:
        """B."""
        return self.offset


@dataclass(frozen=True, kw_only=True)
class RateBias(Bias):
    """The rate is read with an offset."""

    name = "rate_bias"
    output = "rate"

    value: float = parameter(0.0, unit="rad/s", bounds=(-0.2, 0.2), neutral=0.0, typical=0.005, doc="offset b")


@dataclass(frozen=True, kw_only=True)
class Elbow(Model):
    """One joint of a robot arm."""

    title = "Elbow of a robot arm"
    base_states = (Quantity("angle", "rad", "angle of the joint"), Quantity("rate", "rad/s", "its rate"))
    inputs = (Quantity("current", "A", "motor current"),)
    outputs = base_states
    catalogue = (Coulomb, Drag, Spring, CurrentBias)
    sensors = (RateBias,)
    sensor_variance = {"angle": 1e-8, "rate": 1e-5}  # noqa: RUF012
    start_variance = {"angle": 0.01, "rate": 0.01}  # noqa: RUF012
    forced = ("rate",)
    calibrated = ("inertia", "viscous", "weight_cosine", "weight_sine")
    rate, substep, horizon = 0.01, 0.005, 0.3

    inertia: float = parameter(1.0, unit="A.s2/rad", bounds=(0.05, 10), tolerance=0.5, doc="inertia")
    viscous: float = parameter(2.0, unit="A.s/rad", bounds=(0, 30), tolerance=0.5, doc="viscous friction")
    weight_cosine: float = parameter(3.0, unit="A", bounds=(-20, 20), tolerance=0.5, doc="weight, with cos q")
    weight_sine: float = parameter(1.0, unit="A", bounds=(-20, 20), tolerance=2.0, doc="weight, with sin q")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace: J·q̈ = i − b·q̇ − c·cos q − s·sin q + torques."""
        terms = overrides(self.awake, "torque", JointEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            angle, rate = state
            torque = command[0] - self.viscous * rate
            torque = torque - self.weight_cosine * m.cos(angle) - self.weight_sine * m.sin(angle)
            for term in terms:
                torque = torque + term.torque(m, angle, rate)
            return rate, torque / self.inertia

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state)

        return Equations(derivative, output)
