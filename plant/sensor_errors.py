"""Sensor errors of the hovercraft, which act on the measurement and not on the plant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cosim.model import Bias, Drift, Latency, LeverArm, Namespace, Number, Scale, SensorError, Values, parameter, size

HOVER_THRUST = 2.4973  # [N], T_N of eq 5.36


def centripetal(error: LeverArm, m: Namespace, psi_dot: Number) -> Values:
    """Return the centripetal part −ψ̇² of a_P = a + ψ̈×r + ψ̇×(ψ̇×r), for a sensor 1 m ahead of the centre of mass."""
    return (-psi_dot * psi_dot,)


def disturbed_heading(error: Any, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
    """Return the heading with an error by the motors (§5.2), zero at hover: ψ + k·(T_R + T_L − 2·T_N).

    Motor current is assumed to follow the thrust, a + b·δ after the lag (4.20), so that the error is linear in the
    duty.
    """
    beyond_hover = outputs["thrust_right"] + outputs["thrust_left"] - 2.0 * HOVER_THRUST
    return outputs["psi"] + error.value * beyond_hover


AccelerometerLeverArm = LeverArm.named(
    "accelerometer_lever_arm", equation="reading a_x − l·ψ̇²", output="ax", others=("psi_dot",), carried=centripetal
)
AccelerometerScale = Scale.named(
    "accelerometer_scale",
    equation="reading s·a_x",
    output="ax",
    value=parameter(1.0, unit="1", bounds=(0.3, 3), neutral=1.0, typical=0.1, doc="scale s"),
)
AccelerometerBias = Bias.named(
    "accelerometer_bias", equation="reading a_x + b", output="ax", value=size("m/s2", (-2, 2), 0.05, "bias b")
)
AccelerometerDrift = Drift.named(
    "accelerometer_drift", equation="reading a_x + d·t", output="ax", value=size("m/s3", (-0.2, 0.2), 5e-3, "drift d")
)
GyroBias = Bias.named(
    "gyro_bias", equation="reading ψ̇ + b", output="psi_dot", value=size("rad/s", (-0.5, 0.5), 0.01, "bias b")
)
GyroDrift = Drift.named(
    "gyro_drift", equation="reading ψ̇ + d·t", output="psi_dot", value=size("rad/s2", (-0.05, 0.05), 1e-3, "drift d")
)
MagnetometerDisturbance = SensorError.named(
    "magnetometer_disturbance",
    equation="reading ψ + k·(T_R + T_L − 2·T_N)",
    output="psi",
    value=size("rad/N", (-0.5, 0.5), 0.02, "heading error k a newton of thrust"),
    read=disturbed_heading,
)
CameraLatency = Latency.named("camera_latency", equation="readings X(t − T), Y(t − T)", outputs=("x_world", "y_world"))

# order in which they act: lever arm before scale, scale before bias
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
