"""Drive train: a motor turns a load through an elastic belt; both have viscous friction.

Measured are the angles of motor and load by encoders and the speed of the motor by a tachometer. Motor and belt
resonate at about 14 Hz; the drive train accelerates within half a second.
"""

from dataclasses import dataclass

from cosim.model import (
    Asymmetry,
    Bias,
    Delay,
    DryFriction,
    Equations,
    Latency,
    LocalEffect,
    Model,
    Namespace,
    Number,
    Offset,
    QuadraticDrag,
    Quantity,
    Scale,
    Values,
    parameter,
    size,
)

REVERSAL = 0.3  # [rad/s] below which dry friction is smoothed; the motor turns at up to 50 rad/s
TEETH = 4  # notches of the motor a turn
SENSOR_VARIANCE = {"motor_angle": 1e-4, "motor_speed": 0.25, "load_angle": 1e-4}
START_VARIANCE = {"motor_angle": 1.0, "motor_speed": 25.0, "load_angle": 1.0, "load_speed": 25.0}
CATALOGUE = (
    Delay.named(
        "command_delay", memory=(Quantity("torque", "N.m", "torque that acts until the delay has passed"),)
    ),
    DryFriction.named("load_coulomb", place="load", softness=REVERSAL, level=size("N.m", (0, 1), 0.05, "dry friction")),
    LocalEffect.named(
        "load_stribeck", place="load", equation="torque −B·e^(−(ω_l/ω_s)²)·tanh(ω_l/0.3) on the load",
        breakaway=size("N.m", (0, 1), 0.05, "breakaway torque B"),
        speed=parameter(4.0, unit="rad/s", bounds=(1.5, 20), doc="Stribeck speed ω_s, well above the smoothing"),
        change=lambda e, m, torque, w: torque - e.breakaway * m.exp(-((w / e.speed) ** 2)) * m.tanh(w / REVERSAL),
    ),
    QuadraticDrag.named("fan_drag", place="load", coefficient=size("N.m.s2/rad2", (0, 0.02), 2e-4, "drag coefficient")),
    LocalEffect.named(
        "cubic_belt", place="belt", equation="belt torque k₃·twist³ beside k·twist",
        stiffness=size("N.m/rad3", (0, 1e5), 1000.0, "cubic stiffness k₃"),
        change=lambda e, m, belt, k, twist: belt + e.stiffness * twist * twist * twist,
    ),
    LocalEffect.named(
        "belt_play", place="belt", equation="belt torque −k·w·tanh(twist/(w + 0.001)) beside k·twist",
        width=size("rad", (0, 0.1), 0.01, "half width w of the play"),
        change=lambda e, m, belt, k, twist: belt - k * e.width * m.tanh(twist / (e.width + 1e-3)),
    ),
    LocalEffect.named(
        "cogging", place="motor", equation="torque s·sin(4·θ_m) + c·cos(4·θ_m) on the motor",
        sine=size("N.m", (-1, 1), 0.05, "amplitude s"), cosine=size("N.m", (-1, 1), 0.05, "amplitude c"),
        change=lambda e, m, torque, angle: torque + (
            e.sine * m.sin(TEETH * angle) + e.cosine * m.cos(TEETH * angle)
        ),
    ),
    Asymmetry.named("torque_asymmetry", place="command", ratio=size("1", (-0.5, 0.5), 0.05, "asymmetry a")),
    Offset.named("torque_offset", place="motor", value=size("N.m", (-1, 1), 0.05, "offset b of the amplifier")),
)  # fmt: skip
SENSORS = (
    Scale.named(
        "tacho_scale", output="motor_speed",
        value=parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s"),
    ),
    Bias.named("tacho_bias", output="motor_speed", value=size("rad/s", (-5, 5), 0.1, "bias b")),
    Latency.named("load_latency", outputs=("load_angle",)),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DriveTrain(Model):
    """Drive train of two inertias and a belt."""

    title = "Drive train"
    base_states = (
        Quantity("motor_angle", "rad", "angle of the motor"),
        Quantity("motor_speed", "rad/s", "its speed"),
        Quantity("load_angle", "rad", "angle of the load"),
        Quantity("load_speed", "rad/s", "its speed"),
    )
    inputs = (Quantity("torque", "N.m", "motor torque commanded"),)
    outputs = base_states
    catalogue, sensors, places = CATALOGUE, SENSORS, ("command", "motor", "belt", "load")
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("motor_speed", "load_speed")
    calibrated = ("motor_inertia", "load_inertia", "stiffness", "motor_damping", "load_damping")
    rate, substep, horizon = 0.005, 0.00125, 0.5

    motor_inertia: float = parameter(
        0.004, unit="kg.m2", bounds=(1e-4, 0.1), tolerance=0.05, doc="inertia of the motor"
    )
    load_inertia: float = parameter(0.012, unit="kg.m2", bounds=(1e-4, 0.5), tolerance=0.2, doc="inertia of the load")
    stiffness: float = parameter(25.0, unit="N.m/rad", bounds=(1, 500), tolerance=0.1, doc="stiffness of the belt")
    motor_damping: float = parameter(
        0.015, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction, motor"
    )
    load_damping: float = parameter(0.025, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction, load")
    belt_damping: float = parameter(0.05, unit="N.m.s/rad", bounds=(0, 1), doc="damping in the belt")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace, with twist = θ_m − θ_l.

        s = k·twist + d·(ω_m − ω_l) + torques in the belt
        J_m·ω̇_m = u − b_m·ω_m − s + torques on the motor
        J_l·ω̇_l = s − b_l·ω_l + torques on the load
        """
        at = self.effects_at(m)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            motor_angle, motor_speed, load_angle, load_speed = state
            twist = motor_angle - load_angle
            belt = self.stiffness * twist + self.belt_damping * (motor_speed - load_speed)
            belt = at("belt", belt, self.stiffness, twist)
            motor = at("command", command[0]) - self.motor_damping * motor_speed - belt
            load = at("load", belt - self.load_damping * load_speed, load_speed)
            motor = at("motor", motor, motor_angle)
            return motor_speed, motor / self.motor_inertia, load_speed, load / self.load_inertia

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
