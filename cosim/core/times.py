"""Comparison of times. Two times are equal if they differ only by rounding or by a tiny share of a step."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.arrays import Array

# Times are equal if they differ by at most this number of spacings of doubles, and this share of a step.
TIME_TOLERANCE_ULPS = 4
TIME_TOLERANCE_SHARE = 1e-9
STEP_COUNT_TOLERANCE = 1e-9  # relative tolerance of a whole number of steps
MAX_STEP_COUNT = 1e18  # steps, more than any run has


def rounding(t: float, step: float = 0.0) -> float:
    """Return the tolerance [s] for times equal to t, where steps have the length `step` [s]."""
    return TIME_TOLERANCE_ULPS * math.ulp(t) + TIME_TOLERANCE_SHARE * step


def roundings(times: Array, step: float = 0.0) -> Array:
    """Return `rounding` of many times."""
    return TIME_TOLERANCE_ULPS * np.spacing(np.abs(times)) + TIME_TOLERANCE_SHARE * step


def first_point(at: float, start: float, step: float) -> int:
    """Return the first communication point at or after a time [s]."""
    return math.ceil(steps_in(at - start - rounding(max(abs(at), abs(start)), step), step))


def last_point(at: float, start: float, step: float) -> int:
    """Return the last communication point at or before a time [s]."""
    return math.floor(steps_in(at - start + rounding(max(abs(at), abs(start)), step), step))


def difference(end: float, begin: float) -> float:
    """Return end − begin [s], rounded to the digits that doubles of this size can represent."""
    spacing = TIME_TOLERANCE_ULPS * math.ulp(max(abs(end), abs(begin)))
    return round(end - begin, math.floor(-math.log10(spacing)))


def whole_steps(time: float, step: float) -> int:
    """Return the number of steps nearest to a time, at least 1."""
    return max(1, round(steps_in(time, step)))


def steps_in(time: float, step: float) -> float:
    """Return time/step, limited to ±MAX_STEP_COUNT."""
    return min(max(time / step, -MAX_STEP_COUNT), MAX_STEP_COUNT)
