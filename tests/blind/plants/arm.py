"""Planar arm of two rigid links in a vertical plane, driven by torques at both joints.

Measured are both joint angles by encoders, and both torques, which are the inputs. The inertial parameters are lumped:
a = J₁ + m₂·l₁², b = J₂, c = m₂·l₁·r₂ with J₁, J₂ about the joints and r₂ from the second joint to its link's centre.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    DryFriction,
    Equations,
    LocalEffect,
    Model,
    Namespace,
    Number,
    QuadraticDrag,
    Quantity,
    Values,
    parameter,
    size,
)

CREEP = 0.02  # [rad/s] below which dry friction is smoothed
SENSOR_VARIANCE = {"angle_1": 8.3e-10, "angle_2": 8.3e-10}
START_VARIANCE = {"angle_1": 0.01, "angle_2": 0.01, "rate_1": 0.04, "rate_2": 0.04}


CATALOGUE = (
    DryFriction.named("coulomb_1", place="joint_1", softness=CREEP, level=size("N.m", (0, 5), 0.2, "dry friction")),
    DryFriction.named("coulomb_2", place="joint_2", softness=CREEP, level=size("N.m", (0, 3), 0.1, "dry friction")),
    QuadraticDrag.named("drag_1", place="joint_1", coefficient=size("N.m.s2/rad2", (0, 2), 0.03, "coefficient")),
    QuadraticDrag.named("drag_2", place="joint_2", coefficient=size("N.m.s2/rad2", (0, 1), 0.01, "coefficient")),
    LocalEffect.named(
        "torque_bias_1", place="joint_1", equation="torque B at joint 1",
        torque_1=size("N.m", (-2, 2), 0.1, "constant torque B"), change=lambda e, m, torque, *_: torque + e.torque_1,
    ),
    LocalEffect.named(
        "torque_bias_2", place="joint_2", equation="torque B at joint 2",
        torque_2=size("N.m", (-1, 1), 0.05, "constant torque B"), change=lambda e, m, torque, *_: torque + e.torque_2,
    ),
    LocalEffect.named(
        "cable_spring", place="joint_2", equation="torque −k·q₂ at joint 2",
        stiffness=size("N.m/rad", (0, 2), 0.03, "stiffness k"),
        change=lambda e, m, torque, rate, angle: torque - e.stiffness * angle,
    ),
)  # fmt: skip


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
    catalogue, places = CATALOGUE, ("joint_1", "joint_2")
    sensors = (Bias.named("encoder_offset_2", output="angle_2", value=size("rad", (-0.3, 0.3), 0.01, "offset b")),)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("rate_1", "rate_2")
    calibrated = (
        "inertia_1", "inertia_2", "coupling", "gravity_1", "gravity_2", "rotor_2", "viscous_1", "viscous_2",
    )  # fmt: skip
    rate, substep, horizon = 0.005, 0.0025, 0.3

    inertia_1: float = parameter(0.12, unit="kg.m2", bounds=(0.01, 2), tolerance=0.15, doc="inertia a")
    inertia_2: float = parameter(0.02, unit="kg.m2", bounds=(0.001, 1), tolerance=0.15, doc="inertia b")
    coupling: float = parameter(0.025, unit="kg.m2", bounds=(0.001, 1), tolerance=0.15, doc="coupling c")
    gravity_1: float = parameter(3.5, unit="N.m", bounds=(0, 50), tolerance=0.1, doc="weight moment of both about 1")
    gravity_2: float = parameter(0.8, unit="N.m", bounds=(0, 20), tolerance=0.1, doc="weight moment of link 2 about 2")
    rotor_2: float = parameter(0.005, unit="kg.m2", bounds=(0, 0.2), tolerance=0.2, doc="rotor of motor 2, geared")
    viscous_1: float = parameter(0.15, unit="N.m.s/rad", bounds=(0, 5), tolerance=0.3, doc="viscous friction, joint 1")
    viscous_2: float = parameter(0.05, unit="N.m.s/rad", bounds=(0, 5), tolerance=0.3, doc="viscous friction, joint 2")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        (a + b + 2c·cos q₂)·q̈₁ + (b + c·cos q₂)·q̈₂ = τ₁ + c·sin q₂·(2q̇₁ + q̇₂)·q̇₂ − g₁·cos q₁ − g₂·cos(q₁ + q₂)
        (b + c·cos q₂)·q̈₁ + (b + r)·q̈₂ = τ₂ − c·sin q₂·q̇₁² − g₂·cos(q₁ + q₂)
        """
        a, b, c, rotor = self.inertia_1, self.inertia_2, self.coupling, self.rotor_2
        g1, g2, d1, d2 = self.gravity_1, self.gravity_2, self.viscous_1, self.viscous_2
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            q1, q2, w1, w2 = state
            sin, cos = m.sin(q2), m.cos(q2)
            weight_2 = g2 * m.cos(q1 + q2)
            t1 = command[0] + c * sin * (2.0 * w1 + w2) * w2 - g1 * m.cos(q1) - weight_2 - d1 * w1
            t2 = command[1] - c * sin * w1 * w1 - weight_2 - d2 * w2
            t1, t2 = at("joint_1", t1, w1, q1), at("joint_2", t2, w2, q2)
            m11, m12, m22 = a + b + 2.0 * c * cos, b + c * cos, b + rotor
            determinant = m11 * m22 - m12 * m12
            return w1, w2, (t1 * m22 - t2 * m12) / determinant, (t2 * m11 - t1 * m12) / determinant

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state[:2])

        return Equations(derivative, output)
