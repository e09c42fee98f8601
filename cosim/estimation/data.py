"""Logs as input of the filter: equal steps, measurements, and the age of each reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.estimation.kernel.kernel import Data, Layout
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import Log, slowness

UNSCORED = 1.0  # [s] of each log in which the filter settles; see `count_unscored`
STARTING = 0.2  # [s] within which a measurement counts as initial
JITTER = 0.01  # share of a row from which rows are not equally spaced


def data_of(
    subject: Subject, log: Log, layout: Layout, settle: float, interpolated: frozenset[str] = frozenset()
) -> Data:
    """Return a log in equal steps.

    In a missing row, the previous command continues and measurements are missing.

    Args:
        settle: Time [s] after which an unknown start state is negligible.
        interpolated: Inputs interpolated between rows; others are held.
    """
    grid = log.grid
    rows = int(grid[-1]) + 1
    last = np.searchsorted(grid, np.arange(rows), side="right") - 1
    u = np.column_stack([np.zeros((rows, 0)), *(log.inputs[name][last] for name in layout.inputs)])  # perhaps none
    y = np.full((rows, len(layout.outputs)), np.nan)
    nothing = np.full(log.rows, np.nan)
    y[grid] = np.column_stack([log.outputs.get(name, nothing) for name in layout.outputs])
    late = np.zeros_like(y)
    late[grid] = (grid - (log.time - log.time[0]) / log.step)[:, None]  # rows by which a reading is older than its row
    is_jittery = bool((np.abs(late) > JITTER).any())
    if is_jittery:
        u = _mean_commands(log, u, grid)
    data = Data(
        log.step, float(log.time[0]), u, y, subject.substeps(log.step), 0, interpolated, late if is_jittery else None
    )
    return replace(data, settle=int(min(settle / log.step, count_unscored(data))))


def _mean_commands(log: Log, u: Array, grid: Rows) -> Array:
    """Return the mean command over each equal step.

    The integral of a command is exact if the command changes within a step.
    """
    edges = np.arange(len(u) + 1, dtype=np.float64)
    rows = (log.time - log.time[0]) / log.step
    commands = u[grid]
    integral = np.vstack([np.zeros(u.shape[1]), np.cumsum(commands[:-1] * np.diff(rows)[:, None], axis=0)])
    # The last command continues, and the first command also acts before its row.
    times = np.concatenate([[min(0.0, rows[0]) - 1.0], rows, [edges[-1] + 1.0]])
    before, after = (integral[k] + commands[k] * (times[k] - rows[k]) for k in (0, -1))
    total = np.vstack([before, integral, after])
    return np.column_stack([np.diff(np.interp(edges, times, column)) for column in total.T])


def count_unscored(data: Data) -> int:
    """Return the number of rows before scoring, in which the filter settles."""
    return round(UNSCORED * slowness(data.step) / data.step)


def start_state(subject: Subject, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """Return the subject's start state, with initial measurements inserted."""
    start = subject.start_of_log(first_measured(subject, data, measured))
    return np.array([start.get(name, 0.0) for name in states])


def first_measured(subject: Subject, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """Return state → first measurement near the start."""
    states, first = subject.measured_states, {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in states and len(column):
            first[name] = float(column[0])
    return first
