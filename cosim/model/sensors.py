"""Sensor errors, which act on the measurement and not on the plant.

A model declares possible sensor errors as subclasses. A subclass has a name, an output, and one parameter `value` with
the unit and typical size of the error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model.model import Effect, Number, Values
from cosim.model.namespaces import Namespace
from cosim.model.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class SensorError(Effect):
    """An error in the reading of an output.

    `measure` returns the reading, a linear function of the true value. An error of several outputs lists them in
    `outputs` instead of `output`. If the reading depends on time or on other outputs, override `read` (or `readings`
    for several outputs), which returns the true output plus a term of time and the other outputs.
    """

    output: ClassVar[str]
    outputs: ClassVar[tuple[str, ...]] = ()
    late: ClassVar[bool] = False  # True if `value` is a latency of readings
    lagging: ClassVar[bool] = False  # True if `value` is a time constant of the sensor
    complete: ClassVar[float | None] = None  # further start of fits: the value of a complete error

    def measure(self, value: Number) -> Number:
        """Return the reading of an output with this true value."""
        return value

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Return the reading of the affected output at time `t` [s]; `outputs` are the model's true outputs by name."""
        return self.measure(outputs[self.affected()[0]])

    def readings(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> dict[str, Number]:
        """Return name → reading of all affected outputs at time `t` [s], from the true outputs by name."""
        names = self.affected()
        return {n: self.measure(outputs[n]) for n in names} if len(names) > 1 else {names[0]: self.read(m, t, outputs)}

    @classmethod
    def affected(cls) -> tuple[str, ...]:
        """Return the names of the affected outputs."""
        return cls.outputs or (cls.output,)

    @classmethod
    def is_straight(cls) -> bool:
        """Return True if the reading is a linear function of the true value."""
        changed = cls.read is not SensorError.read or cls.readings is not SensorError.readings
        return not (changed or cls.depends_on_past())

    @classmethod
    def depends_on_past(cls) -> bool:
        """Return True if the reading depends on past values of its output."""
        return cls.late or cls.lagging


@dataclass(frozen=True, kw_only=True)
class Bias(SensorError):
    """Bias: reading y + b."""

    equation = "reading y + b"

    value: float

    def measure(self, value: Number) -> Number:
        """Return y + b."""
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Scale(SensorError):
    """Scale error: reading s·y."""

    equation = "reading s·y"

    value: float

    def measure(self, value: Number) -> Number:
        """Return s·y."""
        return value * self.value


@dataclass(frozen=True, kw_only=True)
class Magnitude(SensorError):
    """Loss of the sign: reading (1 − m)·y + m·|y|, with m = 1 for a sensor that measures the magnitude only."""

    equation = "reading (1 − m)·y + m·|y|"
    complete = 1.0

    value: float

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Return the reading (1 − m)·y + m·|y|."""
        value = outputs[self.output]
        return m.where(value >= 0.0, value, (1.0 - 2.0 * self.value) * value)


@dataclass(frozen=True, kw_only=True)
class Drift(SensorError):
    """Drift: reading y + d·t, t from the start of the log's clock."""

    equation = "reading y + d·t"

    value: float

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Return the reading with a drift over time: y + d·t."""
        return outputs[self.output] + self.value * t


@dataclass(frozen=True, kw_only=True)
class LeverArm(SensorError):
    """Lever arm l between sensor and reference point of the output: reading y + l·c, with c from other outputs.

    A model names `output` or `outputs` and the `others` from which c follows, and defines c in `carried`. Planar motion
    of a rigid body with heading ψ to the left and a sensor l ahead follows from r_P = r + l·e and its derivatives:

        position   x + l·cos ψ,  y + l·sin ψ        c = cos ψ, sin ψ
        velocity   to the left   v + l·ψ̇           c = ψ̇
        acceleration   forward   a − l·ψ̇²           c = −ψ̇²
    """

    equation = "reading y + l·c of other outputs"
    others: ClassVar[tuple[str, ...]]

    value: float = parameter(0.0, unit="m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="lever arm l, ahead")

    def carried(self, m: Namespace, *others: Number) -> Values:
        """Return c for each affected output: the change of the reading per metre of lever arm.

        Args:
            others: Values of `others` in their order.
        """
        raise NotImplementedError

    def readings(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> dict[str, Number]:
        """Return y + l·c of each output."""
        offsets = self.carried(m, *(outputs[name] for name in self.others))
        return {n: outputs[n] + self.value * c for n, c in zip(self.affected(), offsets, strict=True)}


@dataclass(frozen=True, kw_only=True)
class Latency(SensorError):
    """Latency of readings by T: the reading at t is y(t − T), for every output in `outputs`."""

    equation = "reading y(t − T)"
    late = True

    value: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.03, doc="latency T of the readings")


@dataclass(frozen=True, kw_only=True)
class Lag(SensorError):
    """First-order lag of a sensor: T·ṙ = y − r with the reading r, for every output in `outputs`."""

    equation = "reading r, T·ṙ = y − r"
    lagging = True

    value: float = parameter(0.0, unit="s", bounds=(0, 10), neutral=0.0, typical=0.1, doc="time constant T")
