"""Logs as input of the filter: equal steps, measurements, and the age of each reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.kernel.kernel import Data, Layout
from cosim.logs.log import Log, slowness
from cosim.subject.interface import Subject

UNSCORED = 1.0  # [s] of each log in which the filter settles; see `unscored`
MOST_ROWS, FOLDS = 40, 20  # rows of all tables up to which each is held out alone; parts of larger tables
JITTER = 0.01  # share of a row from which rows are not equally spaced


def as_data(
    subject: Subject, log: Log, layout: Layout, settle: float, interpolated: frozenset[str] = frozenset()
) -> Data:
    """Return a log in equal steps.

    A missing row holds its command and has no measurement.

    Args:
        settle: Time until lags have forgotten an unknown start [s], see `settling`.
    """
    if log.table:
        return _as_table(log, layout)
    measured = layout.outputs
    grid = log.grid
    rows = int(grid[-1]) + 1
    held = np.searchsorted(grid, np.arange(rows), side="right") - 1
    u = np.column_stack([log.inputs[name][held] for name in layout.inputs])
    y = np.full((rows, len(measured)), np.nan)
    for j, name in enumerate(measured):
        if name in log.outputs:
            y[grid, j] = log.outputs[name]
    away = np.zeros((rows, 1))
    away[grid, 0] = grid - (log.time - log.time[0]) / log.step  # rows by which a reading is older than its row
    late = None
    if np.max(np.abs(away)) > JITTER:
        late = np.repeat(away, len(measured), axis=1)
        u = _as_acted(log, u, grid)
    data = Data(log.step, float(log.time[0]), u, y, subject.substeps(log.step), 0, interpolated, late)
    return replace(data, settle=int(min(settle / log.step, unscored(data))))


def _as_table(log: Log, layout: Layout) -> Data:
    """Return a table, in which outputs depend on the inputs of their own row."""
    u = np.column_stack([log.inputs[name] for name in layout.inputs])
    nothing = np.full(log.rows, np.nan)
    y = np.column_stack([log.outputs.get(name, nothing) for name in layout.outputs])
    return Data(log.step, 0.0, u, y, 1, interpolated=frozenset(layout.inputs), table=True)


def folds(logs: Sequence[Data]) -> list[Data]:
    """Return tables in parts for cross-validation, without unmeasured rows.

    Each row is a part, or evenly spread rows are for many rows.
    """
    measured = [np.flatnonzero(np.isfinite(data.y).any(axis=1)) for data in logs]
    total = sum(rows.size for rows in measured)
    parts = []
    for data, rows in zip(logs, measured, strict=True):
        count = rows.size if total <= MOST_ROWS else max(1, round(FOLDS * rows.size / total))
        parts += [replace(data, u=data.u[rows[k::count]], y=data.y[rows[k::count]]) for k in range(count)]
    return parts


def _as_acted(log: Log, u: Array, grid: Rows) -> Array:
    """Return the mean of each command over each equal step.

    The integral of a command is exact if the command changes within a step.
    """
    edges = np.arange(len(u) + 1, dtype=np.float64)
    given = (log.time - log.time[0]) / log.step
    commands = u[grid]
    lasting = np.vstack([np.zeros(u.shape[1]), np.cumsum(commands[:-1] * np.diff(given)[:, None], axis=0)])
    # The last command continues, and the first command also acts before its row.
    times = np.concatenate([[min(0.0, given[0]) - 1.0], given, [edges[-1] + 1.0]])
    before, after = (lasting[k] + commands[k] * (times[k] - given[k]) for k in (0, -1))
    total = np.vstack([before, lasting, after])
    return np.column_stack([np.diff(np.interp(edges, times, column)) for column in total.T])


def unscored(data: Data) -> int:
    """Return the rows before scoring starts, in which the filter settles; 0 for a table."""
    if data.table:
        return 0
    return round(UNSCORED * slowness(data.step) / data.step)
