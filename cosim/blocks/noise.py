"""Sensor noise that a connection adds to its value: Gaussian noise and a bias."""

from __future__ import annotations

import hashlib
from array import array

import numpy as np

from cosim.base.arrays import Array


def stream(seed: int, name: str) -> np.random.Generator:
    """Return an independent random stream for a noise source. Adding a source does not change the streams of others."""
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return np.random.default_rng([seed, key])


def samples_of(rng: np.random.Generator, variance: float, bias: float, count: int) -> Array:
    """Return samples of bias + √variance·n in the signal's unit. n is standard normal."""
    samples: Array = bias + np.sqrt(variance) * rng.standard_normal(count)
    return samples


def gaussian(rng: np.random.Generator, variance: float, bias: float, count: int) -> array[float]:
    """Return the samples of `samples_of` for loops over single values."""
    return array("d", samples_of(rng, variance, bias, count).tobytes())
