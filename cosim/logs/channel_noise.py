"""White noise of a channel, from its readings alone or with a model."""

from __future__ import annotations

import math

import numpy as np

from cosim.base.arrays import Array

NORMAL_95 = 1.96  # standard deviations within which 95 % of a normal distribution lie
APART = 1.5  # multiple of the usual span of five readings beyond which readings are no neighbours


def noise_level(values: Array) -> float:
    """Return the robust white-noise level of a smooth signal, NaN below 5 values.

    The signal's fourth derivative times h⁴/6 counts as noise.
    """
    return white_noise(surprise(values))


def noise_beside(values: Array, model: Array) -> float:
    """Return the noise of a modelled signal, without the motion that the model explains."""
    return float(np.fmin(noise_level(values), noise_level(values - model)))


def white_noise(left: Array) -> float:
    """Return the white-noise level of these deviations by their median, NaN without any."""
    left = left[np.isfinite(left)]
    return float(1.4826 * np.median(np.abs(left))) if left.size else math.nan


def surprise(values: Array) -> Array:
    """Return the deviation from four neighbours, scaled to the noise; NaN if unknown.

    The cubic through two neighbours on each side predicts y_k, for equal rows as (−1, 4, 4, −1)/6; white noise σ gives
    a
    difference of σ·√(1 + Σ w²). Neighbours of a slow sensor are its own samples, but not across a gap.
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
    for j in range(4):  # Lagrange weights at the centre
        for i in range(4):
            if i != j:
                weights[:, j] *= away[:, i] / (away[:, i] - away[:, j])
    said = np.sum(weights * values[others], axis=1)
    left[centre] = (values[centre] - said) / np.sqrt(1.0 + np.sum(weights**2, axis=1))
    return left
