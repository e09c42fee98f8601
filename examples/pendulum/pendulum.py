"""A pendulum that swings freely as a model of one's own: gravity, and viscous friction of its bearing.

The single pendulum of Kaheman, Fasel, Bramburger, Strom, Kutz and Brunton (2022), with the base model that its authors
fit to it. What they call friction is one viscous coefficient.
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
    Offset,
    QuadraticDrag,
    Quantity,
    Values,
    parameter,
    size,
)

REVERSAL_SPEED = 0.02  # [rad/s] below which dry friction is smoothed; the pendulum moves at up to 12 rad/s
GRAVITY = 9.81  # [m/s2]
SWINGS = "one swing from a large angle to rest"
TOLD_APART_BY = {
    frozenset({"coulomb_friction", "stribeck_friction", "load_friction", "viscous"}): SWINGS,
    frozenset({"air_drag", "viscous"}): "swings from larger angles",
}


# accelerations: moments over the moment of inertia J
CATALOGUE = (
    DryFriction.named(
        "coulomb_friction",
        place="bearing",
        softness=REVERSAL_SPEED,
        level=size("rad/s2", (0, 5), 0.1, "dry friction over J"),
    ),
    LocalEffect.named(  # dry friction that grows with the force the bearing carries
        "load_friction",
        place="bearing",
        equation="acceleration −F·(cos α + ω²/Ω²)·tanh(ω/0.02), Ω² = m·g·l/J",
        level=size("rad/s2", (0, 5), 0.1, "F over J, at rest"),
        change=lambda e, m, total, w, angle, stiffness: (
            total - e.level * (m.cos(angle) + w * w / stiffness) * m.tanh(w / REVERSAL_SPEED)
        ),
    ),
    LocalEffect.named(  # what dry friction is more at low speed, beside its level
        "stribeck_friction",
        place="bearing",
        equation="acceleration −B·e^(−(ω/ω_s)²)·tanh(ω/0.02)",
        breakaway=size("rad/s2", (0, 5), 0.3, "breakaway B over J"),
        speed=parameter(0.3, unit="rad/s", bounds=(0.1, 0.6), doc="Stribeck speed ω_s, well above the smoothing"),
        change=lambda e, m, total, w, *_: (
            total - e.breakaway * m.exp(-((w / e.speed) ** 2)) * m.tanh(w / REVERSAL_SPEED)
        ),
    ),
    QuadraticDrag.named(
        "air_drag", place="bearing", coefficient=size("1/rad", (0, 1), 0.02, "drag coefficient over J")
    ),
    LocalEffect.named(  # a cable or a seal that pulls it back to rest
        "cable_spring",
        place="bearing",
        equation="acceleration −k·α",
        stiffness=size("1/s2", (0, 20), 3.0, "stiffness k over J"),
        change=lambda e, m, total, w, angle, _: total - e.stiffness * angle,
    ),
    # a frame that does not stand upright, a cable
    Offset.named("moment_offset", place="bearing", value=size("rad/s2", (-5, 5), 0.1, "moment over J")),
)


@dataclass(frozen=True, kw_only=True)
class Pendulum(Model):
    """One rigid arm, gravity, viscous friction."""

    title = "Pendulum"
    base_states = (Quantity("angle", "rad", "angle from where it hangs"), Quantity("rate", "rad/s", "its rate"))
    inputs = (Quantity("cart", "m/s2", "acceleration of the cart that carries the pivot"),)
    outputs = (Quantity("angle", "rad", "angle from where it hangs"),)
    catalogue, places = CATALOGUE, ("bearing",)
    sensors = (Bias.named("encoder_zero", output="angle", value=size("rad", (-0.2, 0.2), 2e-3, "offset b")),)
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
        at, length = self.effects_at(m), self.length

        def derivative(t: Number, state: Values, command: Values) -> Values:
            angle, rate = state
            total = -(GRAVITY * m.sin(angle) + command[0] * m.cos(angle)) / length - self.viscous * rate
            return rate, at("bearing", total, rate, angle, GRAVITY / length)

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
