"""Effects on the command for every model: delay of all inputs, and gain of one input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from cosim.model.model import Effect, Number, Values
from cosim.model.namespaces import Namespace
from cosim.model.quantities import parameter


@dataclass(frozen=True, kw_only=True)
class Delay(Effect):
    """Delay of all commands by T: u(t) → u(t − T).

    A model's subclass has a name and `memory` with one quantity per input, and comes first in the catalogue. For longer
    delays, the subclass raises `longest` and the upper bound of `time`.

    Over a substep, the mean of the delayed command acts, so that its impulse is exact for any T. The memory is the
    history of commands (start time, command), oldest first.
    """

    equation = "u(t) → u(t − T), all commands"
    delay = "time"
    longest: ClassVar[float] = 0.5  # [s]

    time: float = parameter(0.0, unit="s", bounds=(0, longest), neutral=0.0, typical=0.04, doc="delay T")

    def remember(self, t: Number, start: Values) -> Values:
        """Return the initial memory: the start command at all past times."""
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
            since = since if k else begin  # the oldest command applies to all earlier times
            overlap = m.maximum(0.0, m.minimum(until, end) - m.maximum(since, begin)) / h
            mean = [a + overlap * v for a, v in zip(mean, value, strict=True)]
        while len(history) > 1 and history[1][0] <= t + h - self.longest:
            history = history[1:]
        return tuple(mean), history


@dataclass(frozen=True, kw_only=True)
class Gain(Effect):
    """Gain of one input: u → k·u.

    A model's subclass sets `name` and `input` (the input's name) and is listed in the catalogue. Delays and shaping of
    the command apply before the gain.
    """

    equation = "k·u in place of u"
    input: ClassVar[str]

    gain: float = parameter(1.0, unit="1", bounds=(0.1, 10), neutral=1.0, typical=0.1, doc="gain k of the input")

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return the commands with the gain on one input."""
        return {**command, self.input: self.gain * command[self.input]}
