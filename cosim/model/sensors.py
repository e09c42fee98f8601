"""Errors of the sensors: on the measurement, not in the plant.

A model declares those that its sensors may have: a subclass that bears a name and says of which output it is, with one
parameter, called `value`, whose unit and usual size are that sensor's.
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
    """One output reads wrong. `measure` gives what the sensor says for what is there, a straight line of it.

    One of several outputs, alike, names them in `outputs` in place of `output`. One whose reading depends on more, on
    time or on other outputs, gives `read` a body of its own (of several outputs, `readings`): the true output, and
    something of time and of the others added to it.
    """

    output: ClassVar[str]
    outputs: ClassVar[tuple[str, ...]] = ()
    late: ClassVar[bool] = False  # its value is a time by which readings are late

    def measure(self, value: Number) -> Number:
        """Reading for a true value."""
        return value

    def read(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> Number:
        """Reading at time `t` [s] from the true outputs by name: those that the model has."""
        return self.measure(outputs[self.affected()[0]])

    def readings(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> dict[str, Number]:
        """Reading of each output that it changes, by name."""
        names = self.affected()
        return {n: self.measure(outputs[n]) for n in names} if len(names) > 1 else {names[0]: self.read(m, t, outputs)}

    @classmethod
    def affected(cls) -> tuple[str, ...]:
        """The outputs whose readings it changes."""
        return cls.outputs or (cls.output,)

    @classmethod
    def straight(cls) -> bool:
        """Whether the reading is a straight line of the output alone."""
        return cls.read is SensorError.read and cls.readings is SensorError.readings and not cls.late


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
class LeverArm(SensorError):
    """A sensor mounted l away from the point whose motion the output is: reading y + l·c, c of other outputs.

    A model names, beside `output` or `outputs`, the `others` that c needs, and says in `carried` what c is. In a plane,
    of a rigid body with heading ψ to the left, mounted l ahead, by r_P = r + l·e and its derivatives:
        position   x + l·cos ψ,  y + l·sin ψ        c = cos ψ, sin ψ
        velocity   to the left   v + l·ψ̇           c = ψ̇
        acceleration   forward   a − l·ψ̇²           c = −ψ̇²
    """

    equation = "reading y + l·c of other outputs"
    others: ClassVar[tuple[str, ...]]

    value: float = parameter(0.0, unit="m", bounds=(-1, 1), neutral=0.0, typical=0.05, doc="lever arm l, ahead")

    def carried(self, m: Namespace, *others: Number) -> Values:
        """What a metre of lever arm adds to each of the outputs, from the `others` in their order."""
        raise NotImplementedError

    def readings(self, m: Namespace, t: Number, outputs: Mapping[str, Number]) -> dict[str, Number]:
        """y + l·c, of each output."""
        added = self.carried(m, *(outputs[name] for name in self.others))
        return {n: outputs[n] + self.value * c for n, c in zip(self.affected(), added, strict=True)}


@dataclass(frozen=True, kw_only=True)
class Latency(SensorError):
    """Readings stamped T after what they show: reading at t is y(t − T), of every output in `outputs`."""

    equation = "reading y(t − T)"
    late = True

    value: float = parameter(0.0, unit="s", bounds=(0, 0.5), neutral=0.0, typical=0.03, doc="latency T of the readings")
