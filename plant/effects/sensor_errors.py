"""Errors of the sensors: on the measurement, not in the plant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cosim.model import Bias, Drift, Latency, LeverArm, Namespace, Number, Scale, SensorError, Values, parameter

HOVER_THRUST = 2.4973  # [N], T_N of eq 5.36


@dataclass(frozen=True, kw_only=True)
class AccelerometerBias(Bias):
    """The accelerometer reads a_x + b."""

    name = "accelerometer_bias"
    equation = "reading a_x + b"
    output = "ax"

    value: float = parameter(0.0, unit="m/s2", bounds=(-2, 2), neutral=0.0, typical=0.05, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class AccelerometerScale(Scale):
    """The accelerometer reads s·a_x."""

    name = "accelerometer_scale"
    equation = "reading s·a_x"
    output = "ax"

    value: float = parameter(1.0, unit="1", bounds=(0.3, 3), neutral=1.0, typical=0.1, doc="scale s")


@dataclass(frozen=True, kw_only=True)
class GyroBias(Bias):
    """The gyroscope reads ψ̇ + b."""

    name = "gyro_bias"
    equation = "reading ψ̇ + b"
    output = "psi_dot"

    value: float = parameter(0.0, unit="rad/s", bounds=(-0.5, 0.5), neutral=0.0, typical=0.01, doc="bias b")


@dataclass(frozen=True, kw_only=True)
class AccelerometerLeverArm(LeverArm):
    """The accelerometer sits l ahead of the CoM and reads what a turn presses out of a_P = a + ψ̈×r + ψ̇×(ψ̇×r)."""

    name = "accelerometer_lever_arm"
    equation = "reading a_x − l·ψ̇²"
    output, others = "ax", ("psi_dot",)

    def carried(self, m: Namespace, *others: Number) -> Values:
        (psi_dot,) = others
        return (-psi_dot * psi_dot,)


@dataclass(frozen=True, kw_only=True)
class AccelerometerDrift(Drift):
    """The accelerometer reads a_x + d·t."""

    name = "accelerometer_drift"
    equation = "reading a_x + d·t"
    output = "ax"

    value: float = parameter(0.0, unit="m/s3", bounds=(-0.2, 0.2), neutral=0.0, typical=5e-3, doc="drift d")


@dataclass(frozen=True, kw_only=True)
class GyroDrift(Drift):
    """The gyroscope reads ψ̇ + d·t."""

    name = "gyro_drift"
    equation = "reading ψ̇ + d·t"
    output = "psi_dot"

    value: float = parameter(0.0, unit="rad/s2", bounds=(-0.05, 0.05), neutral=0.0, typical=1e-3, doc="drift d")


@dataclass(frozen=True, kw_only=True)
class CameraLatency(Latency):
    """The camera's frames are stamped T after they were taken: positions at t are those of t − T."""

    name = "camera_latency"
    equation = "readings X(t − T), Y(t − T)"
    outputs = ("x_world", "y_world")


@dataclass(frozen=True, kw_only=True)
class MagnetometerDisturbance(SensorError):
    """The magnetometer is disturbed by the motors (§5.2): a heading error that follows their duty, none at hover.

    The current of a motor goes with its thrust, a + b·δ behind the lag (4.20): the error is a line of the duty.
    """

    name = "magnetometer_disturbance"
    equation = "reading ψ + k·(T_R + T_L − 2·T_N)"
    output = "psi"

    value: float = parameter(
        0.0, unit="rad/N", bounds=(-0.5, 0.5), neutral=0.0, typical=0.02, doc="heading error k a newton of thrust"
    )

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """ψ + k·(T_R + T_L − 2·T_N)."""
        beyond_hover = outputs["thrust_right"] + outputs["thrust_left"] - 2.0 * HOVER_THRUST
        return outputs["psi"] + self.value * beyond_hover


# What is there, then what the sensor makes of it: a lever arm before a scale, and that before a bias.
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
