"""What a test says of a number: the thesis' estimator and an unbiased one, with an interval from repetitions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from plant.bench import Bench
from plant.identification.cells import Cell, Cells, force_of
from plant.identification.misfit import odd_group
from plant.identification.recordings import Recording

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """One number; `scatter` and `calibration` are the standard errors that its 95 % interval is made of."""

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
        """Half the width of the interval."""
        return 0.5 * (self.high - self.low)

    @property
    def holds(self) -> bool:
        """The true value lies inside the interval."""
        return bool(self.low <= self.truth <= self.high)


@dataclass(frozen=True)
class Figure:
    """A figure of the report: lines and points over x. Each entry: label, x, y, style. log: x on a logarithmic axis."""

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
    """Of one test: numbers, notes, warnings and faults about them, figures, and more for identify.json."""

    test: str
    estimates: list[Estimate]
    notes: list[str] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    more: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    odd: list[str] = field(default_factory=list)  # recordings that are out of line


@dataclass(frozen=True)
class Measured:
    """The recordings of a test, and what is known of the bench; `truth` where ours is played."""

    recordings: Sequence[Recording]
    cells: Cells
    known: Bench
    test: Any
    truth: Bench | None = None

    @property
    def gram(self) -> float:
        """Gram-force in a newton, at the bench's gravity."""
        return 1000.0 / self.known.gravity

    def force(self, r: Recording, channel: str, using: Cells | None = None) -> Array:
        """Force of a cell over a recording, its tare read at rest."""
        return force_of(r, using or self.cells, channel, self.test.rest)

    def printed_force(self, r: Recording, channel: str) -> Array:
        """Force of a cell as the thesis reads it, tare and all."""
        return force_of(r, self.cells, channel, None)

    def true(self, name: str) -> float:
        """The true value of a parameter, NaN where it is not known."""
        return getattr(self.truth, name) if self.truth else float("nan")

    def alike(self) -> list[Recording]:
        """The recordings with as many rows in the window as the first."""
        count = self.recordings[0].rows(self.test.window).sum()
        return [r for r in self.recordings if r.rows(self.test.window).sum() == count]


def out_of_line(groups: Sequence[tuple[str, Sequence[Recording], Array]]) -> list[str]:
    """Name recordings whose values stand apart from those of the others.

    groups: what the values are, recordings and their values; all groups have the same scatter
    """
    place, chosen = odd_group([values for _, _, values in groups])
    if not chosen:
        return []
    what, recordings, values = groups[place]
    names = ", ".join(recordings[k].label for k in chosen)
    told = f"{names} {'is' if len(chosen) == 1 else 'are'} out of line: {what} is {values[chosen].mean():.4g}, and "
    told += f"{np.delete(values, chosen).mean():.4g} in the others"
    return [f"{told}; look at height, battery, cell and clock of these runs"]


PerRepetition = Callable[[Cells], Array]  # → shape (repetitions, numbers)


def interval(each: Array, shifts: Array) -> tuple[Array, Array, Array, Array]:
    """Mean over repetitions, half-width of its 95 % interval, standard errors by scatter and by calibration.

    each:   shape (N, p); shifts: what each calibration point's error would move the means by, shape (points, p)
    The degrees of freedom are Welch and Satterthwaite's: the calibration's error is known, the scatter estimated.
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
    """What the error of each calibration point, one standard deviation, moves the means by."""
    base = (per_repetition(cells) if each is None else each).mean(axis=0)
    rows = [
        per_repetition(moved(cells, c, k)).mean(axis=0) - base
        for c in channels
        for k in range(cells[c].loads.size)
        if cells[c].error > 0 and cells[c].loads[k] != 0  # no load is known for sure
    ]
    return np.array(rows) if rows else np.zeros((0, base.size))


def moved(cells: Cells, channel: str, point: int) -> Mapping[str, Cell]:
    """The cells with one load off by a standard deviation."""
    return {**cells, channel: cells[channel].moved(point, cells[channel].error)}


def made(names: Sequence[tuple[str, str, float, float]], each: Array, shifts: Array, origin: str) -> list[Estimate]:
    """Estimates of numbers, each (name, unit, by the thesis' estimator, true value), from (N, p) and shifts."""
    value, half, scatter, calibration = interval(each, shifts)
    return [
        Estimate(
            name, unit, thesis, float(v), float(v - h), float(v + h), float(s), float(c), each.shape[0], origin, truth
        )
        for (name, unit, thesis, truth), v, h, s, c in zip(names, value, half, scatter, calibration, strict=True)
    ]


def pseudo_values(estimate: Callable[[Rows], Array], n: int) -> Array:
    """Jackknife pseudo-values of an estimate that takes the repetitions that are used, shape (n, p)."""
    whole = estimate(np.arange(n))
    left = np.array([estimate(np.delete(np.arange(n), k)) for k in range(n)])
    return np.asarray(n * whole - (n - 1) * left)


def least(grid: Array, cost: Array) -> Array:
    """Where each row of costs over a grid is least, by the parabola through the three points about it."""
    k = np.clip(np.argmin(cost, axis=1), 1, grid.size - 2)
    rows = np.arange(cost.shape[0])
    before, here, after = cost[rows, k - 1], cost[rows, k], cost[rows, k + 1]
    # grids are even in the logarithm
    x, h = np.log(grid), np.log(grid[1] / grid[0])
    curvature = before - 2.0 * here + after
    offset = np.divide(before - after, 2.0 * curvature, out=np.zeros_like(here), where=curvature > 0)
    return np.asarray(np.exp(x[k] + h * np.clip(offset, -1.0, 1.0)))
