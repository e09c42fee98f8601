"""Estimates of a test: the thesis' estimator and an unbiased one, with an interval from repetitions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.messages import Message
from plant.bench import Bench
from plant.identification import messages
from plant.identification.cells import Cells, force_of
from plant.identification.command_response import tilt_response
from plant.identification.misfit import find_slip, odd_group
from plant.identification.recordings import Recording

CONFIDENCE = 0.95
MAX_MIRRORED_SPREAD = 0.1  # spread of magnitudes, as a share of their median, within which values differ only in sign


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
    """Result of a test: estimates, notes, warnings, faults, figures, and additions to identify.json."""

    test: str
    estimates: list[Estimate]
    notes: list[Message] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    warnings: list[Message] = field(default_factory=list)
    faults: list[Message] = field(default_factory=list)
    outliers: list[Message] = field(default_factory=list)  # warnings about recordings


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


def outlier_warnings(groups: Sequence[tuple[str, Sequence[Recording], Array]]) -> list[Message]:
    """Return a warning about outlying recordings, if any.

    Args:
        groups: Name of the values, recordings and their values; all groups have equal scatter.
    """
    mirrored = [message for group in groups for message in _mirrored(*group)]
    if mirrored:
        return mirrored
    place, chosen = odd_group([values for _, _, values in groups])
    if not chosen:
        return []
    name, recordings, values = groups[place]
    fields = {"name": name, "value": values[chosen].mean(), "others": np.delete(values, chosen).mean()}
    if len(chosen) == 1:
        return [messages.OUTLIER(recording=recordings[chosen[0]].label, **fields)]
    return [messages.OUTLIERS(recordings=", ".join(recordings[k].label for k in chosen), **fields)]


def slip_warnings(
    m: Measurement, cell: str, values: Sequence[Array], bases: Sequence[Array], scale: float, unit: str
) -> list[Message]:
    """Return a warning if a cell jumps within a recording beside the response that `bases` describe.

    Args:
        scale: Factor from the values to the unit.
    """
    slip = find_slip(values, bases)
    if slip is None:
        return []
    return [messages.SLIP(cell=cell, size=scale * slip[1], unit=unit, recording=m.recordings[slip[0]].label)]


def _mirrored(name: str, recordings: Sequence[Recording], values: Array) -> Iterator[Message]:
    """Yield a warning about values of equal size and opposite sign: those of the fewer recordings, if they differ."""
    sizes, is_negative = np.abs(values), values < 0.0
    if is_negative.all() or not is_negative.any() or np.ptp(sizes) > MAX_MIRRORED_SPREAD * np.median(sizes):
        return
    fewer = is_negative if 2 * is_negative.sum() <= values.size else ~is_negative
    labels = ", ".join(recordings[int(k)].label for k in np.flatnonzero(fewer))
    means = {"value": values[fewer].mean(), "others": values[~fewer].mean()}
    yield messages.MIRRORED_REPETITIONS(name=name, recordings=labels, **means)


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
