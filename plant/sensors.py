"""Errors of the sensors: on the measurement, not in the plant.

A model declares those that its sensors may have: a subclass that bears a name and says of which output it is, with one
parameter, called `value`, whose unit and usual size are that sensor's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from plant.model import Effect, Number
from plant.namespaces import Namespace
from plant.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class SensorError(Effect):
    """One output reads wrong. `measure` gives what the sensor says for what is there, a straight line of it.

    One whose reading depends on more than that, on time or on other outputs, gives `read` a body of its own.
    """

    output: ClassVar[str]
    late: ClassVar[bool] = False  # its value is a time by which readings are late

    def measure(self, value: Number) -> Number:
        """Reading for a true value."""
        return value

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Reading at time `t` [s] from the true outputs by name: those that the model has."""
        return self.measure(outputs[self.output])

    @classmethod
    def affected(cls) -> tuple[str, ...]:
        """The outputs whose readings it changes."""
        return (cls.output,)


@dataclass(frozen=True, kw_only=True)
class Bias(SensorError):
    """Reading y + b."""

    equation = "reading y + b"

    value: float

    def measure(self, value: Number) -> Number:
        """y + b."""
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Scale(SensorError):
    """Reading s·y."""

    equation = "reading s·y"

    value: float

    def measure(self, value: Number) -> Number:
        """s·y."""
        return value * self.value


@dataclass(frozen=True, kw_only=True)
class Drift(SensorError):
    """Reading y + d·t, t from the start of the log's clock."""

    equation = "reading y + d·t"

    value: float

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """y + d·t."""
        return outputs[self.output] + self.value * t


@dataclass(frozen=True, kw_only=True)
class Latency(SensorError):
    """Readings stamped T after what they show: reading at t is y(t − T), of every output in `outputs`."""

    equation = "reading y(t − T)"
    late = True
    outputs: ClassVar[tuple[str, ...]]

    value: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.03, doc="latency T of the readings")

    @classmethod
    def affected(cls) -> tuple[str, ...]:
        """The outputs of the late sensor."""
        return cls.outputs
