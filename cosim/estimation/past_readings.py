"""Readings of sensors that depend on past values of their output: latency and lag."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from cosim.core.arrays import Array


def past_reading(sensor: Any, time: Array, values: Array, measured: Array | None = None) -> Array:
    """Return the reading of a late or lagging sensor over time, NaN where it is unknown.

    Args:
        sensor: Latency or lag with its value [s].
        time, values: Output over time; values may begin with NaN.
        measured: Measured readings; a lag goes on from the one before the first value, if there is one.
    """
    if sensor.late:
        return np.asarray(np.interp(time - sensor.value, time, values, left=np.nan))
    return lagged(time, values, sensor.value) if measured is None else replayed(time, values, sensor.value, measured)


def replayed(time: Array, values: Array, constant: float, measured: Array) -> Array:
    """Return the readings of a lagging sensor in a replay, which go on from the reading before the first value.

    Args:
        constant: Time constant [s].
        values: Output over time, NaN up to the row where the replay starts.
        measured: Measured readings; without one in this row, the sensor starts settled.
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
    """Return the readings of simulated outputs, shape (rows, outputs), by sensors with lags.

    Args:
        lags: Time constant of each sensor in rows; None without lags.
        begin: Readings at the first row, NaN where missing; by default the outputs of that row.
    """
    if lags is None:
        return outputs
    rows, readings = np.arange(len(outputs), dtype=np.float64), outputs.copy()
    for j in np.flatnonzero(lags):
        readings[:, j] = lagged(rows, outputs[:, j], float(lags[j]), math.nan if begin is None else float(begin[j]))
    return readings


def lagged(time: Array, values: Array, constant: float, begin: float = math.nan) -> Array:
    """Return the response of T·l̇ = y − l to an output that is straight from row to row.

    Args:
        constant: Time constant T [s].
        begin: Reading at the first value; NaN for l = y.
    """
    known = np.flatnonzero(np.isfinite(values))
    if constant <= 0.0 or known.size < 2:
        return values
    result, before = values.copy(), float(values[known[0]]) if math.isnan(begin) else begin
    result[known[0]] = before
    for last, k in pairwise(known):
        rows = constant / (time[k] - time[last])
        fades = math.exp(-1.0 / rows)
        slope = rows * (values[k] - values[last])  # what the reading finally falls behind
        before = values[k] - slope + fades * (before - values[last] + slope)
        result[k] = before
    return result
