"""Errors of the sensors: on the measurement, not in the plant."""

from __future__ import annotations

from dataclasses import dataclass

from plant.model import Number
from plant.quantities import parameter
from plant.sensors import SensorError


@dataclass(frozen=True, kw_only=True)
class AccelerometerBias(SensorError):
    """The accelerometer reads a_x + b."""

    name = "accelerometer_bias"
    equation = "reading a_x + b"
    output = "ax"

    value: float = parameter(0.0, unit="m/s2", bounds=(-2, 2), neutral=0.0, typical=0.05, doc="bias b")

    def measure(self, value: Number) -> Number:
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class AccelerometerScale(SensorError):
    """The accelerometer reads s·a_x."""

    name = "accelerometer_scale"
    equation = "reading s·a_x"
    output = "ax"

    value: float = parameter(1.0, unit="1", bounds=(0.3, 3), neutral=1.0, typical=0.1, doc="scale s")

    def measure(self, value: Number) -> Number:
        return value * self.value


@dataclass(frozen=True, kw_only=True)
class GyroBias(SensorError):
    """The gyroscope reads ψ̇ + b."""

    name = "gyro_bias"
    equation = "reading ψ̇ + b"
    output = "psi_dot"

    value: float = parameter(0.0, unit="rad/s", bounds=(-0.5, 0.5), neutral=0.0, typical=0.01, doc="bias b")

    def measure(self, value: Number) -> Number:
        return value + self.value


# A scale acts before a bias.
SENSORS = (AccelerometerScale, AccelerometerBias, GyroBias)
