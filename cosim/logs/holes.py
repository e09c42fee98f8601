"""Reconstruction of commands in lost rows from the motion of the input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array
from cosim.logs.log import Log

SMOOTH = 0.5  # share of the error of holding up to which interpolation is the better guess


def fill_holes(log: Log) -> Log:
    """Return the log with lost rows inserted if an input is smooth.

    Each input is held or interpolated, whichever predicts the existing rows better.
    """
    grid = log.grid
    lost = np.setdiff1d(np.arange(int(grid[-1]) + 1), grid)
    whole, smooth = (np.diff(grid)[:-1] == 1) & (np.diff(grid)[1:] == 1), set[str]()
    for name, values in log.inputs.items():
        first, middle, last = values[:-2][whole], values[1:-1][whole], values[2:][whole]
        hold, line = float(np.sum((middle - first) ** 2)), float(np.sum((middle - 0.5 * (first + last)) ** 2))
        if line < SMOOTH * hold:
            smooth.add(name)
    if not lost.size or not smooth:
        return log
    after = np.searchsorted(grid, lost)  # the last row is never lost
    before = after - 1
    share = (lost - grid[before]) / (grid[after] - grid[before])
    times = log.time[before] + share * (log.time[after] - log.time[before])
    order = np.argsort(np.concatenate([grid, lost]), kind="stable")

    def join(values: Array, added: Array) -> Array:
        return np.asarray(np.concatenate([values, added])[order])

    inputs = {}
    for name, values in log.inputs.items():
        rise = values[after] - values[before] if name in smooth else 0.0
        inputs[name] = join(values, values[before] + share * rise)
    nothing = np.full(lost.size, np.nan)
    outputs = {name: join(values, nothing) for name, values in log.outputs.items()}
    return replace(log, time=join(log.time, times), inputs=inputs, outputs=outputs)
