"""A sensor that measures now and then, and answers late: values held between fixes, and how many have come."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, MutableSequence
from dataclasses import dataclass
from typing import Any

from cosim.blocks.component import Row, Signal, in_turn
from cosim.blocks.noise import stream

COUNT = "fix"  # the output that counts


@dataclass(frozen=True)
class Sensor:
    """How often, how late and how well it measures.

    rate:    [Hz]
    latency: [s]
    dropout: probability that a fix is lost
    signals: name → unit, variance and bias of a fix
    """

    rate: float
    latency: float
    dropout: float
    signals: Mapping[str, tuple[str, float, float]]

    def outputs(self) -> list[str]:
        """Names of what goes out, in order."""
        return [*(f"{name}_meas" for name in self.signals), COUNT]


class Fixes:
    """Fix j is of the first communication point that is not before j/rate, and known ⌈latency/step⌉ points later.

    step: communication step [s]; the random streams, one a signal and one for what is lost, are by the seed and `name`
    """

    nominal_step = True

    def __init__(self, name: str, sensor: Sensor, step: float, seed: int) -> None:
        self.name, self.sensor, self.step = name, sensor, step
        self.inputs = tuple(Signal(n, unit, kind="Real") for n, (unit, _, _) in sensor.signals.items())
        units = [*(unit for unit, _, _ in sensor.signals.values()), ""]
        self.outputs = tuple(Signal(n, unit) for n, unit in zip(sensor.outputs(), units, strict=True))
        self.exact_inputs: tuple[Signal, ...] = ()
        self.exact_outputs: tuple[Signal, ...] = ()
        self._noise = [
            (stream(seed, f"{name}.{n}"), math.sqrt(variance), bias)
            for n, (_, variance, bias) in sensor.signals.items()
        ]
        self._lost = stream(seed, f"{name} dropout")
        self._late = math.ceil(sensor.latency / step - 1e-9)
        self._point, self._made, self._count = 0, 0, 0
        self._held = [0.0] * len(self.inputs)
        self._coming: deque[tuple[int, list[float]]] = deque()  # what is measured, not known yet, by when it is
        self._errors: list[float] | None = None  # of the fix at the start, and what it measured
        self._opening = self._held

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return True

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        self._row, self._first = row, first

    def open(self, start: float, stop: float) -> None:
        self._errors = self._draw()

    def start(self) -> None:
        pass

    def put(self) -> None:
        pass

    def get(self) -> None:
        """Write the latest fix. At the start, while values are still exchanged, the first one is that of the moment."""
        first = self._first + len(self.inputs)
        if self._point == 0 and self._errors is not None:
            self._opening = self._measured(self._errors)
            if not self._late:
                self._held, self._count = self._opening, 1
        self._row[first : first + len(self._held) + 1] = [*self._held, float(self._count)]

    def advance(self, t: float, h: float) -> None:
        if self._point == 0:
            self._begin()
        self._point += 1
        while self._due(self._made) <= self._point:
            self._made += 1
            if (error := self._draw()) is not None:
                self._coming.append((self._point + self._late, self._measured(error)))
        while self._coming and self._coming[0][0] <= self._point:
            self._held = self._coming.popleft()[1]
            self._count += 1

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        return in_turn(self, doing, first, puts=False)

    def slot(self) -> str:
        """Why C does not step it."""
        return f"{self.name} measures now and then"

    def close(self) -> None:
        pass

    def _begin(self) -> None:
        """What was measured at the start is known now, or later."""
        self._made = 1
        if self._late and self._errors is not None:
            self._coming.append((self._late, self._opening))

    def _due(self, fix: int) -> int:
        """The communication point of a fix."""
        return math.ceil(fix / (self.sensor.rate * self.step) - 1e-9)

    def _draw(self) -> list[float] | None:
        """The errors of a fix; None where it is lost. What is drawn does not hang on what is lost."""
        errors = [bias + scale * rng.standard_normal() for rng, scale, bias in self._noise]
        return None if self._lost.random() < self.sensor.dropout else errors

    def _measured(self, errors: list[float]) -> list[float]:
        row, first = self._row, self._first
        return [row[k] + e for k, e in enumerate(errors, first)]
