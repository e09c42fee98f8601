"""Cart on a rail with a hanging bob, like a small crane, driven in open loop by a motor.

Measured are the position by a camera, the angle by a potentiometer and the angular rate by a gyroscope. The bob swings
at 0.8 Hz.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
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

CREEP = 0.02  # [m/s] below which the rail's dry friction is smoothed
TURN = 0.1  # [rad/s] below which the pivot's is
PITCH = 0.1  # [m] from notch to notch of the belt
SENSOR_VARIANCE = {"position": 4e-6, "angle": 2.5e-5, "rate": 2.5e-3}
START_VARIANCE = {"position": 1.0, "velocity": 0.25, "angle": 0.04, "rate": 0.25}
TOLD_APART_BY = {
    frozenset({"cart_coulomb", "cart_drag", "force_dead_band"}): "several speeds, slow ones among them, with reversals",
    frozenset({"pivot_coulomb", "bob_drag"}): "swings from large to small, left to decay",
}


class CartEffect(Effect):
    """Force on the cart or moment about the pivot that the base model lacks."""

    def drive(self, m: Namespace, force: Number) -> Number:
        """Return the force of the motor for a commanded force."""
        return force

    def lag(self, m: Namespace, force: Number, states: Values) -> tuple[Number, Number]:
        """Return the force after the motor's lag, and the derivative of the lag's state."""
        raise NotImplementedError

    def cart(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Return an additional force on the cart [N]."""
        return 0.0

    def pivot(self, m: Namespace, rate: Number) -> Number:
        """Return an additional moment about the pivot [N m]."""
        return 0.0

    def slope(self, m: Namespace) -> Number:
        """Return the slope of the rail [rad]."""
        return 0.0


@dataclass(frozen=True, kw_only=True)
class ForceDeadBand(CartEffect):
    """Dead band of the amplifier: u − w·tanh(u/(w + 0.02))."""

    name = "force_dead_band"
    equation = "force u − w·tanh(u/(w + 0.02)) in place of u"
    width: float = parameter(0.0, unit="N", bounds=(0, 3), neutral=0.0, typical=0.2, doc="half width w of the band")

    def drive(self, m: Namespace, force: Number) -> Number:
        return force - self.width * m.tanh(force / (self.width + 0.02))


@dataclass(frozen=True, kw_only=True)
class ForceAsymmetry(CartEffect):
    """Direction-dependent force of the motor: u + a·|u|."""

    name = "force_asymmetry"
    equation = "force u + a·|u| in place of u"
    ratio: float = parameter(0.0, unit="1", bounds=(-0.5, 0.5), neutral=0.0, typical=0.03, doc="asymmetry a")

    def drive(self, m: Namespace, force: Number) -> Number:
        return force + self.ratio * m.where(force >= 0.0, force, -force)


@dataclass(frozen=True, kw_only=True)
class MotorLag(CartEffect):
    """Lag of the motor's force: τ·ḟ = u − f."""

    name = "motor_lag"
    equation = "τ·ḟ = u − f, f in place of u"
    states = (Quantity("force", "N", "force after the lag"),)
    time: float = parameter(0.0, unit="s", bounds=(0, 1), neutral=0.0, typical=0.03, doc="time constant τ; 0 = off")

    def lag(self, m: Namespace, force: Number, states: Values) -> tuple[Number, Number]:
        """Return the lagged force and its derivative; time constants below 5 ms, a quarter of a row, count as 5 ms."""
        return m.where(self.time > 0.0, states[0], force), (force - states[0]) / m.maximum(self.time, 0.005)


@dataclass(frozen=True, kw_only=True)
class CartCoulomb(CartEffect):
    """Dry friction of the rail: −F·tanh(v/0.02)."""

    name = "cart_coulomb"
    equation = "force −F·tanh(v/0.02)"
    level: float = parameter(0.0, unit="N", bounds=(0, 3), neutral=0.0, typical=0.2, doc="dry friction F")

    def cart(self, m: Namespace, position: Number, velocity: Number) -> Number:
        return -self.level * m.tanh(velocity / CREEP)


@dataclass(frozen=True, kw_only=True)
class CartDrag(CartEffect):
    """Drag of the cart: −k·|v|·v."""

    name = "cart_drag"
    equation = "force −k·|v|·v"
    coefficient: float = parameter(
        0.0, unit="N.s2/m2", bounds=(0, 10), neutral=0.0, typical=0.3, doc="drag coefficient k"
    )

    def cart(self, m: Namespace, position: Number, velocity: Number) -> Number:
        return -self.coefficient * m.where(velocity >= 0.0, velocity, -velocity) * velocity


@dataclass(frozen=True, kw_only=True)
class CableSpring(CartEffect):
    """Spring force of the supply cable towards the middle: −k·x."""

    name = "cable_spring"
    equation = "force −k·x"
    stiffness: float = parameter(0.0, unit="N/m", bounds=(0, 20), neutral=0.0, typical=0.2, doc="stiffness k")

    def cart(self, m: Namespace, position: Number, velocity: Number) -> Number:
        return -self.stiffness * position


@dataclass(frozen=True, kw_only=True)
class BeltRipple(CartEffect):
    """Notches of the belt every 0.1 m: s·sin(2πx/0.1) + c·cos(2πx/0.1)."""

    name = "belt_ripple"
    equation = "force s·sin(2πx/0.1) + c·cos(2πx/0.1)"
    sine: float = parameter(0.0, unit="N", bounds=(-3, 3), neutral=0.0, typical=0.2, doc="amplitude s")
    cosine: float = parameter(0.0, unit="N", bounds=(-3, 3), neutral=0.0, typical=0.2, doc="amplitude c")

    def cart(self, m: Namespace, position: Number, velocity: Number) -> Number:
        phase = 6.283185307179586 / PITCH * position
        return self.sine * m.sin(phase) + self.cosine * m.cos(phase)


@dataclass(frozen=True, kw_only=True)
class PivotCoulomb(CartEffect):
    """Dry friction of the pivot: −T·tanh(ω/0.1)."""

    name = "pivot_coulomb"
    equation = "moment −T·tanh(ω/0.1) about the pivot"
    level: float = parameter(0.0, unit="N.m", bounds=(0, 0.2), neutral=0.0, typical=0.005, doc="dry friction T")

    def pivot(self, m: Namespace, rate: Number) -> Number:
        return -self.level * m.tanh(rate / TURN)


@dataclass(frozen=True, kw_only=True)
class BobDrag(CartEffect):
    """Drag of the swinging bob: −k·|ω|·ω."""

    name = "bob_drag"
    equation = "moment −k·|ω|·ω about the pivot"
    coefficient: float = parameter(
        0.0, unit="N.m.s2/rad2", bounds=(0, 0.2), neutral=0.0, typical=0.003, doc="drag coefficient k"
    )

    def pivot(self, m: Namespace, rate: Number) -> Number:
        return -self.coefficient * m.where(rate >= 0.0, rate, -rate) * rate


@dataclass(frozen=True, kw_only=True)
class TrackTilt(CartEffect):
    """Tilt of the rail: gravity acts along the rail, and the rest angle of the bob changes."""

    name = "track_tilt"
    equation = "gravity turned by α about the rail"
    angle: float = parameter(0.0, unit="rad", bounds=(-0.2, 0.2), neutral=0.0, typical=0.01, doc="tilt α, uphill in +x")

    def slope(self, m: Namespace) -> Number:
        return self.angle


@dataclass(frozen=True, kw_only=True)
class PositionScale(Scale):
    """Scale error of the camera: reading s·x."""

    name = "position_scale"
    output = "position"
    value: float = parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class GyroBias(Bias):
    """Bias of the gyroscope: reading ω + b."""

    name = "gyro_bias"
    output = "rate"
    value: float = parameter(0.0, unit="rad/s", bounds=(-1, 1), neutral=0.0, typical=0.01, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class CameraLatency(Latency):
    """Latency of the camera: the position is T old."""

    name = "camera_latency"
    output = "position"
    outputs = ("position",)


@dataclass(frozen=True, kw_only=True)
class Cart(Model):
    """Cart with a bob on a rod."""

    title = "Cart with a hanging bob"
    base_states = (
        Quantity("position", "m", "position of the cart"),
        Quantity("velocity", "m/s", "its velocity"),
        Quantity("angle", "rad", "angle of the bob from hanging straight, forward positive", bounds=(-3.0, 3.0)),
        Quantity("rate", "rad/s", "its rate"),
    )
    inputs = (Quantity("force", "N", "force of the motor commanded"),)
    outputs = base_states
    catalogue = (
        ForceDeadBand, ForceAsymmetry, MotorLag, CartCoulomb, CartDrag, CableSpring, BeltRipple, PivotCoulomb, BobDrag,
        TrackTilt,
    )  # fmt: skip
    sensors = (PositionScale, GyroBias, CameraLatency)
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("velocity", "rate")
    calibrated = ("cart_mass", "bob_mass", "length", "cart_friction", "pivot_friction")
    told_apart_by = TOLD_APART_BY
    rate, substep, horizon = 0.02, 0.005, 2.0

    cart_mass: float = parameter(1.0, unit="kg", bounds=(0.05, 50), tolerance=0.05, doc="mass of cart and motor")
    bob_mass: float = parameter(0.3, unit="kg", bounds=(0.01, 10), tolerance=0.1, doc="mass of the bob")
    length: float = parameter(0.5, unit="m", bounds=(0.05, 5), tolerance=0.02, doc="from pivot to bob")
    cart_friction: float = parameter(
        2.0, unit="N.s/m", bounds=(0, 50), tolerance=0.3, doc="viscous friction of the rail"
    )
    pivot_friction: float = parameter(
        0.008, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction of the pivot"
    )
    gravity: float = parameter(9.81, unit="m/s2", bounds=(1, 30), doc="gravity")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace, with the bob on a rod of length l, α the slope of the rail.

        (M + m)·ẍ + m·l·(φ̈·cos φ − φ̇²·sin φ) = f − b·ẋ − (M + m)·g·sin α + forces on the cart
        m·l²·φ̈ + m·l·cos φ·ẍ = −m·g·l·sin(φ + α) − c·φ̇ + moments about the pivot
        """
        cart_mass, bob, length, g = self.cart_mass, self.bob_mass, self.length, self.gravity
        b, c, awake = self.cart_friction, self.pivot_friction, self.awake
        driven = overrides(awake, "drive", CartEffect)
        lagged = overrides(awake, "lag", CartEffect)
        on_cart = overrides(awake, "cart", CartEffect)
        on_pivot = overrides(awake, "pivot", CartEffect)
        alpha = sum(term.slope(m) for term in overrides(awake, "slope", CartEffect))

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity, angle, rate, *own = state
            slopes: Values = ()
            force = command[0]
            for term in driven:
                force = term.drive(m, force)
            for term in lagged:
                force, slope = term.lag(m, force, tuple(own))
                slopes = (slope,)
            force = force - b * velocity - (cart_mass + bob) * g * m.sin(alpha)
            for term in on_cart:
                force = force + term.cart(m, position, velocity)
            moment = -bob * g * length * m.sin(angle + alpha) - c * rate
            for term in on_pivot:
                moment = moment + term.pivot(m, rate)
            sin, cos = m.sin(angle), m.cos(angle)
            pull = force + bob * length * rate * rate * sin - moment * cos / length
            acceleration = pull / (cart_mass + bob * sin * sin)
            swing = (moment / (bob * length) - acceleration * cos) / length
            return velocity, acceleration, rate, swing, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state[:4])

        return Equations(derivative, output)
