"""Figures of merit of a sampled signal, for reports and criteria.

Each function takes time `t` [s], a signal and its target as arrays of shape (samples,). It returns a float in the
signal's own unit, or in seconds.
"""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array


def settling_time(t: Array, signal: Array, target: Array | float, band: float) -> float:
    """Return the time [s] to the last sample outside `target ± band`.

    The time is 0 if no sample is outside, and inf if the signal ends outside.
    """
    outside = np.flatnonzero(np.abs(signal - target) > band)
    if outside.size == 0:
        return 0.0
    if outside[-1] == signal.size - 1:
        return float("inf")
    return float(t[outside[-1]] - t[0])


def overshoot(signal: Array, target: Array | float) -> float:
    """Return the largest excursion beyond the final target, in the direction from the first sample to the target."""
    final = float(np.broadcast_to(target, signal.shape)[-1])
    direction = np.sign(final - signal[0])
    return max(0.0, float(np.max(direction * (signal - final)))) if direction else float(np.max(np.abs(signal - final)))


def rms_error(signal: Array, target: Array | float) -> float:
    """Return the root mean square of `signal - target`."""
    return float(np.sqrt(np.mean((signal - target) ** 2)))


def final_error(signal: Array, target: Array | float) -> float:
    """Return the absolute error at the last sample."""
    return float(np.abs(signal - target)[-1])


def peak(signal: Array) -> float:
    """Return the largest magnitude."""
    return float(np.max(np.abs(signal)))


def effort(t: Array, signal: Array) -> float:
    """Return the time integral of the magnitude [unit s]. The signal is held between samples."""
    return float(np.sum(np.abs(signal[:-1]) * np.diff(t)))
