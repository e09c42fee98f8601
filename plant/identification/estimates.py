"""Estimates of a test: the thesis' estimator and an unbiased one, with an interval from repetitions.

The estimators of all tests share this harness, and the responses of tilt and thrust to recorded commands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import signal, stats

from cosim.core.arrays import Array, Flags
from cosim.model.integrate import rk4, substeps
from cosim.model.namespaces import arrays
from plant.bench import Bench
from plant.identification.recordings import Cells, Recording
from plant.powertrain import servo_angle, servo_rate

LAGS = np.geomspace(0.01, 0.6, 83)  # [s] lags to try, 5 % apart


class Estimate(NamedTuple):
    """An estimate; `scatter` and `calibration` are the standard errors in its 95 % interval."""

    name: str
    unit: str
    thesis: float
    value: float
    low: float
    high: float
    scatter: float
    calibration: float
    repetitions: int
    origin: str
    truth: float = float("nan")

    @property
    def half_width(self) -> float:
        """Return half the width of the interval."""
        return 0.5 * (self.high - self.low)

    @property
    def covers_truth(self) -> bool:
        """Return True if the interval contains the true value."""
        return bool(self.low <= self.truth <= self.high)


class Figure(NamedTuple):
    """A figure of the report: lines and points over x, each with label, x, y, style; `counterparts`: of the thesis."""

    title: str
    x_label: str
    y_label: str
    lines: Sequence[tuple[str, Array, Array, str]]
    band: tuple[str, Array, Array, Array] | None = None
    bars: Sequence[tuple[Array, Array, Array]] = ()
    counterparts: Sequence[str] = ()
    log: bool = False


@dataclass
class Result:
    """Result of a test: estimates, notes, warnings, figures, and additions to identify.json.

    Attributes:
        each: Values of each repetition, shape (N, p).
        shifts: Change of the means of `each` by one standard deviation of each calibration point, shape (points, p).
    """

    test: str
    estimates: list[Estimate]
    notes: list[str] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    each: Array = field(default_factory=lambda: np.empty((0, 0)))
    shifts: Array = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True)
class Measurement:
    """The recordings of a test, its cells and the assumed bench.

    `truth` is the simulated bench; None for a measured one.
    """

    recordings: Sequence[Recording]
    cells: Cells
    bench: Bench
    test: Any
    truth: Bench | None = None

    def force(self, r: Recording, channel: str) -> Array:
        """Return the force of a cell without its tare."""
        cell, volts = self.cells[channel], r.volts[channel]
        drift = float(volts[r.rows(self.test.rest)].mean()) - cell.zero
        return cell.force(volts - drift)

    def thesis_force(self, r: Recording, channel: str) -> Array:
        """Return the force as in the thesis: with tare, by a piecewise cubic through every calibration point."""
        return replace(self.cells[channel], smooth=False).force(r.volts[channel])

    def tilt(self, r: Recording) -> Array:
        """Return a run's tilt [rad], computed by the bench equations."""
        return tilt_response(self.bench, r.time, r.servo_duty, np.array([self.bench.lag]))[:, 0]

    def gram_force(self, r: Recording, channel: str) -> Array:
        """Return the force of a cell without its tare [gf]."""
        return 1000.0 / self.bench.gravity * self.force(r, channel)

    def inside(self, r: Recording) -> Flags:
        """Return the rows in the window of the test."""
        return r.rows(self.test.window)

    def printed_factor(self, channel: str, function: Callable[[Array], Array]) -> float:
        """Return the factor between all readings and a function of the commanded tilt, as in the thesis."""
        top = bottom = 0.0
        for r in self.recordings:
            basis = function(r.commanded_tilt(self.bench)[self.inside(r)])
            top += float(self.thesis_force(r, channel)[self.inside(r)] @ basis)
            bottom += float(basis @ basis)
        return top / bottom


def tilt_response(bench: Bench, time: Array, servo_duty: Array, lags: Array) -> Array:
    """Return the tilt [rad], shape (rows, lags), with dead band and rate limit, settled at the start."""
    return _tilt_response(bench, float(np.median(np.diff(time))), servo_duty.tobytes(), tuple(lags))


@lru_cache(maxsize=128)  # simulated repetitions share commands
def _tilt_response(bench: Bench, h: float, servo_duty: bytes, lags: tuple[float, ...]) -> Array:
    m, tau = arrays(), np.array(lags)
    target = servo_angle(np.frombuffer(servo_duty), bench.servo_neutral, bench.servo_slope).tolist()
    n, tilt = substeps(h, bench.substep), [np.full(tau.size, target[0])]

    def rate(t: float, x: tuple[Array, ...], u: tuple[float, ...]) -> tuple[Array, ...]:
        return (servo_rate(m, u[0], x[0], tau, bench.servo_dead_band, bench.servo_speed),)

    for command in target[:-1]:
        state = (tilt[-1],)
        for _ in range(n):
            state = rk4(rate, 0.0, state, (command,), h / n)
        tilt.append(state[0])
    return np.array(tilt)


def held_lag(values: Array, step: float, lag: float) -> Array:
    """Return the exact first-order lag of a piecewise constant command."""
    if lag <= 0:
        return values
    share, out = 1.0 - np.exp(-step / lag), np.empty_like(values)
    out[0] = values[0]
    out[1:] = signal.lfilter([share], [1.0, share - 1.0], values[:-1], zi=[(1.0 - share) * values[0]])[0]
    return out


def low_pass(values: Array, step: float, lag: float) -> Array:
    """Return the first-order low pass of interpolated values along the first axis (trapezoidal rule)."""
    if lag <= 0:
        return values
    ratio = 2.0 * lag / step
    b, a = np.array([1.0, 1.0]) / (ratio + 1.0), np.array([1.0, (1.0 - ratio) / (1.0 + ratio)])
    start = ((ratio - 1.0) / (ratio + 1.0) + 1.0 / (ratio + 1.0)) * values[:1]
    return np.asarray(signal.lfilter(b, a, values, axis=0, zi=start)[0])


def interval(each: Array, shifts: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """Return mean, half-width of the 95 % interval, and the standard errors from scatter and from calibration.

    Degrees of freedom follow Welch and Satterthwaite: the calibration error is known, the scatter estimated.

    Args:
        each: Values, shape (N, p).
        shifts: Change of the means by each calibration point's error, shape (points, p).
    """
    n = each.shape[0]
    scatter = each.std(axis=0, ddof=1) / np.sqrt(n)
    calibration = np.zeros_like(scatter) if shifts is None else np.sqrt((shifts**2).sum(axis=0))
    variance = scatter**2 + calibration**2
    freedom = (n - 1) * variance**2 / np.maximum(scatter**4, 1e-300)
    half = stats.t.ppf(0.975, np.minimum(freedom, 1e6)) * np.sqrt(variance)
    return each.mean(axis=0), half, scatter, calibration


def make_estimates(
    numbers: Sequence[tuple[str, str, float, float]], each: Array, origin: str, shifts: Array | None = None
) -> list[Estimate]:
    """Return estimates from values of N repetitions, shape (N, p), and shifts.

    Args:
        numbers: Name, unit, thesis' estimate and true value of each number.
    """
    columns = np.stack(interval(each, shifts), axis=1).tolist()
    return [
        Estimate(name, unit, thesis, value, value - half, value + half, scatter, calibration, len(each), origin, truth)
        for (name, unit, thesis, truth), (value, half, scatter, calibration) in zip(numbers, columns, strict=True)
    ]


def estimated(
    m: Measurement,
    test: str,
    values: Callable[[Measurement], Array],
    channels: str,
    thesis: Mapping[str, float],
    origin: str,
) -> Result:
    """Return the result of a test with its estimates.

    Args:
        values: Function from the measurement to the values of each repetition, shape (N, p).
        channels: Cells whose calibration points are varied.
        thesis: Estimate of the thesis of each number.
    """
    each = values(m)
    rows = []
    for c in channels:
        cell = m.cells[c]
        for k in np.flatnonzero(cell.loads) if cell.error > 0 else ():  # zero load is exact
            loads = cell.loads.copy()
            loads[k] += cell.error
            moved = replace(m, cells={**m.cells, c: replace(cell, loads=loads)})
            rows.append(values(moved).mean(axis=0) - each.mean(axis=0))
    shifts = np.array(rows) if rows else np.zeros((0, each.shape[1]))
    numbers = []
    for name, by_thesis in thesis.items():
        parameter = name.removesuffix("_of_thrust")
        declared = m.bench.declared.get(parameter)  # the factor of a projection is not a model parameter, and ideally 1
        truth = getattr(m.truth, parameter, 1.0) if m.truth else float("nan")
        numbers.append((name, declared.unit if declared else "1", by_thesis, truth))
    return Result(test, make_estimates(numbers, each, origin, shifts), each=each, shifts=shifts)


def least(grid: Array, cost: Array) -> Array:
    """Return the position of the minimum of each row of costs over a logarithmic grid, refined by a parabola."""
    k = np.clip(np.argmin(cost, axis=1), 1, grid.size - 2)
    rows = np.arange(cost.shape[0])
    before, here, after = cost[rows, k - 1], cost[rows, k], cost[rows, k + 1]
    x, h = np.log(grid), np.log(grid[1] / grid[0])
    curvature = before - 2.0 * here + after
    offset = np.divide(before - after, 2.0 * curvature, out=np.zeros_like(here), where=curvature > 0)
    return np.asarray(np.exp(x[k] + h * np.clip(offset, -1.0, 1.0)))
