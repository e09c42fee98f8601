"""Array types of the package, and the correlation of two signals over their lag, with missing values."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; docstrings name the shape
Rows = NDArray[np.intp]  # indices into an array
Flags = NDArray[np.bool_]  # a truth value per element
NamedValues = Mapping[str, float]  # of parameters, states or signals
NamedArrays = Mapping[str, Array]  # of signals over the rows of a log

# Results beyond the range of a double become infinite or NaN. Callers judge them, so numpy need not warn.
far_beyond = np.errstate(over="ignore", invalid="ignore")


def correlation_at_lags(before: Array, after: Array, lags: int) -> Array:
    """Return the correlation of `before`(t) with `after`(t + k) for lags k = −`lags` … `lags` rows."""
    return correlation(*centre(before), *centre(after), lags)[0]


def centre(values: Array) -> tuple[Array, Array]:
    """Return the values minus their mean, with 0 for missing ones, and 1 for each finite value, else 0."""
    finite = np.isfinite(values)
    mean = float(values[finite].mean()) if finite.any() else 0.0
    return np.where(finite, values - mean, 0.0), finite.astype(np.float64)


def correlation(a: Array, weight_a: Array, b: Array, weight_b: Array, lags: int) -> tuple[Array, Array]:
    """Return the correlation of a(t) with b(t + k) for k = −lags … lags, and the number of valid pairs per lag."""
    products, pairs = _lagged_products(a, b, lags), np.rint(_lagged_products(weight_a, weight_b, lags))
    counts = float(weight_a.sum()), float(weight_b.sum())
    scale = math.sqrt(float(a @ a) / counts[0] * float(b @ b) / counts[1]) if min(counts) > 0.0 else 0.0
    usable = pairs > 0 if scale > 0.0 else np.zeros(pairs.size, dtype=bool)
    rho = np.full(2 * lags + 1, np.nan)
    rho[usable] = products[usable] / pairs[usable] / scale
    return rho, pairs


def _lagged_products(a: Array, b: Array, lags: int) -> Array:
    """Return Σ_t a(t)·b(t + k) for k = −lags … lags, by FFT."""
    size = 1 << (a.size + lags).bit_length()
    whole = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    return np.concatenate((whole[-lags:], whole[: lags + 1]))
