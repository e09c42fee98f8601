"""Responses of tilt and thrust to recorded commands by the bench equations, for fits."""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array
from cosim.model.integrate import rk4, substeps
from cosim.model.namespaces import arrays
from plant.bench import Bench
from plant.powertrain import servo_angle, servo_rate

LAGS = np.geomspace(0.01, 0.6, 83)  # [s] lags to try, 5 % apart


def tilt_response(bench: Bench, time: Array, servo_duty: Array, lags: Array) -> Array:
    """Return the tilt [rad], shape (rows, lags), with dead band and rate limit, settled at the start."""
    m, lags = arrays(), np.asarray(lags, float)
    target = servo_angle(servo_duty, bench.servo_neutral, bench.servo_slope)
    h = float(np.median(np.diff(time)))
    n = substeps(h, bench.substep)
    tilt = np.empty((time.size, lags.size))
    tilt[0] = target[0]

    def rate(t: float, x: tuple[Array, ...], u: tuple[float, ...]) -> tuple[Array, ...]:
        return (servo_rate(m, u[0], x[0], lags, bench.servo_dead_band, bench.servo_speed),)

    for k in range(1, time.size):
        state = (tilt[k - 1],)
        for _ in range(n):
            state = rk4(rate, 0.0, state, (float(target[k - 1]),), h / n)
        tilt[k] = state[0]
    return tilt


def held_lag(values: Array, step: float, lag: float) -> Array:
    """Return the exact first-order lag of a held command."""
    if lag <= 0:
        return values
    share, out = 1.0 - np.exp(-step / lag), np.empty_like(values)
    out[0] = values[0]
    from scipy.signal import lfilter

    out[1:] = lfilter([share], [1.0, share - 1.0], values[:-1], zi=[(1.0 - share) * values[0]])[0]
    return out


def low_pass(values: Array, step: float, lag: float) -> Array:
    """Return the first-order low pass of interpolated values along the first axis (trapezoidal rule)."""
    if lag <= 0:
        return values
    from scipy.signal import lfilter

    ratio = 2.0 * lag / step
    b, a = np.array([1.0, 1.0]) / (ratio + 1.0), np.array([1.0, (1.0 - ratio) / (1.0 + ratio)])
    start = ((ratio - 1.0) / (ratio + 1.0) + 1.0 / (ratio + 1.0)) * values[:1]
    return np.asarray(lfilter(b, a, values, axis=0, zi=start)[0])
