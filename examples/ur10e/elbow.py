"""The elbow of a UR10e robot arm, moved alone: one joint, driven by its motor current.

All parameters are relative to the motor's torque constant, so that torques are in ampere.
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


CATALOGUE = (
    DryFriction.named("coulomb", place="joint", softness=CREEP, level=size("A", (0, 10), 0.5, "dry friction")),
    QuadraticDrag.named("drag", place="joint", coefficient=size("A.s2/rad2", (-10, 10), 0.3, "coefficient")),
    LocalEffect.named(  # the cables turn the joint back
        "cable_spring",
        place="joint",
        equation="torque −k·q",
        stiffness=size("A/rad", (-5, 5), 0.1, "stiffness k"),
        change=lambda e, m, torque, rate, angle: torque - e.stiffness * angle,
    ),
    LocalEffect.named(  # as of a current sensor that does not read 0
        "current_bias",
        place="joint",
        equation="torque B",
        offset=size("A", (-5, 5), 0.1, "constant torque B"),
        change=lambda e, m, torque, rate, angle: torque + e.offset,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Elbow(Model):
    """One joint of a robot arm."""

    title = "Elbow of a robot arm"
    base_states = (Quantity("angle", "rad", "angle of the joint"), Quantity("rate", "rad/s", "its rate"))
    inputs = (Quantity("current", "A", "motor current"),)
    outputs = base_states
    catalogue, places = CATALOGUE, ("joint",)
    sensors = (Bias.named("rate_bias", output="rate", value=size("rad/s", (-0.2, 0.2), 0.005, "offset b")),)
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
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            angle, rate = state
            torque = command[0] - self.viscous * rate
            torque = torque - self.weight_cosine * m.cos(angle) - self.weight_sine * m.sin(angle)
            return rate, at("joint", torque, rate, angle) / self.inertia

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state)

        return Equations(derivative, output)
