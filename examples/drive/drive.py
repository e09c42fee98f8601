"""A positioning drive as a model of one's own: one mass on a rail, pushed by a motor, held back by viscous friction.

The Electro-Mechanical Positioning System of Janot, Gautier and Brunot (2019). This file is all there is to it: states,
inputs, outputs, parameters, effects and one body of equations.
"""

from dataclasses import dataclass

from cosim.model import (
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

REVERSAL_SPEED = 1e-3  # [m/s] below which dry friction is smoothed; the drive moves at up to 0.13 m/s
TOLD_APART_BY = {
    frozenset(
        {"coulomb_friction", "stribeck_friction", "quadratic_drag", "viscous"}
    ): "runs at several speeds, slow ones among them, with reversals",
}


# a slope, a cable that pulls, an offset of the amplifier
ForceOffset = Offset.named("force_offset", place="carriage", value=size("N", (-100, 100), 2.0, "offset f"))
CoulombFriction = DryFriction.named(
    "coulomb_friction", place="carriage", softness=REVERSAL_SPEED, level=size("N", (0, 200), 10.0, "dry friction force")
)
StribeckFriction = LocalEffect.named(  # what dry friction is more at low speed, beside its level
    "stribeck_friction",
    place="carriage",
    equation="force −B·e^(−(v/v_s)²)·tanh(v/0.001)",
    breakaway=size("N", (0, 200), 5.0, "breakaway force B"),
    speed=parameter(0.02, unit="m/s", bounds=(0.01, 0.2), doc="Stribeck speed v_s, well above the smoothing"),
    change=lambda e, m, force, v: force - e.breakaway * m.exp(-((v / e.speed) ** 2)) * m.tanh(v / REVERSAL_SPEED),
)
Drag = QuadraticDrag.named(
    "quadratic_drag", place="carriage", coefficient=size("N.s2/m2", (0, 5000), 200.0, "drag coefficient")
)


@dataclass(frozen=True, kw_only=True)
class Drive(Model):
    """One mass, viscous friction."""

    title = "Positioning drive"
    base_states = (Quantity("position", "m", "position of the carriage"), Quantity("velocity", "m/s", "its velocity"))
    inputs = (Quantity("force", "N", "motor force commanded"),)
    outputs = base_states
    catalogue, places = (ForceOffset, CoulombFriction, StribeckFriction, Drag), ("carriage",)
    sensor_variance = {"position": 1e-8}  # noqa: RUF012 - a ClassVar of the base; 0.1 mm, see README.md
    start_variance = {"velocity": 1e-8}  # noqa: RUF012 - logs begin at rest
    forced = ("velocity",)
    calibrated = ("mass", "viscous")
    told_apart_by = TOLD_APART_BY
    substep, rate = 0.00125, 0.005
    horizon = float("inf")  # judged by the free run: the friction holds the position, it does not drift away

    mass: float = parameter(95.0, unit="kg", bounds=(1, 1000), doc="moving mass, motor and screw included")
    viscous: float = parameter(200.0, unit="N.s/m", bounds=(0, 5000), doc="viscous friction")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        ẋ = v
        m·v̇ = u − c·v + forces of the effects
        """
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            _, velocity = state
            return velocity, at("carriage", command[0] - self.viscous * velocity, velocity) / self.mass

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
