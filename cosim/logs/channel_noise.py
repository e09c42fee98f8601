"""White noise of a channel, from its readings alone or with a model."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np

from cosim.core.arrays import Array

NORMAL_95 = 1.96  # 95 % limits of a normal distribution, in standard deviations
APART = 1.5  # multiple of the usual span of five readings beyond which readings are no neighbours


def noise_level(values: Array) -> float:
    """Return the white-noise level of a smooth signal, by a robust estimate; NaN for fewer than 5 values.

    The signal's fourth derivative times h⁴/6 counts as noise.
    """
    return white_noise(surprise(values))


def least_noise_level(values: Array, model: Array) -> float:
    """Return the noise level of a signal, excluding motion that the model's output explains."""
    return float(np.fmin(noise_level(values), noise_level(values - model)))


def white_noise(deviations: Array) -> float:
    """Return the standard deviation of white noise, estimated by the median of deviations; NaN without any."""
    deviations = deviations[np.isfinite(deviations)]
    return float(1.4826 * np.median(np.abs(deviations))) if deviations.size else math.nan


def surprise(values: Array) -> Array:
    """Return each reading's deviation from its four neighbours, scaled to the noise level; NaN if unknown.

    The cubic through two neighbours on each side predicts y_k, for equal rows as (−1, 4, 4, −1)/6; white noise σ gives
    a difference of σ·√(1 + Σ w²). Neighbours of a slow sensor are its own samples, but not across a gap.
    """
    deviations = np.full(values.size, np.nan)
    rows = np.flatnonzero(np.isfinite(values))
    if rows.size < 5:
        return deviations
    near = np.lib.stride_tricks.sliding_window_view(rows, 5)
    span = near[:, 4] - near[:, 0]
    near = near[span <= APART * np.median(span)]
    centre, others = near[:, 2], near[:, [0, 1, 3, 4]]
    distances = (others - centre[:, None]).astype(np.float64)
    weights = np.ones_like(distances)
    for j, i in permutations(range(4), 2):  # Lagrange weights at the centre
        weights[:, j] *= distances[:, i] / (distances[:, i] - distances[:, j])
    predicted = np.sum(weights * values[others], axis=1)
    deviations[centre] = (values[centre] - predicted) / np.sqrt(1.0 + np.sum(weights**2, axis=1))
    return deviations
