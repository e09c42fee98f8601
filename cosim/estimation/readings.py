"""Properties of a log's readings: scored readings, slopes, resolution and spread."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosim.core.arrays import Array, Flags, Rows
from cosim.estimation.data import count_unscored
from cosim.estimation.kernel.kernel import Data

NEAR = 4  # readings on each side for a slope
ON_GRID = 0.99  # share of steps between readings that marks quantisation


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of one log, shape (rows, outputs).

    Attributes:
        scored: True for readings in the likelihood.
        slopes: Rate of change per row from neighbouring readings; 0 if unknown.
        resolution: Quantisation step of each output; 0 without quantisation.
        spread: Standard deviation of each output.
    """

    scored: Flags
    slopes: Array
    resolution: Array
    spread: Array

    @cached_property
    def places(self) -> Rows:
        """Return the flat indices of scored readings."""
        return np.flatnonzero(self.scored)

    @cached_property
    def rows(self) -> Rows:
        """Return the row of each scored reading."""
        rows: Rows = self.places // max(1, self.scored.shape[1])
        return rows

    @staticmethod
    def earlier(table: Array, late: Mapping[int, int]) -> Array:
        """Return an array of readings with columns shifted to earlier rows; the last rows become NaN.

        Args:
            late: Index of a column → number of rows.
        """
        moved = table.copy()
        for j, rows in late.items():
            if rows:
                moved[:, j] = np.nan
                moved[: max(0, len(moved) - rows), j] = table[rows:, j]
        return moved


def readings_of(data: Data) -> Readings:
    """Return the readings of a log; its first rows do not count in the likelihood."""
    y, scored = data.y, np.isfinite(data.y)
    scored[: count_unscored(data)] = False
    return Readings(
        scored,
        np.column_stack([_slopes(column) for column in y.T]),
        np.array([_resolution(column) for column in y.T]),
        np.array([float(np.nanstd(c)) if np.isfinite(c).any() else 0.0 for c in y.T]),
    )


def _slopes(column: Array) -> Array:
    """Return the slope per row of a line through the nearest readings."""
    slopes = np.zeros(column.size)
    rows = np.flatnonzero(np.isfinite(column))
    if rows.size < 2 * NEAR + 1:
        return slopes
    windows = np.lib.stride_tricks.sliding_window_view
    t, v = windows(rows.astype(np.float64), 2 * NEAR + 1), windows(column[rows], 2 * NEAR + 1)
    t = t - t.mean(axis=1, keepdims=True)
    inner = np.sum(t * v, axis=1) / np.sum(t * t, axis=1)
    slopes[rows] = np.concatenate([np.full(NEAR, inner[0]), inner, np.full(NEAR, inner[-1])])
    return slopes


def _resolution(column: Array) -> float:
    """Return the quantisation step of a column of readings, or 0 if the column is not quantised."""
    values = np.unique(column[np.isfinite(column)])
    if values.size < 3:
        return 0.0
    steps = np.diff(values)
    least = float(np.median(steps[steps <= 1.5 * steps.min()]))
    whole = np.abs(steps / least - np.rint(steps / least)) < 0.02
    # Printed decimals are a grid too, so a resolution must repeat many values.
    repeated = values.size < 0.2 * np.isfinite(column).sum()
    return least if repeated and float(np.mean(whole)) >= ON_GRID else 0.0
