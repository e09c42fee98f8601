"""A positioning drive as a model of one's own: one mass on a rail, pushed by a motor, held back by viscous friction.

The Electro-Mechanical Positioning System of Janot, Gautier and Brunot (2019). This file is all there is to it: states,
inputs, outputs, parameters, effects and one body of equations.
"""

from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, Values, overrides, parameter

REVERSAL_SPEED = 1e-3  # [m/s] below which dry friction is smoothed; the drive moves at up to 0.13 m/s
TOLD_APART_BY = {
    frozenset(
        {"coulomb_friction", "stribeck_friction", "quadratic_drag", "viscous"}
    ): "runs at several speeds, slow ones among them, with reversals",
}


class DriveEffect(Effect):
    """A force on the carriage that the base model lacks."""

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force [N] in the direction of travel."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class ForceOffset(DriveEffect):
    """A constant force: a slope, a cable that pulls, an offset of the amplifier."""

    name = "force_offset"
    equation = "force f"

    value: float = parameter(0.0, unit="N", bounds=(-100, 100), neutral=0.0, typical=2.0, doc="offset f")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force f."""
        return self.value


@dataclass(frozen=True, kw_only=True)
class CoulombFriction(DriveEffect):
    """Dry friction: −F·tanh(v/0.001)."""

    name = "coulomb_friction"
    equation = "force −F·tanh(v/0.001)"

    level: float = parameter(0.0, unit="N", bounds=(0, 200), neutral=0.0, typical=10.0, doc="dry friction force F")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −F·tanh(v/0.001)."""
        return -self.level * m.tanh(velocity / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class StribeckFriction(DriveEffect):
    """What dry friction is more at low speed, beside its level: −B·e^(−(v/v_s)²)·tanh(v/0.001), B ≥ 0."""

    name = "stribeck_friction"
    equation = "force −B·e^(−(v/v_s)²)·tanh(v/0.001)"

    breakaway: float = parameter(0.0, unit="N", bounds=(0, 200), neutral=0.0, typical=5.0, doc="breakaway force B")
    speed: float = parameter(0.02, unit="m/s", bounds=(0.01, 0.2), doc="Stribeck speed v_s, well above the smoothing")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −B·e^(−(v/v_s)²)·tanh(v/0.001)."""
        return -self.breakaway * m.exp(-((velocity / self.speed) ** 2)) * m.tanh(velocity / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class QuadraticDrag(DriveEffect):
    """Drag: −k·|v|·v."""

    name = "quadratic_drag"
    equation = "force −k·|v|·v"

    coefficient: float = parameter(
        0.0, unit="N.s2/m2", bounds=(0, 5000), neutral=0.0, typical=200.0, doc="drag coefficient k"
    )

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −k·|v|·v."""
        return -self.coefficient * m.where(velocity >= 0.0, velocity, -velocity) * velocity


@dataclass(frozen=True, kw_only=True)
class Drive(Model):
    """One mass, viscous friction."""

    title = "Positioning drive"
    base_states = (Quantity("position", "m", "position of the carriage"), Quantity("velocity", "m/s", "its velocity"))
    inputs = (Quantity("force", "N", "motor force commanded"),)
    outputs = base_states
    catalogue = (ForceOffset, CoulombFriction, StribeckFriction, QuadraticDrag)
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
        mass, c = self.mass, self.viscous
        terms = overrides(self.awake, "force", DriveEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity = state
            total = command[0] - c * velocity
            for term in terms:
                total = total + term.force(m, position, velocity)
            return velocity, total / mass

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
