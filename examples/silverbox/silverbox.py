"""The Silverbox as a model of one's own: an electronic circuit that behaves as a mass on a spring, driven by a voltage.

Wigren and Schoukens (2013). All forces are referred to the input, in volt: a spring force of 1 V is what an input of
1 V does. So the base model is a frequency, a damping and a gain of 1.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Delay,
    Effect,
    Equations,
    Gain,
    Model,
    Namespace,
    Number,
    Quantity,
    Values,
    overrides,
    parameter,
)

REVERSAL_SPEED = 2.0  # [V/s] below which dry friction is smoothed; the circuit moves at up to 100 V/s
SPRINGS = "a command strong enough that the output reaches several times its usual range, to both sides"
TOLD_APART_BY = {
    frozenset({"cubic_spring", "quadratic_spring", "cosine_spring"}): SPRINGS,
    frozenset(
        {"coulomb_damping", "quadratic_damping", "cubic_damping", "damping"}
    ): "the same command at several sizes",
    frozenset({"input_offset", "output_offset"}): SPRINGS,
}


class CircuitEffect(Effect):
    """A force on the mass that the base model lacks, or an error of the command."""

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force [V] on the mass."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class CommandDelay(Delay, CircuitEffect):
    """The input acts T later."""

    name = "delay"
    memory = (Quantity("V1", "V", "input that acts until the delay has passed"),)
    longest = 0.02

    time: float = parameter(0.0, unit="s", bounds=(0, 0.02), neutral=0.0, typical=5e-4, doc="delay T")


@dataclass(frozen=True, kw_only=True)
class InputGain(Gain, CircuitEffect):
    """The amplifier is not of gain 1: g·V1."""

    name = "input_gain"
    equation = "input g·V1"
    input = "V1"

    gain: float = parameter(1.0, unit="1", bounds=(0.5, 2.0), neutral=1.0, typical=0.05, doc="gain g of the input")


@dataclass(frozen=True, kw_only=True)
class InputOffset(CircuitEffect):
    """An offset of the amplifier: a constant force."""

    name = "input_offset"
    equation = "force o"

    value: float = parameter(0.0, unit="V", bounds=(-0.1, 0.1), neutral=0.0, typical=0.005, doc="offset o")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force o."""
        return self.value


@dataclass(frozen=True, kw_only=True)
class CubicSpring(CircuitEffect):
    """A spring that hardens (or softens) to both sides: −c·y³."""

    name = "cubic_spring"
    equation = "force −c·y³"

    coefficient: float = parameter(0.0, unit="1/V2", bounds=(-20, 20), neutral=0.0, typical=2.0, doc="cubic part c")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −c·y³."""
        return -self.coefficient * position * position * position


@dataclass(frozen=True, kw_only=True)
class QuadraticSpring(CircuitEffect):
    """A spring that is not the same both ways: −a·y²."""

    name = "quadratic_spring"
    equation = "force −a·y²"

    coefficient: float = parameter(0.0, unit="1/V", bounds=(-2, 2), neutral=0.0, typical=0.2, doc="quadratic part a")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −a·y²."""
        return -self.coefficient * position * position


@dataclass(frozen=True, kw_only=True)
class CosineSpring(CircuitEffect):
    """A force that comes and goes with the position, as the cogging of a motor: −b·(1 − cos(y/s))."""

    name = "cosine_spring"
    equation = "force −b·(1 − cos(y/s))"

    level: float = parameter(0.0, unit="V", bounds=(-0.1, 0.1), neutral=0.0, typical=0.005, doc="half height b")
    period: float = parameter(0.03, unit="V", bounds=(0.015, 0.06), doc="period s, over 2π")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −b·(1 − cos(y/s))."""
        return -self.level * (1.0 - m.cos(position / self.period))


@dataclass(frozen=True, kw_only=True)
class CoulombDamping(CircuitEffect):
    """Dry friction: −F·tanh(ẏ/2)."""

    name = "coulomb_damping"
    equation = "force −F·tanh(ẏ/2)"

    level: float = parameter(0.0, unit="V", bounds=(0, 0.05), neutral=0.0, typical=1e-3, doc="dry friction F")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −F·tanh(ẏ/2)."""
        return -self.level * m.tanh(velocity / REVERSAL_SPEED)


@dataclass(frozen=True, kw_only=True)
class QuadraticDamping(CircuitEffect):
    """Drag: −k·|ẏ|·ẏ."""

    name = "quadratic_damping"
    equation = "force −k·|ẏ|·ẏ"

    coefficient: float = parameter(0.0, unit="s2/V", bounds=(0, 1e-4), neutral=0.0, typical=1e-6, doc="coefficient k")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −k·|ẏ|·ẏ."""
        return -self.coefficient * m.where(velocity >= 0.0, velocity, -velocity) * velocity


@dataclass(frozen=True, kw_only=True)
class CubicDamping(CircuitEffect):
    """Damping that grows with the square of the speed: −k·ẏ³."""

    name = "cubic_damping"
    equation = "force −k·ẏ³"

    coefficient: float = parameter(0.0, unit="s3/V2", bounds=(0, 1e-6), neutral=0.0, typical=1e-8, doc="coefficient k")

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Force −k·ẏ³."""
        return -self.coefficient * velocity * velocity * velocity


@dataclass(frozen=True, kw_only=True)
class OutputOffset(Bias):
    """The output reads y + b."""

    name = "output_offset"
    output = "V2"

    value: float = parameter(0.0, unit="V", bounds=(-0.1, 0.1), neutral=0.0, typical=0.005, doc="offset b")


@dataclass(frozen=True, kw_only=True)
class Silverbox(Model):
    """Mass, linear spring, linear damping."""

    title = "Silverbox"
    base_states = (Quantity("y", "V", "position of the mass"), Quantity("dy", "V/s", "its velocity"))
    inputs = (Quantity("V1", "V", "force on the mass"),)
    outputs = (Quantity("V2", "V", "position of the mass"),)
    catalogue = (
        CommandDelay,
        InputGain,
        InputOffset,
        CubicSpring,
        QuadraticSpring,
        CosineSpring,
        CoulombDamping,
        QuadraticDamping,
        CubicDamping,
    )
    sensors = (OutputOffset,)
    sensor_variance = {"V2": 2.5e-7}  # noqa: RUF012 - a ClassVar of the base; 0.5 mV, see README.md
    forced = ("dy",)
    calibrated = ("frequency", "damping")
    told_apart_by = TOLD_APART_BY
    rate = 2**14 / 1e7  # 610.35 Hz
    substep = rate / 4
    horizon = float("inf")  # judged by the free run

    frequency: float = parameter(
        430.0, unit="rad/s", bounds=(100, 1000), tolerance=0.05, doc="natural frequency at small motion"
    )
    damping: float = parameter(42.0, unit="1/s", bounds=(1, 500), tolerance=0.2, doc="viscous damping over mass")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace.

        ÿ = ω²·(V1 − y + forces of the effects) − d·ẏ
        """
        stiffness, d = self.frequency * self.frequency, self.damping
        terms = overrides(self.awake, "force", CircuitEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity = state
            total = command[0] - position
            for term in terms:
                total = total + term.force(m, position, velocity)
            return velocity, stiffness * total - d * velocity

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
