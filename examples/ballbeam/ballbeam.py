"""A ball on a beam: the measured angle of the beam moves the ball, whose position is measured.

The position is positive at the end that goes down with a positive angle.
"""

from dataclasses import dataclass

from cosim.model import (
    Delay,
    DryFriction,
    Effect,
    Equations,
    LocalEffect,
    Model,
    Namespace,
    Number,
    Offset,
    Quantity,
    Values,
    parameter,
    size,
)

CREEP = 5e-3  # [m/s] below which dry friction is smoothed
TOLD_APART_BY = {
    frozenset({"angle_delay", "backlash"}): "triangles of the angle at several rates: a delay grows with the rate",
    frozenset({"rolling_friction", "viscous_friction"}): "slow and fast rolling in both directions",
}


@dataclass(frozen=True, kw_only=True)
class Backlash(Effect):
    """Play of total width w between the measured angle and the beam: p ← θ + clip(p − θ, ±w/2)."""

    name = "backlash"
    equation = "p ← θ + clip(p − θ, ±w/2), p in place of θ"
    memory = (Quantity("play", "rad", "angle after the play"),)

    width: float = parameter(0.0, unit="rad", bounds=(0, 0.02), neutral=0.0, typical=0.003, doc="total width w")

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """Return the angle after the play, which is also the memory."""
        half = 0.5 * self.width
        play = (command[0] + m.minimum(m.maximum(memory[0] - command[0], -half), half),)
        return play, play


CATALOGUE = (
    Delay.named(  # the ball reacts to the angle later: a late position reading, or a drive that gives
        "angle_delay",
        memory=(Quantity("angle", "rad", "angle that acts until the delay has passed"),),
        time=size("s", (0, 0.5), 0.1, "delay T"),
    ),
    Backlash,
    DryFriction.named(
        "rolling_friction", place="ball", softness=CREEP, level=size("m/s2", (0, 0.2), 0.01, "dry deceleration")
    ),
    LocalEffect.named(
        "viscous_friction",
        place="ball",
        equation="acceleration −d·v",
        damping=size("1/s", (0, 5), 0.1, "damping d"),
        change=lambda e, m, total, v, x: total - e.damping * v,
    ),
    # a beam that is not level at angle 0
    Offset.named("level_offset", place="ball", value=size("m/s2", (-0.2, 0.2), 0.005, "acceleration")),
    LocalEffect.named(  # a beam that is higher in its middle than at its ends; negative if it sags
        "beam_curvature",
        place="ball",
        equation="acceleration c·x",
        coefficient=size("1/s2", (-2, 2), 0.1, "coefficient c"),
        change=lambda e, m, total, v, x: total + e.coefficient * x,
    ),
)


@dataclass(frozen=True, kw_only=True)
class BallBeam(Model):
    """A ball that rolls on a straight beam without friction."""

    title = "Ball on a beam"
    base_states = (
        Quantity("position", "m", "position of the ball"),
        Quantity("velocity", "m/s", "its velocity"),
    )
    inputs = (Quantity("angle", "rad", "angle of the beam"),)
    outputs = base_states[:1]
    catalogue, places = CATALOGUE, ("ball",)
    sensor_variance = {"position": 1e-6}  # noqa: RUF012 - a ClassVar of the base; 1 mm
    start_variance = {"velocity": 0.01}  # noqa: RUF012 - likewise; 0.1 m/s
    forced = ("velocity",)
    calibrated = ("incline",)
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 0.1, 0.025, 2.0

    incline: float = parameter(
        7.0, unit="m/s2/rad", bounds=(1, 10), tolerance=0.3, doc="5/7 of gravity: a solid ball on a flat beam"
    )

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace: ẍ = k·θ + accelerations of the effects."""
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity = state
            return velocity, at("ball", self.incline * command[0], velocity, position)

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
