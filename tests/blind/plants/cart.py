"""Cart on a rail with a hanging bob, like a small crane, driven in open loop by a motor.

Measured are the position by a camera, the angle by a potentiometer and the angular rate by a gyroscope. The bob swings
at 0.8 Hz.
"""

from dataclasses import dataclass

from cosim.model import (
    Asymmetry,
    Bias,
    DryFriction,
    Equations,
    FirstOrderLag,
    Latency,
    LocalEffect,
    Model,
    Namespace,
    Number,
    QuadraticDrag,
    Quantity,
    Scale,
    Values,
    parameter,
    size,
)

NOTCHES = 6.283185307179586 / 0.1  # [rad/m] notches of the belt, 0.1 m apart
SENSOR_VARIANCE = {"position": 4e-6, "angle": 2.5e-5, "rate": 2.5e-3}
START_VARIANCE = {"position": 1.0, "velocity": 0.25, "angle": 0.04, "rate": 0.25}


CATALOGUE = (
    LocalEffect.named(
        "force_dead_band", place="motor", equation="force u − w·tanh(u/(w + 0.02)) in place of u",
        width=size("N", (0, 3), 0.2, "half width w of the band"),
        change=lambda e, m, force: force - e.width * m.tanh(force / (e.width + 0.02)),
    ),
    Asymmetry.named("force_asymmetry", place="motor", ratio=size("1", (-0.5, 0.5), 0.03, "asymmetry a")),
    FirstOrderLag.named(  # a quarter of a row at least
        "motor_lag", place="motor", shortest=0.005, states=(Quantity("force", "N", "force after the lag"),),
        time=size("s", (0, 1), 0.03, "time constant τ; 0 = off"),
    ),
    DryFriction.named("cart_coulomb", place="cart", softness=0.02, level=size("N", (0, 3), 0.2, "dry friction")),
    QuadraticDrag.named("cart_drag", place="cart", coefficient=size("N.s2/m2", (0, 10), 0.3, "drag coefficient")),
    LocalEffect.named(
        "cable_spring", place="cart", equation="force −k·x of the supply cable",
        stiffness=size("N/m", (0, 20), 0.2, "stiffness k"), change=lambda e, m, force, v, x: force - e.stiffness * x,
    ),
    LocalEffect.named(
        "belt_ripple", place="cart", equation="force s·sin(2πx/0.1) + c·cos(2πx/0.1)",
        sine=size("N", (-3, 3), 0.2, "amplitude s"), cosine=size("N", (-3, 3), 0.2, "amplitude c"),
        change=lambda e, m, force, v, x: force + e.sine * m.sin(NOTCHES * x) + e.cosine * m.cos(NOTCHES * x),
    ),
    DryFriction.named("pivot_coulomb", place="pivot", softness=0.1, level=size("N.m", (0, 0.2), 0.005, "dry friction")),
    QuadraticDrag.named(
        "bob_drag", place="pivot", coefficient=size("N.m.s2/rad2", (0, 0.2), 0.003, "drag coefficient")
    ),
    LocalEffect.named(
        "track_tilt", place="slope", equation="gravity turned by α about the rail",
        angle=size("rad", (-0.2, 0.2), 0.01, "tilt α, uphill in +x"), change=lambda e, m, slope: slope + e.angle,
    ),
)  # fmt: skip
SENSORS = (
    Scale.named(
        "position_scale", output="position",
        value=parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s"),
    ),
    Bias.named("gyro_bias", output="rate", value=size("rad/s", (-1, 1), 0.01, "bias b")),
    Latency.named("camera_latency", outputs=("position",)),
)  # fmt: skip


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
    catalogue, sensors, places = CATALOGUE, SENSORS, ("motor", "cart", "pivot", "slope")
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("velocity", "rate")
    calibrated = ("cart_mass", "bob_mass", "length", "cart_friction", "pivot_friction")
    rate, substep, horizon = 0.02, 0.005, 2.0

    cart_mass: float = parameter(1.0, unit="kg", bounds=(0.05, 50), tolerance=0.05, doc="mass of cart and motor")
    bob_mass: float = parameter(0.3, unit="kg", bounds=(0.01, 10), tolerance=0.1, doc="mass of the bob")
    length: float = parameter(0.5, unit="m", bounds=(0.05, 5), tolerance=0.02, doc="from pivot to bob")
    cart_friction: float = parameter(2.0, unit="N.s/m", bounds=(0, 50), tolerance=0.3, doc="viscous friction, rail")
    pivot_friction: float = parameter(
        0.008, unit="N.m.s/rad", bounds=(0, 1), tolerance=0.3, doc="viscous friction, pivot"
    )
    gravity: float = parameter(9.81, unit="m/s2", bounds=(1, 30), doc="gravity")

    def equations(self, m: Namespace) -> Equations:
        """Bind the equations to a namespace, with the bob on a rod of length l, α the slope of the rail.

        (M + m)·ẍ + m·l·(φ̈·cos φ − φ̇²·sin φ) = f − b·ẋ − (M + m)·g·sin α + forces on the cart
        m·l²·φ̈ + m·l·cos φ·ẍ = −m·g·l·sin(φ + α) − c·φ̇ + moments about the pivot
        """
        cart_mass, bob, length, g, at = self.cart_mass, self.bob_mass, self.length, self.gravity, self.effects_at(m)
        alpha = at("slope", 0.0)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            position, velocity, angle, rate, *own = state
            (force,), slopes = self.lag_at(m, "motor", (at("motor", command[0]),), tuple(own))
            force = force - self.cart_friction * velocity - (cart_mass + bob) * g * m.sin(alpha)
            force = at("cart", force, velocity, position)
            moment = at("pivot", -bob * g * length * m.sin(angle + alpha) - self.pivot_friction * rate, rate)
            sin, cos = m.sin(angle), m.cos(angle)
            pull = force + bob * length * rate * rate * sin - moment * cos / length
            acceleration = pull / (cart_mass + bob * sin * sin)
            swing = (moment / (bob * length) - acceleration * cos) / length
            return velocity, acceleration, rate, swing, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            return tuple(state[:4])

        return Equations(derivative, output)
