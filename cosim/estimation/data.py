"""Logs as input of the filter: equal steps, inputs, measurements with their ages, and properties of readings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Flags, Rows
from cosim.estimation.kernel.kernel import Data, Layout
from cosim.estimation.subject.interface import Subject
from cosim.logs.log import Log, slowness

UNSCORED = 1.0  # [s] of each log in which the filter settles; see `count_unscored`
STARTING = 0.2  # [s] within which a measurement counts as initial
UNEVEN = 0.01  # share of a row, or of a quantisation step, from which times or values are not equally spaced
SLOPE_READINGS = 4  # readings on each side for a slope
REPEATED = 0.2  # share of different values below which readings are quantised


def data_of(subject: Subject, log: Log, layout: Layout, interpolated: frozenset[str] = frozenset()) -> Data:
    """Return a log in equal steps, as input of the filter.

    In a missing row, the last command continues and measurements are NaN. States without process noise settle in the
    first rows, which do not count in the likelihood.

    Args:
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
    is_jittery = bool((np.abs(late) > UNEVEN).any())
    if is_jittery:  # The mean command is exact if a command changes within a step; the last one continues.
        edges, times = np.arange(rows + 1, dtype=np.float64), np.append((log.time - log.time[0]) / log.step, rows + 1)
        integral = np.cumsum(np.vstack([np.zeros(u.shape[1]), u[grid] * np.diff(times)[:, None]]), axis=0)
        u[:] = np.array([np.diff(np.interp(edges, times, column)) for column in integral.T]).reshape(u.T.shape).T
    data = Data(
        log.step, float(log.time[0]), u, y, subject.substeps(log.step), 0, interpolated, late if is_jittery else None
    )
    return replace(data, settle=count_unscored(data) if layout.driven else 0)


def count_unscored(data: Data) -> int:
    """Return the number of first rows that do not count in the likelihood, because the filter settles in them."""
    return round(UNSCORED * slowness(data.step) / data.step)


def start_state(subject: Subject, data: Data, measured: Sequence[str], states: Sequence[str]) -> Array:
    """Return the start state of a log: the subject's start values, replaced by initial measurements."""
    start = subject.start_of_log(first_measured(subject, data, measured))
    return np.array([start.get(name, 0.0) for name in states])


def first_measured(subject: Subject, data: Data, measured: Sequence[str]) -> dict[str, float]:
    """Return state → first measurement of the state near the start of the log."""
    states, first = subject.measured_states, {}
    early = data.y[: round(STARTING * slowness(data.step) / data.step) + 1]
    for j, name in enumerate(measured):
        column = early[:, j][~np.isnan(early[:, j])]
        if name in states and len(column):
            first[name] = float(column[0])
    return first


def shifted(table: Array, late: Mapping[int, int]) -> Array:
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


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of one log, shape (rows, outputs).

    Attributes:
        scored: True for readings that count in the likelihood.
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
        """Return the flat indices of the readings that count in the likelihood."""
        return np.flatnonzero(self.scored)


def readings_of(data: Data) -> Readings:
    """Return the readings of a log. The first rows, in which the filter settles, do not count in the likelihood."""
    y, scored = data.y, np.isfinite(data.y)
    scored[: count_unscored(data)] = False
    return Readings(
        scored,
        np.column_stack([_slopes(column) for column in y.T]),
        np.array([_resolution(column) for column in y.T]),
        np.array([float(np.nanstd(c)) if np.isfinite(c).any() else 0.0 for c in y.T]),
    )


def _slopes(column: Array) -> Array:
    """Return the slope per row, at each row, of a line through the nearest readings."""
    slopes = np.zeros(column.size)
    rows = np.flatnonzero(np.isfinite(column))
    if rows.size < 2 * SLOPE_READINGS + 1:
        return slopes
    windows = np.lib.stride_tricks.sliding_window_view
    t, v = windows(rows.astype(np.float64), 2 * SLOPE_READINGS + 1), windows(column[rows], 2 * SLOPE_READINGS + 1)
    t = t - t.mean(axis=1, keepdims=True)
    inner = np.sum(t * v, axis=1) / np.sum(t * t, axis=1)
    slopes[rows] = np.concatenate([np.full(SLOPE_READINGS, inner[0]), inner, np.full(SLOPE_READINGS, inner[-1])])
    return slopes


def _resolution(column: Array) -> float:
    """Return the quantisation step of a column of readings, or 0 if the column is not quantised."""
    values = np.unique(column[np.isfinite(column)])
    if values.size <= 2:
        return 0.0
    steps = np.diff(values)
    least = float(np.median(steps[steps < 2.0 * steps.min()]))
    beside = np.abs(steps / least - np.rint(steps / least)) > UNEVEN
    # Printed decimals form a grid, too, so in quantised readings many values must repeat.
    repeated = values.size < REPEATED * np.isfinite(column).sum()
    return least if repeated and float(np.mean(beside)) <= UNEVEN else 0.0


# Readings of sensors that depend on past values of their output: latency and lag.


def past_reading(sensor: Any, time: Array, values: Array, measured: Array) -> Array:
    """Return the readings of a sensor with latency or lag over time; NaN where they are unknown.

    Args:
        sensor: Latency or lag with its value [s].
        time, values: True output over time [s]; values may begin with NaN.
        measured: Measured readings, from which a lag continues.
    """
    if sensor.late:
        return np.asarray(np.interp(time - sensor.value, time, values, left=np.nan))
    return replayed(time, values, sensor.value, measured)


def replayed(time: Array, values: Array, constant: float, measured: Array) -> Array:
    """Return the readings of a sensor with lag in a replay, which continue from the reading before the first value.

    Args:
        constant: Time constant [s].
        values: True output over time; NaN up to the row at which the replay starts.
        measured: Measured readings. If there is none in this row, the sensor starts in equilibrium.
    """
    known = np.flatnonzero(np.isfinite(values))
    before = int(known[0]) - 1 if known.size else -1
    if before < 0 or not math.isfinite(measured[before]):
        return lagged(time, values, constant)
    filled = values.copy()
    filled[before] = values[before + 1]
    readings = lagged(time, filled, constant, float(measured[before]))
    readings[before] = math.nan
    return readings


def lagged_table(outputs: Array, lags: Array | None, begin: Array | None = None) -> Array:
    """Return the readings of simulated outputs by sensors with lags, shape (rows, outputs).

    Args:
        lags: Time constant of each sensor, in rows; None without lags.
        begin: Readings at the first row, NaN where missing; by default the outputs of that row.
    """
    if lags is None:
        return outputs
    rows, readings = np.arange(len(outputs), dtype=np.float64), outputs.copy()
    for j in np.flatnonzero(lags):
        readings[:, j] = lagged(rows, outputs[:, j], float(lags[j]), math.nan if begin is None else float(begin[j]))
    return readings


def lagged(time: Array, values: Array, constant: float, begin: float = math.nan) -> Array:
    """Return the response l of T·l̇ = y − l to an output y that is linear between rows.

    Args:
        constant: Time constant T [s].
        begin: Reading l at the first value; NaN for l = y.
    """
    known = np.flatnonzero(np.isfinite(values))
    if constant <= 0.0 or known.size < 2:
        return values
    result, before = values.copy(), float(values[known[0]]) if math.isnan(begin) else begin
    result[known[0]] = before
    for last, k in pairwise(known):
        rows = constant / (time[k] - time[last])
        fades = math.exp(-1.0 / rows)
        slope = rows * (values[k] - values[last])  # by which the reading finally lags behind the output
        before = values[k] - slope + fades * (before - values[last] + slope)
        result[k] = before
    return result
