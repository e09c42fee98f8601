"""What a filter takes as random: the unknown input of each forced equation, and the noise of the sensors.

How large an unknown input can be is measured by what it does to the innovations: no number here has a unit of a model.
It raises their variance s. Where the mean of ln s rises by less than SMALLEST, no log can show it; where it rises by
PLAIN, it is plainly detected and still leaves the sensors their say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from cosim.base.arrays import Array, Rows

SMALLEST, QUIET, PLAIN, LARGEST = 1e-3, 0.02, 0.04, 3.0
GRID = np.arange(-60.0, 40.0, 4.0)


@dataclass(frozen=True, eq=False)
class Noise:
    """Natural logarithms, so that a step of a fit is a factor.

    power:   variance of the unknown input of each forced equation [(unit of the state/s)²]
    memory:  time within which it is forgotten [s]
    sensors: variance of the noise of each output
    timing:  variance of the time stamps of each output [s²], whose error is noise that grows with speed; −∞ for none
    """

    power: Array
    memory: float
    sensors: Array
    timing: Array

    @property
    def vector(self) -> Array:
        """All in one row."""
        return np.concatenate([self.power, [self.memory], self.sensors, self.timing])

    def like(self, vector: Array) -> Self:
        """Return others of the same sizes, from one row."""
        n, m = len(self.power), len(self.sensors)
        power, memory, sensors, timing = np.split(vector, [n, n + 1, n + 1 + m])
        return type(self)(power, float(memory[0]), sensors, timing)

    @property
    def density(self) -> Array:
        """Low-frequency spectral density of the unknown inputs, 2·σ²·T [unit of the state squared per second]."""
        return np.asarray(2.0 * np.exp(self.power + self.memory))


@dataclass(frozen=True, eq=False)
class NoiseRange:
    """ln of the power of each unknown input where the rise of ln s is SMALLEST, QUIET, PLAIN, LARGEST."""

    smallest: Array
    quiet: Array
    plain: Array
    largest: Array


@dataclass(frozen=True, eq=False)
class NoiseLimits:
    """Limits of a `Noise` in one row, and a weak prior: what is not free has one limit on both sides."""

    low: Array
    high: Array
    mean: Array
    sigma: Array  # infinite: no prior

    @property
    def free(self) -> Rows:
        """Places that a fit may move."""
        places: Rows = np.flatnonzero(self.low < self.high)
        return places

    def penalty(self, vector: Array) -> float:
        """Return ½ Σ ((v − mean)/sigma)²."""
        held = np.isfinite(self.sigma)
        return float(0.5 * np.sum(((vector[held] - self.mean[held]) / self.sigma[held]) ** 2))


def noise_range(variances: Callable[[Array, bool], Array], count: int) -> NoiseRange:
    """Return the range; `variances` gives those of innovations at the ln of the power of `count` unknown inputs.

    Its second argument: whether they last as long as they may, else as long as usual. The least is none, however long
    it lasts: else a fit that takes it to last longer would have an unknown input for nothing.
    """
    nothing = np.full(count, GRID[0])
    levels = np.empty((4, count))
    for rows, marks, longest in (([0], [SMALLEST], True), ([1, 2, 3], [QUIET, PLAIN, LARGEST], False)):
        least = np.log(variances(nothing, longest))
        for k in range(count):
            rises = []
            for level in GRID:
                power = nothing.copy()
                power[k] = level
                rise = float(np.mean(np.log(np.abs(variances(power, longest))) - least))
                rises.append(max(1e-12, rise) if np.isfinite(rise) else 1e3)
            rising = np.log(np.maximum.accumulate(rises)) + 1e-9 * np.arange(len(GRID))
            levels[rows, k] = np.interp(np.log(marks), rising, GRID)
    levels[0] = np.minimum(levels[0], levels[1])
    return NoiseRange(*levels)
