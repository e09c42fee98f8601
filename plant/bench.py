"""Testing bench: one tilting propeller on three load cells, with converter and low pass (thesis ch. 3).

Equation numbers, sections and appendices refer to J. Jorquera Grau, SDSM&T, 2012. The power-train is that of the craft
(`plant/powertrain.py`); dead band and rate limit of the servo, load cells and readings are added here.
"""

from __future__ import annotations

import math

from cosim.model import (
    SCALAR,
    Delay,
    Equations,
    Model,
    Namespace,
    Number,
    Quantity,
    Values,
    parameter,
)
from plant.effects import ActuatorSecondOrder, bounded, frozen
from plant.powertrain import (
    assembly_moment,
    ground_effect,
    lag,
    second_order,
    servo_angle,
    servo_error,
    servo_rate,
    thrust_out_of_ground,
    thrust_vector,
)

REST_DUTY, NEUTRAL_DUTY, FREE_HEIGHT = 5.0, 7.5, 10.0  # [%, %, m], App. D.2: motor off, upright, no ground below
FASTEST_FILTER = 0.005  # [s] smallest time constant of the low pass that the integration can follow
CHANNELS = ("z", "x", "m")

STATES = (
    Quantity("thrust", "N", "thrust after the lag, without ground effect"),
    Quantity("tilt", "rad", "tilt angle after dead band, rate and lag"),
    *(Quantity(f"filtered_{c}", "V", f"voltage of cell {c} after the low pass") for c in CHANNELS),
)
INPUTS = (
    Quantity("duty", "%", "duty of the speed controller", REST_DUTY, (0.0, 100.0)),
    Quantity("servo_duty", "%", "duty of the servo", NEUTRAL_DUTY, (0.0, 100.0)),
    Quantity("height", "m", "height of the propeller over the ground", FREE_HEIGHT, (0.0, math.inf)),
    Quantity("load_z", "N", "load hung at the hub for calibration, vertical"),
    Quantity("load_x", "N", "load hung at the hub for calibration, horizontal"),
    Quantity("load_m", "N.m", "moment about the tilting axis for calibration"),
    *(Quantity(f"noise_{c}", "V", f"voltage added to cell {c} before it is converted") for c in CHANNELS),
)
OUTPUTS = (
    *(Quantity(f"volts_{c}", "V", f"voltage of cell {c}, converted and low-passed") for c in CHANNELS),
    Quantity("force_z", "N", "vertical force on the bench"),
    Quantity("force_x", "N", "horizontal force on the bench"),
    Quantity("moment", "N.m", "moment about the tilting axis"),
    Quantity("tilt_actual", "rad", "tilt angle"),
    Quantity("thrust_actual", "N", "thrust, with ground effect"),
)
EFFECT_STATE = len(STATES)  # index of the state of an effect


DELAYED_INPUTS = tuple(
    Quantity(q.name, q.unit, f"{q.name} that acts until the delay has passed", q.start) for q in INPUTS
)
BenchDelay = Delay.named("actuator_delay", memory=DELAYED_INPUTS)  # of all commands, like that of the craft
BenchSecondOrder = ActuatorSecondOrder.named(  # §4.5.4, as of the craft
    "actuator_second_order",
    equation="α̈ = ωₙ²·e − 2ζωₙ·α̇ in place of the first-order tilt lag, e the error beyond the dead band",
    states=(Quantity("tilt_rate", "rad/s", "rate of the tilt"),),
)


@frozen
class Bench(Model):
    """Testing bench: one power-train on three load cells, calibrated at the hub (§3.5); see `equations`."""

    title = "Testing bench of a tilting propeller"
    base_states, inputs, outputs = STATES, INPUTS, OUTPUTS
    substep = 0.01  # [s]
    horizon = math.inf
    catalogue = (BenchDelay, BenchSecondOrder)
    sensor_variance = {"force_z": 1e-4, "force_x": 4e-4}  # noqa: RUF012 - a ClassVar of the base; §3.4, App. B.1
    measured = ("force_z", "force_x")
    forced = ("thrust", "tilt")
    calibrated = ("lag", "thrust_factor")

    thrust_offset: float = bounded(-2076.0, "gf", (-1e4, 0), "thrust line at zero duty, eq 4.20")
    thrust_slope: float = bounded(359.9, "gf/%", (1, 2000), "thrust line slope, eq 4.20")
    thrust_factor: float = bounded(1.0, "1", (0.1, 10), "factor on the thrust, by the battery's state")
    ground_effect_exponent: float = bounded(1.902, "1", (0.5, 5), "exponent of the ground effect, eq 4.28")
    propeller_radius: float = bounded(0.127, "m", (0.01, 1), "propeller radius, §3.5")
    lag: float = bounded(0.0884, "s", (0.005, 2), "first-order lag of thrust and tilt, eq 4.29")
    assembly_mass: float = bounded(0.145, "kg", (0.001, 10), "mass of the propeller assembly, §5.2")
    assembly_arm: float = bounded(-1.170e-4, "m", (-0.1, 0.1), "tilting axis to the assembly's centre of mass, §4.5.5")
    gravity: float = bounded(9.81, "m/s2", (0.1, 30), "gravity")
    servo_neutral: float = bounded(7.5, "%", (0, 100), "duty of the servo upright, eq 3.1")
    servo_slope: float = bounded(0.3927, "rad/%", (-10, 10), "angle per duty of the servo, eq 3.1")
    servo_dead_band: float = bounded(
        0.04 * 0.3927, "rad", (0, 0.5), "total width of the servo's dead band, 8 µs, App. B.2"
    )
    servo_speed: float = bounded(math.radians(60) / 0.14, "rad/s", (0.1, 100), "fastest tilt, 0.14 s for 60°, App. B.2")
    z_zero: float = parameter(3.25, unit="V", doc="vertical cell without load; 3.3 V, the rail, in Table C.1")
    z_slope: float = parameter(-0.853, unit="V/N", doc="linear coefficient of the vertical cell (thesis, Table C.1)")
    z_square: float = parameter(
        -0.1107, unit="V/N2", doc="quadratic coefficient of the vertical cell: 0 V at 285 gf as in Table C.1"
    )
    z_cube: float = parameter(0.0, unit="V/N3", doc="cubic coefficient of the vertical cell")
    x_zero: float = parameter(2.43, unit="V", doc="horizontal cell without load (thesis, Table C.1)")
    x_slope: float = parameter(-0.5602, unit="V/N", doc="linear coefficient of the horizontal cell (thesis, Table C.1)")
    x_square: float = parameter(
        -0.0021, unit="V/N2", doc="quadratic coefficient of the horizontal cell (thesis, Table C.1)"
    )
    x_cube: float = parameter(0.0, unit="V/N3", doc="cubic coefficient of the horizontal cell")
    m_zero: float = parameter(1.718, unit="V", doc="cell of the torquemeter without load (thesis, Table C.2)")
    m_slope: float = parameter(
        -48.32, unit="V/N.m", doc="linear coefficient of the cell of the torquemeter (thesis, Table C.2)"
    )
    m_square: float = parameter(
        232.0, unit="V/N2.m2", doc="quadratic coefficient of the cell of the torquemeter (thesis, Table C.2)"
    )
    m_cube: float = parameter(
        7630.0, unit="V/N3.m3", doc="cubic coefficient of the cell of the torquemeter (thesis, Table C.2)"
    )
    converter_range: float = bounded(3.3, "V", (0.1, 100), "largest voltage converted, §3.4")
    converter_levels: float = bounded(4095.0, "1", (1, 1e9), "steps of the converter: 12 bit, §3.4")
    filter_time: float = bounded(0.0, "s", (0, 10), "time constant of the low pass, App. D.2; 0 = off")

    def equations(self, m: Namespace) -> Equations:
        """Return the equations of forces, voltages and lags.

        F_z = T·Γ(z)·cos α + load, F_x = T·Γ(z)·sin α + load (4.7, 4.8), M = m_PA·g·l·sin α + load (4.10)
        v   = clip(v₀ + s·F + q·F² + c·F³ + noise, 0, range), in whole steps of the converter
        τ·Ṫ = T_OGE(δ) − T (4.9), T_f·v̇_f = v − v_f with a low pass
        α̇: `servo_rate`, modified by effects
        """

        def forces(state: Values, command: Values) -> tuple[Number, Number, Number]:
            thrust, tilt = state[:2]
            height, load_z, load_x, load_m = command[2:6]
            total = thrust * ground_effect(m, height, self.propeller_radius, self.ground_effect_exponent)
            x, z = thrust_vector(m, total, tilt)
            moment = assembly_moment(m, tilt, self.assembly_mass, self.gravity, self.assembly_arm)
            return z + load_z, x + load_x, moment + load_m

        curves = [[getattr(self, f"{c}_{power}") for power in ("zero", "slope", "square", "cube")] for c in CHANNELS]
        overshoot = next((e for e in self.awake if isinstance(e, BenchSecondOrder)), None)

        def converted(state: Values, command: Values) -> Values:
            step = self.converter_range / self.converter_levels
            volts = []
            for f, (zero, slope, square, cube), noise in zip(forces(state, command), curves, command[6:9], strict=True):
                v = zero + f * (slope + f * (square + f * cube)) + noise
                volts.append(step * m.rint(m.clip(v, 0.0, self.converter_range) / step))
            return tuple(volts)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            duty, servo_duty = command[:2]
            steady = self.thrust_factor * thrust_out_of_ground(
                m, duty, self.thrust_offset, self.thrust_slope, self.gravity
            )
            target = servo_angle(servo_duty, self.servo_neutral, self.servo_slope)
            slow = m.maximum(self.filter_time, FASTEST_FILTER)
            filtered = (lag(v, f, slow) for v, f in zip(converted(state, command), state[2:EFFECT_STATE], strict=True))
            rate = servo_rate(m, target, state[1], self.lag, self.servo_dead_band, self.servo_speed)
            own: Values = ()  # acceleration of the tilt, for an actuator of second order
            if overshoot is not None:
                w, error = overshoot.natural_frequency, servo_error(m, target, state[1], self.servo_dead_band)
                rate = m.clip(m.where(w > 0.0, state[EFFECT_STATE], rate), -self.servo_speed, self.servo_speed)
                own = (second_order(error, 0.0, state[EFFECT_STATE], w, overshoot.damping_ratio),)
            return (lag(steady, state[0], self.lag), rate, *filtered, *own)

        def output(t: Number, state: Values, command: Values) -> Values:
            z, x, moment = forces(state, command)
            volts = converted(state, command)
            read = (m.where(self.filter_time > 0.0, f, v) for v, f in zip(volts, state[2:EFFECT_STATE], strict=True))
            gain = ground_effect(m, command[2], self.propeller_radius, self.ground_effect_exponent)
            return (*read, z, x, moment, state[1], state[0] * gain)

        return Equations(derivative, output)

    def start_state(self, m: Namespace = SCALAR) -> dict[str, Number]:
        """Return start values with which the low passes are in equilibrium at the voltages of unloaded cells."""
        return {f"filtered_{c}": getattr(self, f"{c}_zero") for c in CHANNELS}
