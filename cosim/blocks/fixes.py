"""A sensor with sporadic, delayed position fixes, whose values are constant between fixes, and a count of fixes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from cosim.blocks.component import Component, Signal
from cosim.blocks.faults import stream

COUNT = "fix"  # name of the counting output


def fix_outputs(signals: Iterable[str]) -> list[str]:
    """Return the names of the sensor's outputs, in order."""
    return [*(f"{name}_meas" for name in signals), COUNT]


class Fixes(Component):
    """Sensor of position fixes: samples its inputs at a rate and outputs the samples with latency.

    Fix j is taken at the first communication point at or after j/rate and appears ⌈latency/step⌉ points later.

    Args:
        rate: Fixes per second [Hz].
        latency: Delay from measurement to output [s].
        dropout: Probability of losing a fix.
        signals: Name → unit, variance and bias of a fix.
        step: Communication step [s].
        seed: Seed of the random streams, one per signal and one for losses, which also depend on `name`.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        latency: float,
        dropout: float,
        signals: Mapping[str, tuple[str, float, float]],
        *,
        step: float,
        seed: int,
    ) -> None:
        self.name, self._fixes_per_step, self._dropout = name, rate * step, dropout
        units = {n: unit for n, (unit, _, _) in signals.items()}
        self.inputs = tuple(Signal(n, unit, kind="Real") for n, unit in units.items())
        self.outputs = tuple(map(Signal, fix_outputs(signals), (*units.values(), "")))
        self._noise = [
            (stream(seed, f"{name}.{n}"), math.sqrt(variance), bias) for n, (_, variance, bias) in signals.items()
        ]
        self._losses = stream(seed, f"{name} dropout")
        self._late = math.ceil(latency / step - 1e-9)
        self._point, self._measured, self._count = 0, 0, 0
        self._values = [0.0] * len(self.inputs)
        self._queue: deque[tuple[int, list[float]]] = deque()  # output point and fix
        self._errors: list[float] | None = None  # errors of the first fix, for all exchanges during initialization
        self._opening = self._values

    def depends_on(self, name: str, outputs: Collection[str] | None = None) -> bool | None:
        return True

    def open(self, start: float, stop: float) -> None:
        self._errors = self._draw()

    def get(self) -> None:
        """Write the latest fix.

        During initialization, each exchange repeats the first fix with the current values.
        """
        first = self._first + len(self.inputs)
        if self._point == 0 and self._errors is not None:
            self._opening = [self._row[k] + e for k, e in enumerate(self._errors, self._first)]
            if not self._late:
                self._values, self._count = self._opening, 1
        self._row[first : first + len(self._values) + 1] = [*self._values, float(self._count)]

    def advance(self, t: float, h: float) -> None:
        if self._point == 0:  # At the start of the run, count the first fix; with a latency, queue it.
            self._measured = 1
            if self._late and self._errors is not None:
                self._queue.append((self._late, self._opening))
        self._point += 1
        while math.ceil(self._measured / self._fixes_per_step - 1e-9) <= self._point:
            self._measured += 1
            if (errors := self._draw()) is not None:
                measured = [self._row[k] + e for k, e in enumerate(errors, self._first)]
                self._queue.append((self._point + self._late, measured))
        while self._queue and self._queue[0][0] <= self._point:
            self._values = self._queue.popleft()[1]
            self._count += 1

    def slot(self, cells: Any) -> str:
        """Return why the C loop cannot step this component."""
        return f"{self.name} has fixes at times of its own"

    def _draw(self) -> list[float] | None:
        """Return the errors of a position fix, or None for a lost fix.

        A lost fix draws the same random numbers, so that losses do not change the errors of later fixes.
        """
        errors = [bias + scale * rng.standard_normal() for rng, scale, bias in self._noise]
        return None if self._losses.random() < self._dropout else errors
