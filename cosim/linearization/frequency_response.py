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
    moving = [s for s in sizes if s > 1e-6 * max(sizes)] if any(sizes) else []
    low, high = (min(moving) / DECADE, max(moving) * DECADE) if moving else (0.01, 100.0)
    exponents = np.linspace(np.floor(np.log10(low)), np.ceil(np.log10(high)), POINTS)
    return np.asarray(10.0**exponents)


def response(linear: Linear, omega: Array) -> Response:
    """Return G(jω), shape (outputs, inputs, frequencies)."""
    n = len(linear.A)
    found = np.empty((len(linear.outputs), len(linear.inputs), omega.size), complex)
    for k, w in enumerate(omega):
        inner = np.linalg.solve(1j * w * np.eye(n) - linear.A, linear.B) if n else np.zeros((0, len(linear.inputs)))
        found[:, :, k] = linear.C @ inner + linear.D
    return found
