"""Figures of merit of a sampled signal: what the report prints and the criteria check.

Every function takes time `t` [s], a signal and its target as arrays of shape (samples,) and
returns one float in the signal's own unit (or seconds).
"""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array


def settling_time(t: Array, signal: Array, target: Array | float, band: float) -> float:
    """Time [s] from `t[0]` to the last sample outside `target ± band`; 0 if none is, inf if the last one is."""
    outside = np.flatnonzero(np.abs(signal - target) > band)
    if outside.size == 0:
        return 0.0
    if outside[-1] == signal.size - 1:
        return float("inf")
    return float(t[outside[-1]] - t[0])


def overshoot(signal: Array, target: Array | float) -> float:
    """Largest excursion past the final target, seen in the direction of travel from the first sample."""
    final = float(np.broadcast_to(target, signal.shape)[-1])
    direction = np.sign(final - signal[0])
    return max(0.0, float(np.max(direction * (signal - final)))) if direction else float(np.max(np.abs(signal - final)))


def rms_error(signal: Array, target: Array | float) -> float:
    """Root mean square of `signal - target`."""
    return float(np.sqrt(np.mean((signal - target) ** 2)))


def final_error(signal: Array, target: Array | float) -> float:
    """Absolute error of the last sample."""
    return float(np.abs(signal - target)[-1])


def peak(signal: Array) -> float:
    """Largest magnitude."""
    return float(np.max(np.abs(signal)))


def effort(t: Array, signal: Array) -> float:
    """Integral of the magnitude over time, the command held between samples [unit s]."""
    return float(np.sum(np.abs(signal[:-1]) * np.diff(t)))
