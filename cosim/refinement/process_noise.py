"""How large process noise can be, measured by what it does to the innovations: no number here has a unit of a model.

Noise on one forced state raises the variance s of the innovations. Where the mean of ln s rises by less than SMALLEST,
no log can show it; where it rises by PLAIN, it is plainly detected and still leaves the sensors their say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Array

SMALLEST, QUIET, PLAIN, LARGEST = 1e-3, 0.02, 0.04, 3.0
GRID = np.arange(-60.0, 40.0, 4.0)


@dataclass(frozen=True)
class NoiseRange:
    """ln q of each forced state where the rise of ln s is SMALLEST, QUIET, PLAIN, LARGEST."""

    smallest: Array
    quiet: Array
    plain: Array
    largest: Array


def noise_range(variances: Callable[[Array], Array], count: int) -> NoiseRange:
    """The range; `variances` gives those of the innovations at the ln q of the `count` forced states."""
    nothing = np.full(count, GRID[0])
    least = np.log(variances(nothing))
    levels = np.empty((4, count))
    for k in range(count):
        rises = []
        for level in GRID:
            log_q = nothing.copy()
            log_q[k] = level
            rise = float(np.mean(np.log(np.abs(variances(log_q))) - least))
            rises.append(max(1e-12, rise) if np.isfinite(rise) else 1e3)
        rising = np.log(np.maximum.accumulate(rises)) + 1e-9 * np.arange(len(GRID))
        levels[:, k] = np.interp(np.log([SMALLEST, QUIET, PLAIN, LARGEST]), rising, GRID)
    return NoiseRange(*levels)
