"""Terms of an FMU as slaves of their own: one changes the inputs of the original, the other its readings.

They need Python and no compiler. Ports and functions are in `cosim.fmi.printed_terms`, printed when the FMU is built.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from cosim.fmi.ports import Port, Value
from cosim.fmi.slave import Slave, tuples
from cosim.model.delay import Delay
from cosim.model.namespaces import SCALAR


@dataclass(frozen=True, kw_only=True)
class InputDelay(Delay):
    """Delay of all inputs, of any length."""

    longest: ClassVar[float] = math.inf
    time: float


class TermsFmu(Slave):
    """Common part: ports, parameters and functions of the printed module."""

    terms: Any

    def __init__(self, **kwargs: Any) -> None:
        from cosim.fmi import printed_terms  # type: ignore[attr-defined]  # printed when the FMU is built

        self.terms = printed_terms
        type(self).ports = tuple(Port(*port) for port in printed_terms.PORTS)
        super().__init__(**kwargs)

    def read_parameters(self) -> None:
        """Read the parameters in the order of the printed functions."""
        places = (vr for vr, port in enumerate(self.ports) if port.causality == "parameter")
        self.parameters = [float(self.values[vr]) for vr in places]

    def call(self, name: str, results: int, *arguments: Any) -> list[float] | None:
        """Return the results of a printed function; None without this function."""
        function = getattr(self.terms, name, None)
        if function is None:
            return None
        out = [0.0] * results
        function(*arguments, out)
        return out


class InputTermsFmu(TermsFmu):
    """Changed inputs of an original: the first inputs pass through, the others are outputs of the original.

    An output is the mean over the coming step, which is expected to be as long as the last one.
    """

    def initialize(self, values: dict[str, Value]) -> None:
        """Start the memories with the present inputs."""
        self.read_parameters()
        self.acting, self.memory, self.length = self.inputs, [0.0] * self.terms.MEMORY, float(self.terms.STEP)
        place = self.terms.DELAY
        self.delay = None if place is None else InputDelay(time=self.parameters[place])
        self.history: tuple[Any, ...] = ((self.start_time, self._command),)
        self._publish(self.start_time)

    def advance(self, t: float, h: float) -> None:
        """Advance the memories by the inputs since the last step, and change the present ones."""
        *_, self.memory, self.history = self._shaped(t, h)
        self.acting, self.length = self.inputs, h
        self._publish(t + h)

    @property
    def _command(self) -> tuple[float, ...]:
        return self.acting[: self.terms.COMMANDS]

    def _shaped(self, t: float, h: float) -> tuple[Sequence[float], list[float], tuple[Any, ...]]:
        """Return the shaped command over a step, and the memories after."""
        command, history = self._command, self.history
        if self.delay is not None:
            command, history = self.delay.shape(SCALAR, t, h, command, history)
            history = tuple(entry for k, entry in enumerate(history) if not self._is_past(history, k, t + h))
        parameters = (*self.parameters, h)
        shaped = self.call("shape_all", len(command) + len(self.memory), t, command, self.memory, parameters)
        if shaped is None:
            return command, self.memory, history
        return shaped[: len(command)], shaped[len(command) :], history

    def _is_past(self, history: tuple[Any, ...], k: int, t: float) -> bool:
        """Return whether a command has been replaced before all times that are still delayed."""
        assert self.delay is not None
        return k + 1 < len(history) and bool(history[k + 1][0] <= t - self.delay.time)

    def _publish(self, t: float) -> None:
        shaped, *_ = self._shaped(t, self.length)
        states, parameters = self.acting[self.terms.COMMANDS :], (*self.parameters, self.length)
        pushed = self.call("port_inputs", len(shaped), t, states, shaped, parameters)
        self.set_outputs([*(shaped if pushed is None else pushed)])

    def snapshot(self) -> Any:
        """Return inputs, memories and step."""
        return [self.acting, self.memory, self.history, self.length]

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot."""
        acting, memory, history, self.length = snapshot
        self.acting, self.memory, self.history = tuple(acting), [*memory], tuples(history)


class SensorTermsFmu(TermsFmu):
    """Readings of an original's outputs: a lag, then a latency, then errors without memory."""

    def initialize(self, values: dict[str, Value]) -> None:
        """Start the lags with the present outputs."""
        self.read_parameters()
        self.true, self.lagged = self.inputs, [*self.inputs]
        self.history = [(self.start_time, tuple(self.lagged))]
        self._publish(self.start_time)

    def advance(self, t: float, h: float) -> None:
        """Advance the lags by outputs that run straight over the step."""
        for k, place in self.terms.LAGS.items():
            self.lagged[k] = _lag(self.lagged[k], self.true[k], self.inputs[k], h, self.parameters[place])
        self.true = self.inputs
        for k in range(len(self.true)):
            if k not in self.terms.LAGS:
                self.lagged[k] = self.true[k]
        self.history.append((t + h, tuple(self.lagged)))
        longest = max((self.parameters[place] for place in self.terms.LATENCIES.values()), default=0.0)
        while len(self.history) > 1 and self.history[1][0] <= t + h - longest:
            del self.history[0]
        self._publish(t + h)

    def _publish(self, t: float) -> None:
        values = [*self.lagged]
        for k, place in self.terms.LATENCIES.items():
            values[k] = self._at(t - self.parameters[place], k)
        read = self.call("readings", len(values), t, values, self.parameters)
        self.set_outputs(values if read is None else read)

    def _at(self, t: float, k: int) -> float:
        """Return an output at a time in the history, interpolated."""
        before = self.history[0]
        for after in self.history[1:]:
            if after[0] >= t:
                share = (t - before[0]) / (after[0] - before[0])
                return float(before[1][k] + max(share, 0.0) * (after[1][k] - before[1][k]))
            before = after
        return float(before[1][k])

    def snapshot(self) -> Any:
        """Return outputs, lags and history."""
        return [self.true, self.lagged, self.history]

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot."""
        true, lagged, history = snapshot
        self.true, self.lagged, self.history = tuple(true), [*lagged], [tuples(entry) for entry in history]


def _lag(reading: float, before: float, after: float, h: float, time: float) -> float:
    """Return the reading of a sensor with a time constant, after a step with a straight input."""
    if time <= 0.0:
        return after
    behind = (after - before) / h * time
    return after - behind + (reading - before + behind) * math.exp(-h / time)
