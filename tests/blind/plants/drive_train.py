"""Drive train: a motor turns a load through an elastic belt; both have viscous friction.

Measured are the angles of motor and load by encoders and the speed of the motor by a tachometer. Motor and belt
resonate at about 14 Hz; the drive train accelerates within half a second.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Delay,
    Effect,
    Equations,
    Latency,
    Model,
    Namespace,
    Number,
    Quantity,
    Scale,
    Values,
    overrides,
    parameter,
)

REVERSAL = 0.3  # [rad/s] below which dry friction is smoothed; the motor turns at up to 50 rad/s
TEETH = 4  # notches of the motor a turn
SENSOR_VARIANCE = {"motor_angle": 1e-4, "motor_speed": 0.25, "load_angle": 1e-4}
START_VARIANCE = {"motor_angle": 1.0, "motor_speed": 25.0, "load_angle": 1.0, "load_speed": 25.0}
TOLD_APART_BY = {
    frozenset({"load_coulomb", "load_stribeck", "fan_drag"}): "several speeds, and reversals at rest",
    frozenset({"cubic_belt", "belt_play"}): "torques from small to full range, with the load held back by its inertia",
}


class DriveTrainEffect(Effect):
    """Torque on the motor, on the load or in the belt that the base model lacks."""

    def motor(self, m: Namespace, torque: Number, angle: Number) -> Number:
        """Return an additional torque on the motor [N m], from commanded torque and motor angle."""
        return 0.0

    def load(self, m: Namespace, speed: Number) -> Number:
        """Return an additional torque on the load [N m], from the load's speed."""
        return 0.0

    def belt(self, m: Namespace, stiffness: Number, twist: Number) -> Number:
        """Return an additional torque of the belt [N m], to be added to k·twist."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class CommandDelay(Delay, DriveTrainEffect):
    """Delay of the torque command by T."""

    name = "command_delay"
    memory = (Quantity("torque", "N.m", "torque that acts until the delay has passed"),)


@dataclass(frozen=True, kw_only=True)
class LoadCoulomb(DriveTrainEffect):
    """Dry friction of the load's bearings: −F·tanh(ω/0.3)."""

    name = "load_coulomb"
    equation = "torque −F·tanh(ω_l/0.3) on the load"
    level: float = parameter(0.0, unit="N.m", bounds=(0, 1), neutral=0.0, typical=0.05, doc="dry friction F")

    def load(self, m: Namespace, speed: Number) -> Number:
        return -self.level * m.tanh(speed / REVERSAL)


@dataclass(frozen=True, kw_only=True)
class LoadStribeck(DriveTrainEffect):
    """Additional dry friction of the load at low speed: −B·e^(−(ω/ω_s)²)·tanh(ω/0.3), B ≥ 0."""

    name = "load_stribeck"
    equation = "torque −B·e^(−(ω_l/ω_s)²)·tanh(ω_l/0.3) on the load"
    breakaway: float = parameter(0.0, unit="N.m", bounds=(0, 1), neutral=0.0, typical=0.05, doc="breakaway torque B")
    speed: float = parameter(4.0, unit="rad/s", bounds=(1.5, 20), doc="Stribeck speed ω_s, well above the smoothing")

    def load(self, m: Namespace, speed: Number) -> Number:
        return -self.breakaway * m.exp(-((speed / self.speed) ** 2)) * m.tanh(speed / REVERSAL)


@dataclass(frozen=True, kw_only=True)
class FanDrag(DriveTrainEffect):
    """Quadratic drag of the load: −c·|ω|·ω."""

    name = "fan_drag"
    equation = "torque −c·|ω_l|·ω_l on the load"
    coefficient: float = parameter(
        0.0, unit="N.m.s2/rad2", bounds=(0, 0.02), neutral=0.0, typical=2e-4, doc="drag coefficient c"
    )

    def load(self, m: Namespace, speed: Number) -> Number:
        return -self.coefficient * m.where(speed >= 0.0, speed, -speed) * speed


@dataclass(frozen=True, kw_only=True)
class CubicBelt(DriveTrainEffect):
    """Hardening belt: additional torque k₃·twist³."""

    name = "cubic_belt"
    equation = "belt torque k₃·twist³ beside k·twist"
    stiffness: float = parameter(
        0.0, unit="N.m/rad3", bounds=(0, 1e5), neutral=0.0, typical=1000.0, doc="cubic stiffness k₃"
    )

    def belt(self, m: Namespace, stiffness: Number, twist: Number) -> Number:
        return self.stiffness * twist * twist * twist


@dataclass(frozen=True, kw_only=True)
class BeltPlay(DriveTrainEffect):
    """Smooth play between belt and pulley: additional torque −k·w·tanh(twist/(w + 1 mrad))."""

    name = "belt_play"
    equation = "belt torque −k·w·tanh(twist/(w + 0.001)) beside k·twist"
    width: float = parameter(
        0.0, unit="rad", bounds=(0, 0.1), neutral=0.0, typical=0.01, doc="half width w of the play"
    )

    def belt(self, m: Namespace, stiffness: Number, twist: Number) -> Number:
        return -stiffness * self.width * m.tanh(twist / (self.width + 1e-3))


@dataclass(frozen=True, kw_only=True)
class Cogging(DriveTrainEffect):
    """Cogging torque of the motor, four periods per turn: s·sin 4θ + c·cos 4θ."""

    name = "cogging"
    equation = "torque s·sin(4·θ_m) + c·cos(4·θ_m) on the motor"
    sine: float = parameter(0.0, unit="N.m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="amplitude s")
    cosine: float = parameter(0.0, unit="N.m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="amplitude c")

    def motor(self, m: Namespace, torque: Number, angle: Number) -> Number:
        return self.sine * m.sin(TEETH * angle) + self.cosine * m.cos(TEETH * angle)


@dataclass(frozen=True, kw_only=True)
class TorqueAsymmetry(DriveTrainEffect):
    """Direction-dependent torque of the amplifier: u + a·|u|."""

    name = "torque_asymmetry"
    equation = "torque a·|u| beside u"
    ratio: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.05, doc="asymmetry a")

    def motor(self, m: Namespace, torque: Number, angle: Number) -> Number:
        return self.ratio * m.where(torque >= 0.0, torque, -torque)


@dataclass(frozen=True, kw_only=True)
class TorqueOffset(DriveTrainEffect):
    """Constant torque on the motor, from an amplifier offset or a hanging weight."""

    name = "torque_offset"
    equation = "torque b on the motor"
    value: float = parameter(0.0, unit="N.m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="offset b")

    def motor(self, m: Namespace, torque: Number, angle: Number) -> Number:
        return self.value


@dataclass(frozen=True, kw_only=True)
class TachoScale(Scale):
    """Scale error of the tachometer: reading s·ω."""

    name = "tacho_scale"
    output = "motor_speed"
    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class TachoBias(Bias):
    """Bias of the tachometer: reading ω + b."""

    name = "tacho_bias"
    output = "motor_speed"
    value: float = parameter(0.0, unit="rad/s", bounds=(-5, 5), neutral=0.0, typical=0.1, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class LoadLatency(Latency):
    """Latency of the load's encoder on a bus: the angle is T old."""

    name = "load_latency"
    output = "load_angle"
    outputs = ("load_angle",)


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
    catalogue = (
        CommandDelay, LoadCoulomb, LoadStribeck, FanDrag, CubicBelt, BeltPlay, Cogging, TorqueAsymmetry, TorqueOffset,
    )  # fmt: skip
    sensors = (TachoScale, TachoBias, LoadLatency)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("motor_speed", "load_speed")
    calibrated = ("motor_inertia", "load_inertia", "stiffness", "motor_damping", "load_damping")
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 0.005, 0.00125, 0.5

    motor_inertia: float = parameter(
        0.004, unit="kg.m2", bounds=(1e-4, 0.1), tolerance=0.05, doc="inertia of the motor, from its data sheet"
    )
    load_inertia: float = parameter(
        0.012, unit="kg.m2", bounds=(1e-4, 0.5), tolerance=0.2, doc="inertia of the load, from its drawing"
    )
    stiffness: float = parameter(25.0, unit="N.m/rad", bounds=(1, 500), tolerance=0.1, doc="stiffness of the belt")
    motor_damping: float = parameter(
        0.015, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction of the motor"
    )
    load_damping: float = parameter(
        0.025, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction of the load"
    )
    belt_damping: float = parameter(0.05, unit="N.m.s/rad", bounds=(0, 1), doc="damping in the belt")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace, with twist = θ_m − θ_l.

        s = k·twist + d·(ω_m − ω_l) + torques in the belt
        J_m·ω̇_m = u − b_m·ω_m − s + torques on the motor
        J_l·ω̇_l = s − b_l·ω_l + torques on the load
        """
        j_motor, j_load, k, d = self.motor_inertia, self.load_inertia, self.stiffness, self.belt_damping
        b_motor, b_load = self.motor_damping, self.load_damping
        on_motor = overrides(self.awake, "motor", DriveTrainEffect)
        on_load = overrides(self.awake, "load", DriveTrainEffect)
        in_belt = overrides(self.awake, "belt", DriveTrainEffect)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            motor_angle, motor_speed, load_angle, load_speed = state
            twist = motor_angle - load_angle
            belt = k * twist + d * (motor_speed - load_speed)
            for term in in_belt:
                belt = belt + term.belt(m, k, twist)
            motor = command[0] - b_motor * motor_speed - belt
            for term in on_motor:
                motor = motor + term.motor(m, command[0], motor_angle)
            load = belt - b_load * load_speed
            for term in on_load:
                load = load + term.load(m, load_speed)
            return motor_speed, motor / j_motor, load_speed, load / j_load

        def output(t: Number, state: Values, command: Values) -> Values:
            return state

        return Equations(derivative, output)
