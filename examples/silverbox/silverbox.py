"""The Silverbox as a model of one's own: an electronic circuit that behaves as a mass on a spring, driven by a voltage.

Wigren and Schoukens (2013). All forces are referred to the input, in volt: a spring force of 1 V is what an input of
1 V does. So the base model is a frequency, a damping and a gain of 1.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Delay,
    DryFriction,
    Equations,
    Gain,
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

REVERSAL_SPEED = 2.0  # [V/s] below which dry friction is smoothed; the circuit moves at up to 100 V/s
SPRINGS = "a command strong enough that the output reaches several times its usual range, to both sides"
TOLD_APART_BY = {
    frozenset({"cubic_spring", "quadratic_spring", "cosine_spring"}): SPRINGS,
    frozenset(
        {"coulomb_damping", "quadratic_damping", "cubic_damping", "damping"}
    ): "the same command at several sizes",
    frozenset({"input_offset", "output_offset"}): SPRINGS,
}


CATALOGUE = (
    Delay.named(
        "delay",
        memory=(Quantity("V1", "V", "input that acts until the delay has passed"),),
        longest=0.02,
        time=size("s", (0, 0.02), 5e-4, "delay T"),
    ),
    Gain.named(
        "input_gain",
        input="V1",
        gain=parameter(1.0, unit="1", bounds=(0.5, 2.0), neutral=1.0, typical=0.05, doc="gain g of the amplifier"),
    ),
    Offset.named("input_offset", place="mass", value=size("V", (-0.1, 0.1), 0.005, "offset of the amplifier")),
    LocalEffect.named(  # a spring that hardens, or softens, to both sides
        "cubic_spring",
        place="mass",
        equation="force −c·y³",
        coefficient=size("1/V2", (-20, 20), 2.0, "cubic part c"),
        change=lambda e, m, force, v, y: force - e.coefficient * y * y * y,
    ),
    LocalEffect.named(  # a spring that is not the same both ways
        "quadratic_spring",
        place="mass",
        equation="force −a·y²",
        coefficient=size("1/V", (-2, 2), 0.2, "quadratic part a"),
        change=lambda e, m, force, v, y: force - e.coefficient * y * y,
    ),
    LocalEffect.named(  # a force that comes and goes with the position, as the cogging of a motor
        "cosine_spring",
        place="mass",
        equation="force −b·(1 − cos(y/s))",
        level=size("V", (-0.1, 0.1), 0.005, "half height b"),
        period=parameter(0.03, unit="V", bounds=(0.015, 0.06), doc="period s, over 2π"),
        change=lambda e, m, force, v, y: force - e.level * (1.0 - m.cos(y / e.period)),
    ),
    DryFriction.named(
        "coulomb_damping", place="mass", softness=REVERSAL_SPEED, level=size("V", (0, 0.05), 1e-3, "dry friction")
    ),
    QuadraticDrag.named("quadratic_damping", place="mass", coefficient=size("s2/V", (0, 1e-4), 1e-6, "coefficient")),
    LocalEffect.named(
        "cubic_damping",
        place="mass",
        equation="force −k·ẏ³",
        coefficient=size("s3/V2", (0, 1e-6), 1e-8, "coefficient k"),
        change=lambda e, m, force, v, y: force - e.coefficient * v * v * v,
    ),
)


@dataclass(frozen=True, kw_only=True)
class Silverbox(Model):
    """Mass, linear spring, linear damping."""

    title = "Silverbox"
    base_states = (Quantity("y", "V", "position of the mass"), Quantity("dy", "V/s", "its velocity"))
    inputs = (Quantity("V1", "V", "force on the mass"),)
    outputs = (Quantity("V2", "V", "position of the mass"),)
    catalogue, places = CATALOGUE, ("mass",)
    sensors = (Bias.named("output_offset", output="V2", value=size("V", (-0.1, 0.1), 0.005, "offset b")),)
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
        at, stiffness = self.effects_at(m), self.frequency * self.frequency

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity = state
            force = at("mass", command[0] - position, velocity, position)
            return velocity, stiffness * force - self.damping * velocity

        def output(t: Number, state: Values, command: Values) -> Values:
            return (state[0],)

        return Equations(derivative, output)
