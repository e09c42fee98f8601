"""Random quantities of a filter: the unknown input of each forced equation, and sensor noise.

The range of an unknown input is measured by its effect on the innovations, so no constant here has a model's unit. An
input raises the innovation variance s. If the mean of ln s rises by less than SMALLEST, no log can show the input. At
PLAIN the input is plainly detected, and sensors still contribute.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from cosim.core.arrays import Array, Rows

SMALLEST, PLAIN, LARGEST = 1e-3, 0.04, 3.0
GRID = np.arange(-60.0, 40.0, 4.0)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise in natural logarithms, so that a step of a fit is a factor.

    Attributes:
        power: Variance of the unknown input of each forced equation [(unit of the state/s)²].
        memory: Correlation time of the unknown inputs [s].
        sensors: Variance of the noise of each output.
        timing: Variance of the time stamp error of each output [s²], noise proportional to speed; −∞ for none.
    """

    power: Array
    memory: float
    sensors: Array
    timing: Array

    @property
    def vector(self) -> Array:
        """Return all values in one vector."""
        return np.concatenate([self.power, [self.memory], self.sensors, self.timing])

    def like(self, vector: Array) -> Self:
        """Return noise of the same shapes from a vector."""
        n, m = len(self.power), len(self.sensors)
        power, memory, sensors, timing = np.split(vector, [n, n + 1, n + 1 + m])
        return type(self)(power, float(memory[0]), sensors, timing)

    @property
    def density(self) -> Array:
        """Return the low-frequency density 2·σ²·T of unknown inputs [unit of the state squared per second]."""
        return 2.0 * np.exp(self.power + self.memory)


@dataclass(frozen=True, eq=False)
class NoiseRange:
    """Log power of each unknown input at which ln s rises by SMALLEST to LARGEST, s being the innovation variance."""

    smallest: Array
    quiet: Array
    plain: Array
    largest: Array


@dataclass(frozen=True, eq=False)
class NoiseLimits:
    """Limits and weak prior of a noise vector; a fixed value has equal limits."""

    low: Array
    high: Array
    mean: Array
    sigma: Array  # infinite without a prior

    @property
    def free(self) -> Rows:
        """Return the indices of noise values that a fit may change."""
        return np.flatnonzero(self.low < self.high)

    def penalty(self, vector: Array) -> float:
        """Return the penalty of the priors on a noise vector: ½ Σ ((v − mean)/sigma)²."""
        has_prior = np.isfinite(self.sigma)
        return float(0.5 * np.sum(((vector[has_prior] - self.mean[has_prior]) / self.sigma[has_prior]) ** 2))


def noise_range(variances: Callable[[Array, bool], Array], count: int) -> NoiseRange:
    """Return the range of noise power to search.

    The smallest level must be invisible at the longest memory too. Otherwise a fit with a longer memory would gain from
    an unknown input that should be inactive.

    Args:
        variances: Function from (ln power, whether to use the longest memory) to the innovation variances.
        count: Number of unknown inputs.
    """
    nothing, finite = np.full(count, GRID[0]), np.finfo(float)

    def levels(marks: Sequence[float], *, longest: bool) -> Array:
        least = np.log(np.abs(variances(nothing, longest)))  # rounding may give a negative variance
        found = np.empty((len(marks), count))
        for k in range(count):
            powers = np.where(np.arange(count) == k, GRID[:, None], nothing)
            rises = np.array([np.mean(np.log(np.abs(variances(power, longest))) - least) for power in powers])
            rises = np.nan_to_num(rises, nan=finite.max).clip(finite.tiny, finite.max)
            found[:, k] = np.interp(np.log(marks), np.log(np.maximum.accumulate(rises)), GRID)
        return found

    (smallest,), (quiet, plain, largest) = (
        levels([SMALLEST], longest=True),
        levels([0.5 * PLAIN, PLAIN, LARGEST], longest=False),
    )
    return NoiseRange(np.minimum(smallest, quiet), quiet, plain, largest)
