"""Comparison of times. Two times are equal if they differ only by rounding or by a tiny share of a step."""

from __future__ import annotations

import math

import numpy as np

from cosim.core.arrays import Array

ULPS = 4  # tolerance of equal times, in spacings of doubles
SHARE = 1e-9  # share of a step by which equal times may differ
MOST = 1e18  # steps, more than any run has


def rounding(t: float, step: float = 0.0) -> float:
    """Return the tolerance [s] within which a time equals t, for steps of length `step` [s]."""
    return ULPS * math.ulp(t) + SHARE * step


def roundings(times: Array, step: float = 0.0) -> Array:
    """Return the tolerance [s] of each of many times, as `rounding` does."""
    return ULPS * np.spacing(np.abs(times)) + SHARE * step


def first_point(at: float, start: float, step: float) -> int:
    """Return the first communication point at or after a time [s]."""
    return math.ceil(steps_in(at - start - rounding(max(abs(at), abs(start)), step), step))


def last_point(at: float, start: float, step: float) -> int:
    """Return the last communication point at or before a time [s]."""
    return math.floor(steps_in(at - start + rounding(max(abs(at), abs(start)), step), step))


def difference(end: float, begin: float) -> float:
    """Return end − begin [s], rounded to the digits that doubles of this size can represent."""
    spacing = ULPS * math.ulp(max(abs(end), abs(begin)))
    return round(end - begin, math.floor(-math.log10(spacing)))


def whole_steps(time: float, step: float) -> int:
    """Return the number of steps nearest to a time, at least 1."""
    return max(1, round(steps_in(time, step)))


def steps_in(time: float, step: float) -> float:
    """Return the number of steps in a time, limited to ±MOST; not necessarily a whole number."""
    return min(max(time / step, -MOST), MOST)
