"""Quarter car on a shaker: body, suspension, wheel, tyre, and a hydraulic table.

Heights are relative to the car at rest. Measured are the travel of the suspension, the acceleration of the body and its
height by a laser. The body bounces at 1.2 Hz, the wheel hops at 11 Hz.
"""

from dataclasses import dataclass

from cosim.model import (
    Bias,
    Delay,
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

STOP = 0.025  # [m] of travel at which the bump stop is met
SENSOR_VARIANCE = {"travel": 1e-6, "body_acceleration": 0.04, "body_height": 4e-6}
START_VARIANCE = {
    "body_height": 1e-4,
    "body_speed": 0.01,
    "wheel_height": 1e-4,
    "wheel_speed": 0.01,
    "table_height": 1e-4,
}


def bump_stop(e: LocalEffect, m: Namespace, force: Number, travel: Number) -> Number:
    """Return the force of the spring with a rubber buffer: k·max(z − 0.025, 0)²."""
    pressed = m.maximum(travel - STOP, 0.0)
    return force + e.stiffness * pressed * pressed


# forces of the damper push body and wheel apart, against the closing of the suspension
CATALOGUE = (
    Delay.named("command_delay", memory=(Quantity("road", "m", "height that acts until the delay has passed"),)),
    LocalEffect.named(
        "road_gain", place="table", equation="(1 + g)·u in place of u",
        gain=size("1", (-0.5, 0.5), 0.03, "excess gain g"), change=lambda e, m, height: (1.0 + e.gain) * height,
    ),
    LocalEffect.named(
        "damper_asymmetry", place="damper", equation="damper force −a·|v| beside c·v, softer in closing",
        coefficient=size("N.s/m", (-1000, 1000), 100.0, "asymmetry a"),
        change=lambda e, m, force, v: force + e.coefficient * m.where(v >= 0.0, v, -v),
    ),
    DryFriction.named("damper_coulomb", place="damper", softness=0.02, level=size("N", (0, 300), 20.0, "dry friction")),
    QuadraticDrag.named(
        "damper_progression", place="damper", coefficient=size("N.s2/m2", (0, 3000), 200.0, "progression")
    ),
    FirstOrderLag.named(  # of the damper's force in a rubber mount; half a row at least
        "damper_mount", place="damper", shortest=0.0025,
        states=(Quantity("force", "N", "force of the damper after its mount"),),
        time=size("s", (0, 0.2), 0.008, "time constant τ; 0 = off"),
    ),
    LocalEffect.named(
        "cubic_spring", place="spring", equation="spring force k₃·z³ beside k·z",
        stiffness=size("N/m3", (0, 1e8), 2e6, "cubic stiffness k₃"),
        change=lambda e, m, force, travel: force + e.stiffness * travel * travel * travel,
    ),
    LocalEffect.named(
        "bump_stop", place="spring", equation="spring force k·max(z − 0.025, 0)² beside k·z",
        stiffness=size("N/m2", (0, 1e8), 5e5, "stiffness k"), change=bump_stop,
    ),
    LocalEffect.named(
        "tyre_damping", place="tyre", equation="tyre force d·v beside k·deflection",
        coefficient=size("N.s/m", (0, 2000), 80.0, "damping d"),
        change=lambda e, m, force, v: force + e.coefficient * v,
    ),
    LocalEffect.named(
        "preload", place="body", equation="force f on the body", force=size("N", (-500, 500), 20.0, "force f, upward"),
        change=lambda e, m, force: force + e.force,
    ),
)  # fmt: skip
SENSORS = (
    Scale.named(
        "travel_scale", output="travel",
        value=parameter(1.0, unit="1", bounds=(0.5, 2), neutral=1.0, typical=0.03, doc="scale s"),
    ),
    Bias.named("accelerometer_bias", output="body_acceleration", value=size("m/s2", (-2, 2), 0.05, "bias b")),
    Latency.named("laser_latency", outputs=("body_height",)),
)  # fmt: skip


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
    catalogue, sensors, places = CATALOGUE, SENSORS, ("table", "damper", "spring", "tyre", "body")
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("body_speed", "wheel_speed")
    calibrated = ("body_mass", "wheel_mass", "spring", "damping", "tyre", "table_lag")
    rate, substep, horizon = 0.005, 0.00125, 1.0

    body_mass: float = parameter(300.0, unit="kg", bounds=(10, 5000), tolerance=0.05, doc="mass of the body, weighed")
    wheel_mass: float = parameter(40.0, unit="kg", bounds=(1, 500), tolerance=0.1, doc="mass of wheel and axle")
    spring: float = parameter(18000.0, unit="N/m", bounds=(1000, 1e6), tolerance=0.05, doc="stiffness of the spring")
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
        at = self.effects_at(m)

        def suspension(state: Values) -> tuple[Number, Values]:
            """Return the force of spring and damper on the body, and the derivatives of the effects' states."""
            height, speed, wheel_height, wheel_speed, _, *own = state
            travel, closing = wheel_height - height, wheel_speed - speed
            damper = -at("damper", -self.damping * closing, closing)
            (damper,), slopes = self.lag_at(m, "damper", (damper,), tuple(own))
            return at("spring", damper + self.spring * travel, travel), slopes

        def derivative(t: Number, state: Values, command: Values) -> Values:
            _, speed, wheel_height, wheel_speed, table_height, *_ = state
            table_speed = (at("table", command[0]) - table_height) / self.table_lag
            force, slopes = suspension(state)
            tyre = at("tyre", self.tyre * (table_height - wheel_height), table_speed - wheel_speed)
            rise = at("body", force) / self.body_mass
            return speed, rise, wheel_speed, (tyre - force) / self.wheel_mass, table_speed, *slopes

        def output(t: Number, state: Values, command: Values) -> Values:
            force, _ = suspension(state)
            return state[0], state[2], state[2] - state[0], at("body", force) / self.body_mass

        return Equations(derivative, output)
