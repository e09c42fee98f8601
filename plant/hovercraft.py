"""Thrust-vectoring hovercraft: parameters, quantities and equations.

Equation numbers refer to J. Jorquera Grau, "Testing Bench Design and Tilting Propeller System Identification for the
Development and Control of a Thrust-vectoring Hovercraft", SDSM&T, 2012.

Local axes: x forward, y to the right, ψ positive to the left seen from above, φ positive with the right side up. World
axes: X forward and Y left at ψ = 0, z up. Only this convention satisfies eqs 5.6-5.8.
"""

from __future__ import annotations

import math

from cosim.model import (
    SCALAR,
    Equations,
    Model,
    Namespace,
    Number,
    PlanarFrame,
    Quantity,
    Validity,
    Values,
    overrides,
    parameter,
    world_velocity,
)
from plant.effects import CATALOGUE, HovercraftEffect, Motion, bounded, frozen
from plant.powertrain import ground_effect, lag, thrust_out_of_ground, thrust_vector
from plant.sensor_errors import SENSORS

QUARTER_TURN = (-0.5 * math.pi, 0.5 * math.pi)  # [rad] range of a propeller's tilt
DUTY_FITTED = Validity("duty", ("duty_right", "duty_left"), 6.0, 7.0, "extrapolates a thrust line fitted on 6-7 %")
DUTY_NOMINAL = 6.38763  # [%], eq 4.20 solved for the T_N of eq 5.36

STATES = (
    Quantity("x", "m", "distance travelled along the craft's own axis"),
    Quantity("y", "m", "distance drifted to the craft's right"),
    Quantity("x_world", "m", "position along world X (forward at psi = 0)"),
    Quantity("y_world", "m", "position along world Y (left at psi = 0)"),
    Quantity("psi", "rad", "heading, positive to the left, continuous"),
    Quantity("vx", "m/s", "forward velocity"),
    Quantity("vy", "m/s", "velocity to the right"),
    Quantity("psi_dot", "rad/s", "yaw rate, positive to the left"),
    Quantity("phi", "rad", "roll angle, positive with the right side up"),
    Quantity("phi_dot", "rad/s", "roll rate"),
    Quantity("thrust_right", "N", "right thrust after the lag, without ground effect"),
    Quantity("thrust_left", "N", "left thrust after the lag, without ground effect"),
    Quantity("tilt_right", "rad", "right propeller tilt after the lag"),
    Quantity("tilt_left", "rad", "left propeller tilt after the lag"),
)
PSI, VX, OWN = 4, 5, len(STATES)  # indices of the heading, the forward velocity, and the effects' first state
INPUTS = (
    Quantity("duty_right", "%", "duty command of the right motor", DUTY_NOMINAL, (0.0, 100.0)),
    Quantity("duty_left", "%", "duty command of the left motor", DUTY_NOMINAL, (0.0, 100.0)),
    Quantity("tilt_right", "rad", "tilt command of the right propeller, positive forward", bounds=QUARTER_TURN),
    Quantity("tilt_left", "rad", "tilt command of the left propeller, positive forward", bounds=QUARTER_TURN),
)
OUTPUTS = (
    *STATES[:5],
    STATES[8],
    *STATES[5:8],
    STATES[9],
    Quantity("ax", "m/s2", "forward acceleration at the accelerometer: contact force / mass"),
    Quantity("thrust_right", "N", "right thrust with ground effect"),
    Quantity("thrust_left", "N", "left thrust with ground effect"),
    Quantity("tilt_right_actual", "rad", "right propeller tilt", bounds=QUARTER_TURN),
    Quantity("tilt_left_actual", "rad", "left propeller tilt", bounds=QUARTER_TURN),
)
# Measured with sensors at rest, eq 5.46; positions are those of a 1 mm tracking system.
SENSOR_VARIANCE = {"psi": 2.613e-5, "psi_dot": 4.564e-4, "ax": 0.04479} | dict.fromkeys(
    ("x", "y", "x_world", "y_world"), 1e-6
)
# The craft is released by hand: unmeasured initial speeds are known to 0.2 m/s and 0.1 rad/s.
START_VARIANCE = {q.name: {"m/s": 0.2, "rad/s": 0.1}.get(q.unit, 1.0) ** 2 for q in STATES}
MEASURED_OUTPUTS = ("psi", "psi_dot", "ax", "x_world", "y_world")  # an IMU, and a camera
# An air table of 2 m by 2 m; the thrust line was fitted on 6-7 % of duty; tilt limits as in App. G.
EXCURSION = {
    **dict.fromkeys(("duty_right", "duty_left"), 0.2),
    **dict.fromkeys(("tilt_right", "tilt_left"), math.radians(12)),
    **dict.fromkeys(("x_world", "y_world"), 0.8),
}
PLANAR = PlanarFrame(x="x_world", y="y_world", heading="psi", forward="vx", right="vy")
TOLD_APART_BY = {
    frozenset(
        {"thrust_asymmetry", "com_offset"}
    ): "tilt both propellers together and against each other, with position",
    frozenset({"actuator_delay", "actuator_second_order", "lag"}): "broadband tilt commands: steps, a chirp up to 5 Hz",
    frozenset({"coulomb_friction", "quadratic_drag", "stribeck_friction", "friction"}): "several speeds, and rest",
    frozenset({"table_tilt", "accelerometer_bias", "tilt_offset"}): "position, or turns through all headings",
    frozenset({"gyro_bias", "gyro_drift"}): "a longer log",
    frozenset({"accelerometer_bias", "accelerometer_drift"}): "a longer log",
    frozenset({"accelerometer_lever_arm", "accelerometer_bias"}): "turns at several rates",
    frozenset({"camera_latency", "actuator_delay"}): "speed, and the acceleration logged beside the position",
    frozenset({"thrust_slope", "mass", "izz"}): "the duty of both motors varied by a few tenths of a percent",
}


@frozen
class Hovercraft(Model):
    """Two tilting propellers on an air table; `equations` contains the model."""

    title = "Thrust-vectoring hovercraft"
    base_states, inputs, outputs, catalogue, sensors = STATES, INPUTS, OUTPUTS, CATALOGUE, SENSORS
    sensor_variance, start_variance = SENSOR_VARIANCE, START_VARIANCE
    forced = ("vx", "vy", "psi_dot")
    calibrated = ("mass", "izz", "friction", "lag")
    suspect = {"thrust_slope": ("duty_right", "duty_left")}  # noqa: RUF012 - a ClassVar of the base
    told_apart_by = TOLD_APART_BY
    measured, excursion, planar, valid = MEASURED_OUTPUTS, EXCURSION, PLANAR, (DUTY_FITTED,)  # eq 4.20

    mass: float = bounded(0.705, "kg", (0.05, 20), "vehicle mass, §5.2")
    izz: float = bounded(0.01023, "kg.m2", (1e-4, 1), "yaw inertia, eq 5.3")
    ixx: float = bounded(0.009377, "kg.m2", (2e-3, 1), "roll inertia, eq 5.4")
    arm: float = bounded(0.17145, "m", (0.01, 2), "lateral arm from CoM to each propeller, §5.2")
    propeller_radius: float = bounded(0.127, "m", (0.01, 1), "propeller radius, §3.5")
    height: float = bounded(0.095, "m", (0.01, 5), "propeller height over the table, §4.4")
    thrust_offset: float = bounded(-2076.0, "gf", (-1e4, 0), "thrust line at zero duty, eq 4.20")
    thrust_slope: float = bounded(359.9, "gf/%", (1, 2000), "thrust line slope, eq 4.20; fitted on 6-7 %")
    ground_effect_exponent: float = bounded(1.902, "1", (0.5, 5), "exponent of the ground effect, eq 4.28")
    lag: float = bounded(0.0884, "s", (0.005, 2), "first-order lag of thrust and tilt, eq 4.29")
    friction: float = bounded(0.25, "N.s/m", (0, 10), "viscous table friction, §5.5; sideways by our choice")
    gravity: float = bounded(9.81, "m/s2", (0.1, 30), "gravity")
    duty_nominal: float = bounded(DUTY_NOMINAL, "%", (0, 100), "duty at which the craft hovers, eqs 4.20 and 5.36")
    table_roll_stiffness: float = bounded(
        5.0, "N.m/rad", (0, 1e3), "roll stiffness of the air cushion; not in the thesis, §4.2 implies it"
    )
    table_roll_damping: float = bounded(0.45, "N.m.s/rad", (0, 4), "roll damping of the air cushion; not in the thesis")
    # Bounds keep |λ|·h of the fastest mode within the range of RK4 at 5 ms, with other parameters as declared.
    roll_ground_effect: bool = parameter(
        True, unit="", doc="ground effect of each propeller at its own height; the thesis takes one height"
    )

    def start_state(self, m: Namespace = SCALAR) -> dict[str, Number]:
        """Return the thrusts [N] at nominal duty, eq 4.20, as start values."""
        thrust = thrust_out_of_ground(m, self.duty_nominal, self.thrust_offset, self.thrust_slope, self.gravity)
        return {"thrust_right": thrust, "thrust_left": thrust}

    def start_input(self) -> dict[str, Number]:
        """Return the nominal duties [%], with which the craft hovers, as start values."""
        return {"duty_right": self.duty_nominal, "duty_left": self.duty_nominal}

    def equations(self, m: Namespace) -> Equations:
        """Return the equations, computed by the functions of a namespace.

        Power-train (eqs 4.20, 4.28, 4.29), right/left i ∈ {R, L}:
            τ·Ṫ_i = T_OGE(δ_i) − T_i
            τ·α̇_i = α_i,cmd − α_i
            F_ix = T_i·Γ(z_i)·sin α_i,  F_iz = T_i·Γ(z_i)·cos α_i,  z_R/L = z ± L·sin φ
        Rigid body (eqs 5.9-5.14; roll support and −c·vy are ours):
            m·v̇x = F_Rx + F_Lx − c·vx
            m·v̇y = −(F_Rz + F_Lz)·sin φ − c·vy
            Izz·ψ̈ = L·(F_Rx − F_Lx)
            Ixx·φ̈ = L·(F_Rz − F_Lz) − k_t·φ − d_t·φ̇
        Output: a_x = contact force forward / m. Effects add to tilt rate, thrust, wrench and acceleration.
        """
        mass, izz, ixx, arm, tau, c = self.mass, self.izz, self.ixx, self.arm, self.lag, self.friction
        z, radius, exponent = self.height, self.propeller_radius, self.ground_effect_exponent
        offset, slope, g = self.thrust_offset, self.thrust_slope, self.gravity
        k_t, d_t, own_height = self.table_roll_stiffness, self.table_roll_damping, self.roll_ground_effect
        hooks = ("tilt_rate", "thrust_factor", "wrench", "acceleration")
        tilt_terms, thrust_terms, wrench_terms, acceleration_terms = (
            overrides(self.awake, hook, HovercraftEffect) for hook in hooks
        )

        def thrusts(t: Number, vx: Number, phi: Number, right: Number, left: Number) -> tuple[Number, Number]:
            """Return both thrusts [N] with ground effect."""
            if own_height:
                rise = arm * m.sin(phi)
                right = right * ground_effect(m, z + rise, radius, exponent)
                left = left * ground_effect(m, z - rise, radius, exponent)
            else:
                gain = ground_effect(m, z, radius, exponent)
                right, left = right * gain, left * gain
            for term in thrust_terms:
                factor_right, factor_left = term.thrust_factor(m, t, vx)
                right, left = right * factor_right, left * factor_left
            return right, left

        def contact(t: Number, state: Values) -> tuple[Number, Number, Number, Number]:
            """Return the forces that the accelerometer senses [N], and yaw and roll moments [N m]."""
            vx, vy, psi_dot, phi, phi_dot, thrust_right, thrust_left, tilt_right, tilt_left = state[VX:OWN]
            right, left = thrusts(t, vx, phi, thrust_right, thrust_left)
            right_x, right_z = thrust_vector(m, right, tilt_right)
            left_x, left_z = thrust_vector(m, left, tilt_left)
            forward = right_x + left_x - c * vx
            rightward = -(right_z + left_z) * m.sin(phi) - c * vy
            yaw = arm * (right_x - left_x)
            roll = arm * (right_z - left_z) - k_t * phi - d_t * phi_dot
            if wrench_terms:
                motion = Motion(vx, vy, psi_dot, right_x + left_x, right_z + left_z)
                for term in wrench_terms:
                    d_forward, d_rightward, d_yaw, d_roll = term.wrench(m, motion)
                    forward, rightward = forward + d_forward, rightward + d_rightward
                    yaw, roll = yaw + d_yaw, roll + d_roll
            return forward, rightward, yaw, roll

        def derivative(t: Number, state: Values, command: Values) -> Values:
            psi, vx, vy, psi_dot, _, phi_dot, thrust_right, thrust_left, right, left = state[PSI:OWN]
            duty_right, duty_left, tilt_right, tilt_left = command
            forward, rightward, yaw, roll = contact(t, state)
            ax, ay = forward / mass, rightward / mass
            for term in acceleration_terms:
                d_ax, d_ay = term.acceleration(m, g, psi, vx, vy, psi_dot)
                ax, ay = ax + d_ax, ay + d_ay
            rate, extra, own = (lag(tilt_right, right, tau), lag(tilt_left, left, tau)), (), state[OWN:]
            for term in tilt_terms:  # only these effects have states of their own
                rate, more = term.tilt_rate(m, rate, (tilt_right, tilt_left), (right, left), own[: len(term.states)])
                extra, own = (*extra, *more), own[len(more) :]
            return (
                vx,
                vy,
                *world_velocity(m, psi, vx, vy),
                psi_dot,
                ax,
                ay,
                yaw / izz,
                phi_dot,
                roll / ixx,
                lag(thrust_out_of_ground(m, duty_right, offset, slope, g), thrust_right, tau),
                lag(thrust_out_of_ground(m, duty_left, offset, slope, g), thrust_left, tau),
                *rate,
                *extra,
            )

        def output(t: Number, state: Values, command: Values) -> Values:
            vx, vy, psi_dot, phi, phi_dot, thrust_right, thrust_left, tilt_right, tilt_left = state[VX:OWN]
            ax = contact(t, state)[0] / mass
            right, left = thrusts(t, vx, phi, thrust_right, thrust_left)
            return (*state[:VX], phi, vx, vy, psi_dot, phi_dot, ax, right, left, tilt_right, tilt_left)

        return Equations(derivative, output)
