"""What there is to the readings of a log beside their values: which are scored, their slopes, their resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cosim.base.arrays import Array, Flags, Rows

NEAR = 4  # readings on each side, over which a slope is taken
ON_GRID = 0.99  # of the steps between readings, from which they are taken to be quantised


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of one log, shape (rows, outputs).

    scored:     which take part in a likelihood
    slopes:     how fast each changes, per row, by the readings about it; 0 where that is unknown
    resolution: step in which the readings of each output come; 0 where they come in no steps
    spread:     standard deviation of the readings of each output
    """

    scored: Flags
    slopes: Array
    resolution: Array
    spread: Array

    @cached_property
    def places(self) -> Rows:
        """Where those scored stand in a table read row by row."""
        places: Rows = np.flatnonzero(self.scored)
        return places

    @cached_property
    def rows(self) -> Rows:
        """Row of each of those scored."""
        rows: Rows = self.places // max(1, self.scored.shape[1])
        return rows

    @staticmethod
    def earlier(table: Array, late: Mapping[int, int]) -> Array:
        """Return a table of the readings' size, the columns of some outputs put so many whole rows earlier."""
        moved = table.copy()
        for j, rows in late.items():
            if rows:
                moved[:, j] = np.nan
                moved[: max(0, len(moved) - rows), j] = table[rows:, j]
        return moved


def readings_of(y: Array, unscored: int) -> Readings:
    """Return the readings of a log of which the first rows are not scored."""
    scored = np.isfinite(y)
    scored[:unscored] = False
    columns = list(y.T)
    return Readings(
        scored,
        np.column_stack([_slopes(column) for column in columns]) if columns else np.zeros_like(y),
        np.array([_resolution(column) for column in columns]),
        np.array([float(np.nanstd(c)) if np.isfinite(c).any() else 0.0 for c in columns]),
    )


def readings_of_table(parts: Sequence[Array]) -> list[Readings]:
    """Return readings of a table in parts: no neighbours, no slopes; resolution and spread are those of the whole."""
    whole = readings_of(np.vstack(parts), 0)
    return [Readings(np.isfinite(y), np.zeros_like(y), whole.resolution, whole.spread) for y in parts]


def _slopes(column: Array) -> Array:
    """Change per row, of the straight line through the nearest readings."""
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
    """Return the step in which readings come, where nearly all differ by whole numbers of the smallest one."""
    values = np.unique(column[np.isfinite(column)])
    if values.size < 3:
        return 0.0
    steps = np.diff(values)
    least = float(np.median(steps[steps <= 1.5 * steps.min()]))
    whole = np.abs(steps / least - np.rint(steps / least)) < 0.02
    # printed with few digits, everything is on some grid: a resolution is one that repeats many values
    repeated = values.size < 0.2 * np.isfinite(column).sum()
    return least if repeated and float(np.mean(whole)) >= ON_GRID else 0.0
