"""Readings of sensors that depend on past values of their output: latency and lag."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from cosim.base.arrays import Array


def past_reading(sensor: Any, time: Array, values: Array) -> Array:
    """Return the reading of a late or lagging sensor over time, NaN where it is unknown.

    Args:
        sensor: Latency or lag with its value [s].
        time, values: Output over time; values may begin with NaN.
    """
    if sensor.late:
        return np.asarray(np.interp(time - sensor.value, time, values, left=np.nan))
    return lagged(time, values, sensor.value)


def lagged(time: Array, values: Array, constant: float) -> Array:
    """Return the response of T·l̇ = y − l to an output that is straight from row to row, from l = y at its first value.

    Args:
        constant: Time constant T [s].
    """
    known = np.flatnonzero(np.isfinite(values))
    if constant <= 0.0 or known.size < 2:
        return values
    result, before = values.copy(), float(values[known[0]])
    for last, k in pairwise(known):
        rows = constant / (time[k] - time[last])
        fades = math.exp(-1.0 / rows)
        slope = rows * (values[k] - values[last])  # what the reading finally falls behind
        before = values[k] - slope + fades * (before - values[last] + slope)
        result[k] = before
    return result


def lagged_table(outputs: Array, lags: Array | None) -> Array:
    """Return the readings of lagging sensors.

    Args:
        lags: Time constant of each output's sensor in rows.
    """
    if lags is None:
        return outputs
    rows = np.arange(len(outputs), dtype=np.float64)
    return np.column_stack([lagged(rows, y, constant) for y, constant in zip(outputs.T, lags, strict=True)])
