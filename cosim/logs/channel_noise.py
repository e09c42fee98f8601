"""How much white noise a channel has, from the readings alone or beside a model."""

from __future__ import annotations

import math

import numpy as np

from cosim.base.arrays import Array

NORMAL_95 = 1.96  # standard deviations within which 95 % of a normal distribution lie
APART = 1.5  # times the usual span of five readings, beyond which they are no neighbours


def noise_level(values: Array) -> float:
    """Return the standard deviation of white noise on a smooth signal, robustly; NaN below 5 values.

    A smooth signal leaves its fourth derivative times h⁴/6, which counts as noise.
    """
    return white_noise(surprise(values))


def noise_beside(values: Array, model: Array) -> float:
    """Return the noise on a signal that a model follows: what the model moves too is none. The lesser counts."""
    return float(np.fmin(noise_level(values), noise_level(values - model)))


def white_noise(left: Array) -> float:
    """Return standard deviation of the white noise that leaves these surprises, by their median; NaN without any."""
    left = left[np.isfinite(left)]
    return float(1.4826 * np.median(np.abs(left))) if left.size else math.nan


def surprise(values: Array) -> Array:
    """Return how far values are from what four neighbours say, scaled to be as large as the noise; NaN for unknown.

    The cubic through two on each side predicts y_k, between equal rows as (−1, 4, 4, −1)/6; white noise σ leaves
    σ·√(1 + Σ w²) of difference. Neighbours of a sensor slower than the log are its own samples, not those
    beyond a gap.
    """
    left = np.full(values.size, np.nan)
    rows = np.flatnonzero(np.isfinite(values))
    if rows.size < 5:
        return left
    near = np.lib.stride_tricks.sliding_window_view(rows, 5)
    span = near[:, 4] - near[:, 0]
    near = near[span <= APART * np.median(span)]
    centre, others = near[:, 2], near[:, [0, 1, 3, 4]]
    away = (others - centre[:, None]).astype(np.float64)
    weights = np.ones_like(away)
    for j in range(4):  # Lagrange's, at the centre
        for i in range(4):
            if i != j:
                weights[:, j] *= away[:, i] / (away[:, i] - away[:, j])
    said = np.sum(weights * values[others], axis=1)
    left[centre] = (values[centre] - said) / np.sqrt(1.0 + np.sum(weights**2, axis=1))
    return left
