"""Planar arm of two rigid links in a vertical plane, driven by torques at both joints.

Measured are both joint angles by encoders, and both torques, which are the inputs. The inertial parameters are lumped:
a = J₁ + m₂·l₁², b = J₂, c = m₂·l₁·r₂ with J₁, J₂ about the joints and r₂ from the second joint to its link's centre.
"""

from dataclasses import dataclass

from cosim.model import Bias, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

CREEP = 0.02  # [rad/s] below which dry friction is smoothed
SENSOR_VARIANCE = {"angle_1": 8.3e-10, "angle_2": 8.3e-10}
START_VARIANCE = {"angle_1": 0.01, "angle_2": 0.01, "rate_1": 0.04, "rate_2": 0.04}
TOLD_APART_BY = {
    frozenset({"coulomb_1", "drag_1"}): "slow and fast motions of joint 1 with reversals",
    frozenset({"coulomb_2", "drag_2"}): "slow and fast motions of joint 2 with reversals",
}


class ArmEffect(Effect):
    """Torques at the joints that the base model lacks."""

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        """Return additional torques at both joints [N m]."""
        return 0.0, 0.0


def _size(m: Namespace, value: Number) -> Number:
    return m.where(value >= 0.0, value, -value)


@dataclass(frozen=True, kw_only=True)
class Coulomb1(ArmEffect):
    """Dry friction of joint 1: −F·tanh(ω/0.02)."""

    name = "coulomb_1"
    equation = "torque −F·tanh(ω₁/0.02) at joint 1"
    level: float = parameter(0.0, unit="N.m", bounds=(0, 5), neutral=0.0, typical=0.2, doc="dry friction F")

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return -self.level * m.tanh(rates[0] / CREEP), 0.0


@dataclass(frozen=True, kw_only=True)
class Coulomb2(ArmEffect):
    """Dry friction of joint 2: −F·tanh(ω/0.02)."""

    name = "coulomb_2"
    equation = "torque −F·tanh(ω₂/0.02) at joint 2"
    level: float = parameter(0.0, unit="N.m", bounds=(0, 3), neutral=0.0, typical=0.1, doc="dry friction F")

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return 0.0, -self.level * m.tanh(rates[1] / CREEP)


@dataclass(frozen=True, kw_only=True)
class Drag1(ArmEffect):
    """Quadratic friction of joint 1: −k·|ω|·ω."""

    name = "drag_1"
    equation = "torque −k·|ω₁|·ω₁ at joint 1"
    coefficient: float = parameter(
        0.0, unit="N.m.s2/rad2", bounds=(0, 2), neutral=0.0, typical=0.03, doc="coefficient k"
    )

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return -self.coefficient * _size(m, rates[0]) * rates[0], 0.0


@dataclass(frozen=True, kw_only=True)
class Drag2(ArmEffect):
    """Quadratic friction of joint 2: −k·|ω|·ω."""

    name = "drag_2"
    equation = "torque −k·|ω₂|·ω₂ at joint 2"
    coefficient: float = parameter(
        0.0, unit="N.m.s2/rad2", bounds=(0, 1), neutral=0.0, typical=0.01, doc="coefficient k"
    )

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return 0.0, -self.coefficient * _size(m, rates[1]) * rates[1]


@dataclass(frozen=True, kw_only=True)
class TorqueBias1(ArmEffect):
    """Constant torque at joint 1."""

    name = "torque_bias_1"
    equation = "torque B at joint 1"
    torque_1: float = parameter(0.0, unit="N.m", bounds=(-2, 2), neutral=0.0, typical=0.1, doc="constant torque B")

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return self.torque_1, 0.0


@dataclass(frozen=True, kw_only=True)
class TorqueBias2(ArmEffect):
    """Constant torque at joint 2."""

    name = "torque_bias_2"
    equation = "torque B at joint 2"
    torque_2: float = parameter(0.0, unit="N.m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="constant torque B")

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return 0.0, self.torque_2


@dataclass(frozen=True, kw_only=True)
class CableSpring(ArmEffect):
    """Spring torque of the cable at joint 2: −k·q₂."""

    name = "cable_spring"
    equation = "torque −k·q₂ at joint 2"
    stiffness: float = parameter(0.0, unit="N.m/rad", bounds=(0, 2), neutral=0.0, typical=0.03, doc="stiffness k")

    def torque(self, m: Namespace, angles: Values, rates: Values, torques: Values) -> Values:
        return 0.0, -self.stiffness * angles[1]


@dataclass(frozen=True, kw_only=True)
class EncoderOffset2(Bias):
    """Offset of the encoder of joint 2: reading q₂ + b."""

    name = "encoder_offset_2"
    output = "angle_2"
    value: float = parameter(0.0, unit="rad", bounds=(-0.3, 0.3), neutral=0.0, typical=0.01, doc="offset b")


@dataclass(frozen=True, kw_only=True)
class Arm(Model):
    """Planar arm of two links."""

    title = "Arm of two links"
    base_states = (
        Quantity("angle_1", "rad", "angle of link 1 from horizontal"),
        Quantity("angle_2", "rad", "angle of link 2 from link 1"),
        Quantity("rate_1", "rad/s", "rate of joint 1"),
        Quantity("rate_2", "rad/s", "rate of joint 2"),
    )
    inputs = (Quantity("torque_1", "N.m", "torque at joint 1"), Quantity("torque_2", "N.m", "torque at joint 2"))
    outputs = base_states[:2]
    catalogue = (Coulomb1, Coulomb2, Drag1, Drag2, TorqueBias1, TorqueBias2, CableSpring)
    sensors = (EncoderOffset2,)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("rate_1", "rate_2")
    calibrated = (
        "inertia_1", "inertia_2", "coupling", "gravity_1", "gravity_2", "rotor_2", "viscous_1", "viscous_2",
    )  # fmt: skip
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 0.005, 0.0025, 0.3

    inertia_1: float = parameter(0.12, unit="kg.m2", bounds=(0.01, 2), tolerance=0.15, doc="inertia a")
    inertia_2: float = parameter(0.02, unit="kg.m2", bounds=(0.001, 1), tolerance=0.15, doc="inertia b")
    coupling: float = parameter(0.025, unit="kg.m2", bounds=(0.001, 1), tolerance=0.15, doc="coupling c")
    gravity_1: float = parameter(3.5, unit="N.m", bounds=(0, 50), tolerance=0.1, doc="weight moment of both about 1")
    gravity_2: float = parameter(0.8, unit="N.m", bounds=(0, 20), tolerance=0.1, doc="weight moment of link 2 about 2")
    rotor_2: float = parameter(0.005, unit="kg.m2", bounds=(0, 0.2), tolerance=0.2, doc="rotor of motor 2, geared")
    viscous_1: float = parameter(
        0.15, unit="N.m.s/rad", bounds=(0, 5), tolerance=0.3, doc="viscous friction of joint 1"
    )
    viscous_2: float = parameter(
        0.05, unit="N.m.s/rad", bounds=(0, 5), tolerance=0.3, doc="viscous friction of joint 2"
    )

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        (a + b + 2c·cos q₂)·q̈₁ + (b + c·cos q₂)·q̈₂ = τ₁ + c·sin q₂·(2q̇₁ + q̇₂)·q̇₂ − g₁·cos q₁ − g₂·cos(q₁ + q₂)
        (b + c·cos q₂)·q̈₁ + (b + r)·q̈₂ = τ₂ − c·sin q₂·q̇₁² − g₂·cos(q₁ + q₂)
        """
        a, b, c, rotor = self.inertia_1, self.inertia_2, self.coupling, self.rotor_2
        g1, g2, d1, d2 = self.gravity_1, self.gravity_2, self.viscous_1, self.viscous_2
        terms = overrides(self.awake, "torque", ArmEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            q1, q2, w1, w2 = state
            sin, cos = m.sin(q2), m.cos(q2)
            weight_2 = g2 * m.cos(q1 + q2)
            t1 = command[0] + c * sin * (2.0 * w1 + w2) * w2 - g1 * m.cos(q1) - weight_2 - d1 * w1
            t2 = command[1] - c * sin * w1 * w1 - weight_2 - d2 * w2
            for term in terms:
                added = term.torque(m, (q1, q2), (w1, w2), command)
                t1, t2 = t1 + added[0], t2 + added[1]
            m11, m12, m22 = a + b + 2.0 * c * cos, b + c * cos, b + rotor
            determinant = m11 * m22 - m12 * m12
            return w1, w2, (t1 * m22 - t2 * m12) / determinant, (t2 * m11 - t1 * m12) / determinant

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state[:2])

        return Equations(derivative, output)
