"""Sensor errors of the hovercraft, which act on the measurement and not on the plant."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.model import (
    Bias,
    Drift,
    Latency,
    LeverArm,
    Namespace,
    Number,
    Scale,
    SensorError,
    Values,
    parameter,
)
from plant.effects import frozen, off_at_zero

HOVER_THRUST = 2.4973  # [N], T_N of eq 5.36


@frozen
class AccelerometerBias(Bias):
    """Accelerometer bias: reading a_x + b."""

    name = "accelerometer_bias"
    equation = "reading a_x + b"
    output = "ax"

    value: float = off_at_zero("m/s2", (-2, 2), 0.05, "bias b")


@frozen
class AccelerometerScale(Scale):
    """Accelerometer scale error: reading s·a_x."""

    name = "accelerometer_scale"
    equation = "reading s·a_x"
    output = "ax"

    value: float = parameter(1.0, unit="1", bounds=(0.3, 3), neutral=1.0, typical=0.1, doc="scale s")


@frozen
class GyroBias(Bias):
    """Gyroscope bias: reading ψ̇ + b."""

    name = "gyro_bias"
    equation = "reading ψ̇ + b"
    output = "psi_dot"

    value: float = off_at_zero("rad/s", (-0.5, 0.5), 0.01, "bias b")


@frozen
class AccelerometerLeverArm(LeverArm):
    """Accelerometer mounted l ahead of the centre of mass.

    Its reading has the centripetal part of a_P = a + ψ̈×r + ψ̇×(ψ̇×r).
    """

    name = "accelerometer_lever_arm"
    equation = "reading a_x − l·ψ̇²"
    output, others = "ax", ("psi_dot",)

    def carried(self, m: Namespace, *others: Number) -> Values:
        """Return the centripetal part −ψ̇²."""
        (psi_dot,) = others
        return (-psi_dot * psi_dot,)


@frozen
class AccelerometerDrift(Drift):
    """Accelerometer drift: reading a_x + d·t."""

    name = "accelerometer_drift"
    equation = "reading a_x + d·t"
    output = "ax"

    value: float = off_at_zero("m/s3", (-0.2, 0.2), 5e-3, "drift d")


@frozen
class GyroDrift(Drift):
    """Gyroscope drift: reading ψ̇ + d·t."""

    name = "gyro_drift"
    equation = "reading ψ̇ + d·t"
    output = "psi_dot"

    value: float = off_at_zero("rad/s2", (-0.05, 0.05), 1e-3, "drift d")


@frozen
class CameraLatency(Latency):
    """Camera latency T: positions at t are those of t − T."""

    name = "camera_latency"
    equation = "readings X(t − T), Y(t − T)"
    outputs = ("x_world", "y_world")


@frozen
class MagnetometerDisturbance(SensorError):
    """Magnetometer disturbance by the motors (§5.2): a heading error proportional to their duty, zero at hover.

    Motor current follows the thrust, a + b·δ after the lag (4.20), so the error is linear in the duty.
    """

    name = "magnetometer_disturbance"
    equation = "reading ψ + k·(T_R + T_L − 2·T_N)"
    output = "psi"

    value: float = off_at_zero("rad/N", (-0.5, 0.5), 0.02, "heading error k a newton of thrust")

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Return the heading with the error by the thrust: ψ + k·(T_R + T_L − 2·T_N)."""
        beyond_hover = outputs["thrust_right"] + outputs["thrust_left"] - 2.0 * HOVER_THRUST
        return outputs["psi"] + self.value * beyond_hover


# Order of action: a lever arm before a scale, a scale before a bias.
SENSORS = (
    AccelerometerLeverArm,
    AccelerometerScale,
    AccelerometerBias,
    AccelerometerDrift,
    GyroBias,
    GyroDrift,
    MagnetometerDisturbance,
    CameraLatency,
)
