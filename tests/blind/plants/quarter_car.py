"""Quarter car on a shaker: body, suspension, wheel, tyre, and a hydraulic table.

Heights are relative to the car at rest. Measured are the travel of the suspension, the acceleration of the body and its
height by a laser. The body bounces at 1.2 Hz, the wheel hops at 11 Hz.
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

CREEP = 0.02  # [m/s] below which dry friction of the damper is smoothed
STOP = 0.025  # [m] of travel at which the bump stop is met
SENSOR_VARIANCE = {"travel": 1e-6, "body_acceleration": 0.04, "body_height": 4e-6}
START_VARIANCE = {
    "body_height": 1e-4,
    "body_speed": 0.01,
    "wheel_height": 1e-4,
    "wheel_speed": 0.01,
    "table_height": 1e-4,
}
TOLD_APART_BY = {
    frozenset({"damper_coulomb", "damper_asymmetry", "damper_progression"}): "slow and fast strokes of the damper",
    frozenset({"cubic_spring", "bump_stop"}): "long strokes both ways, slow ones among them",
}


class QuarterCarEffect(Effect):
    """Force or table motion that the base model lacks."""

    def table(self, m: Namespace, height: Number) -> Number:
        """Return the height of the table's command [m]."""
        return height

    def damper(self, m: Namespace, speed: Number) -> Number:
        """Return an additional force of the damper [N], from its closing speed v."""
        return 0.0

    def mount(self, m: Namespace, force: Number, states: Values) -> tuple[Number, Number]:
        """Return the force of the damper after its mount, and the derivative of the mount's state."""
        raise NotImplementedError

    def spring(self, m: Namespace, travel: Number) -> Number:
        """Return an additional force of the spring [N], from its compression."""
        return 0.0

    def tyre(self, m: Namespace, speed: Number) -> Number:
        """Return an additional force of the tyre [N], from its closing speed."""
        return 0.0

    def body(self, m: Namespace) -> Number:
        """Return an additional upward force on the body [N]."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class CommandDelay(Delay, QuarterCarEffect):
    """Delay of the table's command by T."""

    name = "command_delay"
    memory = (Quantity("road", "m", "height that acts until the delay has passed"),)


@dataclass(frozen=True, kw_only=True)
class RoadGain(QuarterCarEffect):
    """Gain error of the table: (1 + g)·u."""

    name = "road_gain"
    equation = "(1 + g)·u in place of u"
    gain: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.03, doc="excess gain g")

    def table(self, m: Namespace, height: Number) -> Number:
        return (1.0 + self.gain) * height


@dataclass(frozen=True, kw_only=True)
class DamperAsymmetry(QuarterCarEffect):
    """Direction-dependent damping, softer in closing: additional force −a·|v|."""

    name = "damper_asymmetry"
    equation = "damper force −a·|v| beside c·v"
    coefficient: float = parameter(
        0.0, unit="N.s/m", bounds=(-1000, 1000), neutral=0.0, typical=100.0, doc="asymmetry a"
    )

    def damper(self, m: Namespace, speed: Number) -> Number:
        return -self.coefficient * m.where(speed >= 0.0, speed, -speed)


@dataclass(frozen=True, kw_only=True)
class DamperCoulomb(QuarterCarEffect):
    """Dry friction of the damper's seals: F·tanh(v/0.02)."""

    name = "damper_coulomb"
    equation = "damper force F·tanh(v/0.02) beside c·v"
    level: float = parameter(0.0, unit="N", bounds=(0, 300), neutral=0.0, typical=20.0, doc="dry friction F")

    def damper(self, m: Namespace, speed: Number) -> Number:
        return self.level * m.tanh(speed / CREEP)


@dataclass(frozen=True, kw_only=True)
class DamperProgression(QuarterCarEffect):
    """Damping that grows with speed: additional force p·|v|·v."""

    name = "damper_progression"
    equation = "damper force p·|v|·v beside c·v"
    coefficient: float = parameter(
        0.0, unit="N.s2/m2", bounds=(0, 3000), neutral=0.0, typical=200.0, doc="progression p"
    )

    def damper(self, m: Namespace, speed: Number) -> Number:
        return self.coefficient * m.where(speed >= 0.0, speed, -speed) * speed


@dataclass(frozen=True, kw_only=True)
class DamperMount(QuarterCarEffect):
    """Lag of the damper's force in a rubber mount: τ·ḟ = force − f."""

    name = "damper_mount"
    equation = "τ·ḟ = damper force − f, f in place of it"
    states = (Quantity("force", "N", "force of the damper after its mount"),)
    time: float = parameter(0.0, unit="s", bounds=(0, 0.2), neutral=0.0, typical=0.008, doc="time constant τ; 0 = off")

    def mount(self, m: Namespace, force: Number, states: Values) -> tuple[Number, Number]:
        """Return the lagged force and its derivative; time constants below half a row count as half a row."""
        return m.where(self.time > 0.0, states[0], force), (force - states[0]) / m.maximum(self.time, 0.0025)


@dataclass(frozen=True, kw_only=True)
class CubicSpring(QuarterCarEffect):
    """Spring hardening in both directions: additional force k₃·z³."""

    name = "cubic_spring"
    equation = "spring force k₃·z³ beside k·z"
    stiffness: float = parameter(0.0, unit="N/m3", bounds=(0, 1e8), neutral=0.0, typical=2e6, doc="cubic stiffness k₃")

    def spring(self, m: Namespace, travel: Number) -> Number:
        return self.stiffness * travel * travel * travel


@dataclass(frozen=True, kw_only=True)
class BumpStop(QuarterCarEffect):
    """Rubber buffer after 25 mm of closing: k·max(z − 0.025, 0)²."""

    name = "bump_stop"
    equation = "spring force k·max(z − 0.025, 0)² beside k·z"
    stiffness: float = parameter(0.0, unit="N/m2", bounds=(0, 1e8), neutral=0.0, typical=5e5, doc="stiffness k")

    def spring(self, m: Namespace, travel: Number) -> Number:
        pressed = m.maximum(travel - STOP, 0.0)
        return self.stiffness * pressed * pressed


@dataclass(frozen=True, kw_only=True)
class TyreDamping(QuarterCarEffect):
    """Damping of the tyre: additional force d·v."""

    name = "tyre_damping"
    equation = "tyre force d·v beside k·deflection"
    coefficient: float = parameter(0.0, unit="N.s/m", bounds=(0, 2000), neutral=0.0, typical=80.0, doc="damping d")

    def tyre(self, m: Namespace, speed: Number) -> Number:
        return self.coefficient * speed


@dataclass(frozen=True, kw_only=True)
class Preload(QuarterCarEffect):
    """Constant force on the body, from a load added after zeroing of the heights."""

    name = "preload"
    equation = "force f on the body"
    force: float = parameter(0.0, unit="N", bounds=(-500, 500), neutral=0.0, typical=20.0, doc="force f, upward")

    def body(self, m: Namespace) -> Number:
        return self.force


@dataclass(frozen=True, kw_only=True)
class AccelerometerBias(Bias):
    """Bias of the accelerometer: reading a + b."""

    name = "accelerometer_bias"
    output = "body_acceleration"
    value: float = parameter(0.0, unit="m/s2", bounds=(-2, 2), neutral=0.0, typical=0.05, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class TravelScale(Scale):
    """Scale error of the travel sensor: reading s·z."""

    name = "travel_scale"
    output = "travel"
    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class LaserLatency(Latency):
    """Latency of the averaging laser: the height is T old."""

    name = "laser_latency"
    output = "body_height"
    outputs = ("body_height",)


@dataclass(frozen=True, kw_only=True)
class QuarterCar(Model):
    """Two masses, two springs, a damper, and a table with a lag."""

    title = "Quarter car on a shaker"
    base_states = (
        Quantity("body_height", "m", "height of the body"),
        Quantity("body_speed", "m/s", "its speed, upward"),
        Quantity("wheel_height", "m", "height of the wheel"),
        Quantity("wheel_speed", "m/s", "its speed, upward"),
        Quantity("table_height", "m", "height of the table"),
    )
    inputs = (Quantity("road", "m", "height commanded to the table"),)
    outputs = (
        base_states[0],
        base_states[2],
        Quantity("travel", "m", "how far the suspension is closed"),
        Quantity("body_acceleration", "m/s2", "acceleration of the body, upward"),
    )
    catalogue = (
        CommandDelay, RoadGain, DamperAsymmetry, DamperCoulomb, DamperProgression, DamperMount, CubicSpring, BumpStop,
        TyreDamping, Preload,
    )  # fmt: skip
    sensors = (TravelScale, AccelerometerBias, LaserLatency)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("body_speed", "wheel_speed")
    calibrated = ("body_mass", "wheel_mass", "spring", "damping", "tyre", "table_lag")
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 0.005, 0.00125, 1.0

    body_mass: float = parameter(300.0, unit="kg", bounds=(10, 5000), tolerance=0.05, doc="mass of the body, weighed")
    wheel_mass: float = parameter(40.0, unit="kg", bounds=(1, 500), tolerance=0.1, doc="mass of wheel and axle")
    spring: float = parameter(
        18000.0, unit="N/m", bounds=(1000, 1e6), tolerance=0.05, doc="stiffness of the spring, catalogue"
    )
    damping: float = parameter(1200.0, unit="N.s/m", bounds=(10, 2e4), tolerance=0.3, doc="damping of the damper")
    tyre: float = parameter(180000.0, unit="N/m", bounds=(1e4, 2e6), tolerance=0.15, doc="stiffness of the tyre")
    table_lag: float = parameter(0.02, unit="s", bounds=(0.004, 0.5), tolerance=0.2, doc="lag of the table")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace, with z the closing of the suspension and v its speed.

        s = k·z + c·v + forces of spring and damper,  z = z_w − z_b
        M·z̈_b = s + forces on the body
        m·z̈_w = k_t·(z_r − z_w) + forces of the tyre − s
        τ·ż_r = u − z_r
        """
        body, wheel, k, c, k_tyre, tau = (
            self.body_mass, self.wheel_mass, self.spring, self.damping, self.tyre, self.table_lag,
        )  # fmt: skip
        awake = self.awake
        tables = overrides(awake, "table", QuarterCarEffect)
        dampers = overrides(awake, "damper", QuarterCarEffect)
        mounts = overrides(awake, "mount", QuarterCarEffect)
        springs = overrides(awake, "spring", QuarterCarEffect)
        tyres = overrides(awake, "tyre", QuarterCarEffect)
        upon = sum(term.body(m) for term in overrides(awake, "body", QuarterCarEffect))

        def suspension(state: Values) -> tuple[Number, Values]:
            """Return the force of spring and damper on the body, and the derivatives of the effects' states."""
            height, speed, wheel_height, wheel_speed, _, *own = state
            travel, closing = wheel_height - height, wheel_speed - speed
            slopes: Values = ()
            force = c * closing
            for term in dampers:
                force = force + term.damper(m, closing)
            for term in mounts:
                force, slope = term.mount(m, force, tuple(own))
                slopes = (slope,)
            force = force + k * travel
            for term in springs:
                force = force + term.spring(m, travel)
            return force, slopes

        def derivative(t: Number, state: Values, command: Values) -> Values:
            _, speed, wheel_height, wheel_speed, table_height, *_ = state
            goal = command[0]
            for term in tables:
                goal = term.table(m, goal)
            table_speed = (goal - table_height) / tau
            force, slopes = suspension(state)
            tyre = k_tyre * (table_height - wheel_height)
            for term in tyres:
                tyre = tyre + term.tyre(m, table_speed - wheel_speed)
            return speed, (force + upon) / body, wheel_speed, (tyre - force) / wheel, table_speed, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            force, _ = suspension(state)
            return state[0], state[2], state[2] - state[0], (force + upon) / body

        return Equations(derivative, output)
