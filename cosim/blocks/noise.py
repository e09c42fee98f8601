"""Sensor noise on a connection: Gaussian by variance, and bias."""

from __future__ import annotations

import hashlib
from array import array

import numpy as np

from cosim.base.arrays import Array


def stream(seed: int, name: str) -> np.random.Generator:
    """A random stream of its own for each noise source: adding a source changes no other."""
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return np.random.default_rng([seed, key])


def samples_of(rng: np.random.Generator, variance: float, bias: float, count: int) -> Array:
    """`count` samples of bias + √variance·n, n standard normal, in the unit of the signal."""
    samples: Array = bias + np.sqrt(variance) * rng.standard_normal(count)
    return samples


def gaussian(rng: np.random.Generator, variance: float, bias: float, count: int) -> array[float]:
    """The same for a loop over single samples."""
    return array("d", samples_of(rng, variance, bias, count).tobytes())
