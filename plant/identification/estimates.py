"""Estimates of a test: the thesis' estimator and an unbiased one, with an interval from repetitions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from plant.bench import Bench
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import tilt_response
from plant.identification.recordings import Recording

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
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


@dataclass(frozen=True)
class Figure:
    """A figure of the report: lines and points over x; each has label, x, y, style. `log`: logarithmic x axis."""

    title: str
    x_label: str
    y_label: str
    lines: Sequence[tuple[str, Array, Array, str]]
    band: tuple[str, Array, Array, Array] | None = None
    bars: Sequence[tuple[Array, Array, Array]] = ()
    counterpart: str = ""
    log: bool = False


@dataclass
class Result:
    """Result of a test: estimates, notes, warnings, figures, and additions to identify.json."""

    test: str
    estimates: list[Estimate]
    notes: list[str] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Measurement:
    """The recordings of a test, cells and assumed bench; `truth` is the simulated bench, None for a measured one."""

    recordings: Sequence[Recording]
    cells: Cells
    bench: Bench
    test: Any
    truth: Bench | None = None
    tilts: dict[bytes, Array] = field(default_factory=dict)  # tilt by command; simulated repetitions share commands

    @property
    def gram(self) -> float:
        """Return gram-force per newton at the bench's gravity."""
        return 1000.0 / self.bench.gravity

    def force(self, r: Recording, channel: str, using: Cells | None = None) -> Array:
        """Return the force of a cell without its tare."""
        return force_of(r, using or self.cells, channel, self.test.rest)

    def printed_force(self, r: Recording, channel: str) -> Array:
        """Return a cell's force as in the thesis, with tare."""
        return force_of(r, self.cells, channel, None)

    def tilt(self, r: Recording) -> Array:
        """Return a run's tilt [rad] by the equations."""
        if (key := r.servo_duty.tobytes()) not in self.tilts:
            self.tilts[key] = tilt_response(self.bench, r.time, r.servo_duty, np.array([self.bench.lag]))[:, 0]
        return self.tilts[key]

    def true(self, name: str) -> float:
        """Return the true value, NaN if unknown."""
        return getattr(self.truth, name) if self.truth else float("nan")

    def alike(self) -> list[Recording]:
        """Return recordings with the first one's number of rows."""
        count = self.recordings[0].rows(self.test.window).sum()
        return [r for r in self.recordings if r.rows(self.test.window).sum() == count]


PerRepetition = Callable[[Cells], Array]  # → shape (repetitions, numbers)


def interval(each: Array, shifts: Array) -> tuple[Array, Array, Array, Array]:
    """Return mean, half-width of the 95 % interval, and the standard errors from scatter and from calibration.

    Degrees of freedom follow Welch and Satterthwaite: the calibration error is known, the scatter estimated.

    Args:
        each: Values, shape (N, p).
        shifts: Change of the means by each calibration point's error, shape (points, p).
    """
    from scipy import stats

    n = each.shape[0]
    scatter = each.std(axis=0, ddof=1) / np.sqrt(n)
    calibration = np.sqrt((shifts**2).sum(axis=0)) if shifts.size else np.zeros_like(scatter)
    variance = scatter**2 + calibration**2
    freedom = (n - 1) * variance**2 / np.maximum(scatter**4, 1e-300)
    half = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, np.minimum(freedom, 1e6)) * np.sqrt(variance)
    return each.mean(axis=0), half, scatter, calibration


def shifts_of(per_repetition: PerRepetition, cells: Cells, channels: Sequence[str], each: Array | None = None) -> Array:
    """Return the change of the means by one standard deviation of each calibration point, shape (points, p).

    Args:
        per_repetition: Function from the cells to the values of each repetition, shape (N, p).
        channels: Cells whose points change.
        each: Values with unchanged cells, if known.
    """
    base = (per_repetition(cells) if each is None else each).mean(axis=0)
    rows = [
        per_repetition({**cells, c: cells[c].shift_load(k)}).mean(axis=0) - base
        for c in channels
        for k in range(cells[c].loads.size)
        if cells[c].error > 0 and cells[c].loads[k] != 0  # zero load is exact
    ]
    return np.array(rows) if rows else np.zeros((0, base.size))


def make_estimates(
    names: Sequence[tuple[str, str, float, float]], each: Array, shifts: Array, origin: str
) -> list[Estimate]:
    """Return estimates from repetitions (N, p) and shifts.

    Args:
        names: Name, unit, thesis' estimate and true value of each number.
    """
    value, half, scatter, calibration = interval(each, shifts)
    return [
        Estimate(
            name, unit, thesis, float(v), float(v - h), float(v + h), float(s), float(c), each.shape[0], origin, truth
        )
        for (name, unit, thesis, truth), v, h, s, c in zip(names, value, half, scatter, calibration, strict=True)
    ]


def pseudo_values(estimate: Callable[[Rows], Array], n: int) -> Array:
    """Return the jackknife pseudo-values of an estimate over n repetitions, shape (n, p).

    Args:
        estimate: Function from the selected repetitions to the estimate.
    """
    whole = estimate(np.arange(n))
    others = np.array([estimate(np.delete(np.arange(n), k)) for k in range(n)])
    return np.asarray(n * whole - (n - 1) * others)


def least(grid: Array, cost: Array) -> Array:
    """Return the position of the minimum of each row of costs over a logarithmic grid, refined by a parabola."""
    k = np.clip(np.argmin(cost, axis=1), 1, grid.size - 2)
    rows = np.arange(cost.shape[0])
    before, here, after = cost[rows, k - 1], cost[rows, k], cost[rows, k + 1]
    x, h = np.log(grid), np.log(grid[1] / grid[0])
    curvature = before - 2.0 * here + after
    offset = np.divide(before - after, 2.0 * curvature, out=np.zeros_like(here), where=curvature > 0)
    return np.asarray(np.exp(x[k] + h * np.clip(offset, -1.0, 1.0)))
