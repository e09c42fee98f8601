"""Effects that are available to every model: delay and gain of the command, and laws of forces and signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model.model import Effect, LocalEffect, Number, Values
from cosim.model.namespaces import Namespace
from cosim.model.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class Delay(Effect):
    """Delay of all commands by T: u(t) → u(t − T).

    A model declares a subclass with a name and with one quantity per input in `memory`, as the first effect of its
    catalogue. For delays above `longest`, the subclass sets a larger `longest` and upper bound of `time`.

    During a substep, the mean of the delayed command acts, so that the integral of the command is exact for any T. The
    memory is a history of pairs (start time, command), oldest first.
    """

    equation = "u(t) → u(t − T), all commands"
    delay = "time"
    longest: ClassVar[float] = 0.5  # largest delay [s]

    time: float = parameter(0.0, unit="s", bounds=(0, longest), neutral=0.0, typical=0.04, doc="delay T")

    def remember(self, t: Number, start: Values) -> Values:
        """Return the initial history: the start values of the commands, constant in the past."""
        return ((t - self.longest, start),)

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """Return the mean delayed command over the substep, and the updated history."""
        history = memory if memory[-1][1] is command else (*memory, (t, command))
        begin, end = t - self.time, t + h - self.time
        mean = [0.0] * len(command)
        earliest = begin.min() if hasattr(begin, "min") else begin
        first = next((k for k in range(len(history) - 1, 0, -1) if history[k][0] <= earliest), 0)
        for k, (since, value) in enumerate(history[first:], first):
            until = history[k + 1][0] if k + 1 < len(history) else t + h
            since = since if k else begin  # the start time of the oldest command is unknown
            overlap = m.maximum(0.0, m.minimum(until, end) - m.maximum(since, begin)) / h
            mean = [a + overlap * v for a, v in zip(mean, value, strict=True)]
        while len(history) > 1 and history[1][0] <= t + h - self.longest:
            history = history[1:]
        return tuple(mean), history


@dataclass(frozen=True, kw_only=True)
class Gain(Effect):
    """Gain of one input: u → k·u.

    A model lists a subclass with a name and the input's name in `input` in its catalogue. The gain acts after all
    effects that delay or shape the command.
    """

    equation = "k·u in place of u"
    input: ClassVar[str]

    gain: float = parameter(1.0, unit="1", bounds=(0.1, 10), neutral=1.0, typical=0.1, doc="gain k of the input")

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return the commands with the gain on one input."""
        return {**command, self.input: self.gain * command[self.input]}


# -- effects on one quantity of the equations; for a force, `at[0]` is the velocity -----------


@dataclass(frozen=True, kw_only=True)
class Offset(LocalEffect):
    """Constant addition: x + b."""

    equation = "x + b in place of x"

    value: float

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return x + b."""
        return value + self.value


@dataclass(frozen=True, kw_only=True)
class Asymmetry(LocalEffect):
    """Different gains in both directions: x + a·|x|."""

    equation = "x + a·|x| in place of x"

    ratio: float

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return x + a·|x|."""
        return value + self.ratio * m.where(value >= 0.0, value, -value)


@dataclass(frozen=True, kw_only=True)
class DryFriction(LocalEffect):
    """Dry friction F − L·tanh(v/ε), smoothed below the velocity ε, which is the class attribute `softness`."""

    equation = "force −L·tanh(v/ε)"
    softness: ClassVar[float]

    level: float

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return F − L·tanh(v/ε)."""
        return value - self.level * m.tanh(at[0] / self.softness)


@dataclass(frozen=True, kw_only=True)
class ViscousFriction(LocalEffect):
    """Viscous friction: F − c·v."""

    equation = "force −c·v"

    coefficient: float

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return F − c·v."""
        return value - self.coefficient * at[0]


@dataclass(frozen=True, kw_only=True)
class QuadraticDrag(LocalEffect):
    """Drag with the square of the velocity: F − c·|v|·v."""

    equation = "force −c·|v|·v"

    coefficient: float

    def change(self, m: Namespace, value: Number, *at: Number) -> Number:
        """Return F − c·|v|·v."""
        return value - self.coefficient * m.where(at[0] >= 0.0, at[0], -at[0]) * at[0]


@dataclass(frozen=True, kw_only=True)
class FirstOrderLag(LocalEffect):
    """First-order lag of each quantity x at a place: τ·ẏ = x − y, with a state y that acts in place of x.

    Attributes:
        shortest: Lower limit [s] of a time constant above 0; a shorter one is raised to this value.
    """

    equation = "τ·ẏ = x − y, y in place of x"
    shortest: ClassVar[float]

    time: float

    def follow(self, m: Namespace, values: Values, states: Values) -> tuple[Values, Values]:
        """Return the lagged quantities y (x itself for τ = 0) and the derivatives of y."""
        slow, time = self.time > 0.0, m.maximum(self.time, self.shortest)
        pairs = tuple(zip(values, states, strict=True))
        return tuple(m.where(slow, y, x) for x, y in pairs), tuple((x - y) / time for x, y in pairs)
