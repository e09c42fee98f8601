"""A ball on a beam: the measured angle of the beam moves the ball, whose position is measured.

The position is positive at the end that goes down with a positive angle.
"""

from dataclasses import dataclass

from cosim.model import Delay, Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

CREEP = 5e-3  # [m/s] below which dry friction is smoothed
TOLD_APART_BY = {
    frozenset({"angle_delay", "backlash"}): "triangles of the angle at several rates: a delay grows with the rate",
    frozenset({"rolling_friction", "viscous_friction"}): "slow and fast rolling in both directions",
}


class BeamEffect(Effect):
    """An acceleration of the ball that the base model lacks."""

    def acceleration(self, m: Namespace, angle: Number, position: Number, velocity: Number) -> Number:
        """Acceleration [m/s²] of the ball."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class AngleDelay(Delay, BeamEffect):
    """The ball reacts to the angle T later: a late position reading, or a drive that gives."""

    name = "angle_delay"
    memory = (Quantity("angle", "rad", "angle that acts until the delay has passed"),)

    time: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.1, doc="delay T")


@dataclass(frozen=True, kw_only=True)
class Backlash(BeamEffect):
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


@dataclass(frozen=True, kw_only=True)
class RollingFriction(BeamEffect):
    """Dry rolling friction: −r·tanh(v/(5 mm/s))."""

    name = "rolling_friction"
    equation = "acceleration −r·tanh(v/0.005)"

    level: float = parameter(0.0, unit="m/s2", bounds=(0, 0.2), neutral=0.0, typical=0.01, doc="dry deceleration r")

    def acceleration(self, m: Namespace, angle: Number, position: Number, velocity: Number) -> Number:
        """−r·tanh(v/0.005)."""
        return -self.level * m.tanh(velocity / CREEP)


@dataclass(frozen=True, kw_only=True)
class ViscousFriction(BeamEffect):
    """Friction in proportion to the velocity: −d·v."""

    name = "viscous_friction"
    equation = "acceleration −d·v"

    damping: float = parameter(0.0, unit="1/s", bounds=(0, 5), neutral=0.0, typical=0.1, doc="damping d")

    def acceleration(self, m: Namespace, angle: Number, position: Number, velocity: Number) -> Number:
        """−d·v."""
        return -self.damping * velocity


@dataclass(frozen=True, kw_only=True)
class LevelOffset(BeamEffect):
    """The beam is not level at angle 0: k·θ₀."""

    name = "level_offset"
    equation = "acceleration o, of a beam that is not level at angle 0"

    value: float = parameter(0.0, unit="m/s2", bounds=(-0.2, 0.2), neutral=0.0, typical=0.005, doc="acceleration o")

    def acceleration(self, m: Namespace, angle: Number, position: Number, velocity: Number) -> Number:
        """Acceleration o."""
        return self.value


@dataclass(frozen=True, kw_only=True)
class BeamCurvature(BeamEffect):
    """A beam that is higher in its middle than at its ends: c·x; negative if it sags."""

    name = "beam_curvature"
    equation = "acceleration c·x"

    coefficient: float = parameter(0.0, unit="1/s2", bounds=(-2, 2), neutral=0.0, typical=0.1, doc="coefficient c")

    def acceleration(self, m: Namespace, angle: Number, position: Number, velocity: Number) -> Number:
        """c·x."""
        return self.coefficient * position


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
    catalogue = (AngleDelay, Backlash, RollingFriction, ViscousFriction, LevelOffset, BeamCurvature)
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
        terms = overrides(self.awake, "acceleration", BeamEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity = state
            total = self.incline * command[0]
            for term in terms:
                total = total + term.acceleration(m, command[0], position, velocity)
            return velocity, total

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
