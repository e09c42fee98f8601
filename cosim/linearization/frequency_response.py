"""Frequency response G(jω) = C·(jωI − A)⁻¹·B + D over the relevant frequencies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array
from cosim.linearization.linear_model import Linear
from cosim.linearization.system_structure import poles

POINTS = 400
DECADE = 10.0  # factor below the slowest and above the fastest nonzero pole
Response = NDArray[np.complex128]  # (outputs, inputs, frequencies)


def frequencies(linear: Linear) -> Array:
    """Return frequencies around the poles [rad/s], 0.01 … 100 without poles."""
    sizes = [abs(p) for p in poles(linear.A)]
    nonzero = [s for s in sizes if s > 1e-6 * max(sizes)]
    low, high = (min(nonzero) / DECADE, max(nonzero) * DECADE) if nonzero else (0.01, 100.0)
    exponents = np.linspace(np.floor(np.log10(low)), np.ceil(np.log10(high)), POINTS)
    return np.asarray(10.0**exponents)


def response(linear: Linear, omega: Array) -> Response:
    """Return the frequency response G(jω), shape (outputs, inputs, frequencies)."""
    shifted = 1j * omega[:, None, None] * np.eye(len(linear.A)) - linear.A
    by_frequency = linear.C @ np.linalg.solve(shifted, linear.B) + linear.D
    return np.moveaxis(np.asarray(by_frequency, complex), 0, -1)
