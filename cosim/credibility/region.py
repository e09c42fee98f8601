"""The region that logs cover: points in scaled coordinates, and a threshold for the distance to the nearest point.

Coordinates are inputs, outputs, and rates of outputs. A sample has the values at its start, and the rates up to its
end, about one step of the logs later. The distance of a sample is the largest difference of a coordinate from the
nearest point of the logs, so that one coordinate names the reason. The threshold is the distance that the rows of a
part of the logs, left out with its neighbours, keep to the rest with 95 % probability. region.c has this rule for FMUs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from cosim.core.arrays import Array, Flags, NamedArrays, Rows
from cosim.credibility.bands import Finite, conformal_quantile

REGION_COVERAGE = 0.95  # share of the rows of a left-out part within the threshold
REGION_PARTS = 40  # parts of all logs
MIN_PART_ROWS = 4  # of a part
MAX_REGION_POINTS, MAX_REGION_ROWS = 1000, 20_000  # of the region, and of the logs that it is made from
CONSTANT_SIGNAL_RANGE = 1e-6  # of a signal's size: smaller ranges are rounding, larger changes leave a constant signal
REPEATS = 0.99  # correlation from which a coordinate repeats another one
DECIMALS = 3  # of a stored point
LEAST_SAMPLE = 0.99  # least length of a sample, in steps of the logs


class Coordinate(BaseModel):
    """A coordinate of the region.

    signal: input or output of the FMU
    low: least value in the logs
    high: largest value in the logs
    scale: standard deviation in the logs, the unit of distances
    """

    signal: str
    kind: Literal["input", "output", "rate"]
    unit: str
    low: Finite
    high: Finite
    scale: Annotated[Finite, Field(gt=0.0)]

    @property
    def name(self) -> str:
        """Return the name, such as `level` or `rate of level`."""
        return f"rate of {self.signal}" if self.kind == "rate" else self.signal

    @property
    def is_constant(self) -> bool:
        """Return True if the coordinate is constant in the logs."""
        return self.high - self.low <= CONSTANT_SIGNAL_RANGE * max(1.0, abs(self.low), abs(self.high))


class Region(BaseModel):
    """Region of inputs, outputs and rates that logs cover.

    step: time over which a rate is computed, the step of the logs [s]
    coordinates: signals and rates that span the region, each with its scale
    left_out: signal or rate that is not a coordinate → reason
    threshold: a sample is outside if its distance to the nearest point is larger
    points: samples of the logs; a coordinate of a point is (value − low)/scale
    reason: reason why there is no region; empty if there is one
    """

    step: Finite = 0.0
    coordinates: list[Coordinate] = []
    left_out: dict[str, str] = {}
    threshold: Finite = 0.0
    points: list[list[Finite]] = []
    reason: str = ""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Raise ValueError for points that do not fit the coordinates."""
        if not self.reason and (not self.points or {len(point) for point in self.points} != {len(self.coordinates)}):
            raise ValueError("each point of the region has a value of every coordinate")
        return self

    @property
    def constant(self) -> list[str]:
        """Return the names of the coordinates that are constant in the logs."""
        return [c.name for c in self.coordinates if c.is_constant]


class Stretch(NamedTuple):
    """Signals over a time without gaps; a row with a restart of the model has no rate.

    Attributes:
        time: Increasing times [s].
        signals: Name → (rows,), NaN without a value.
        restarts: Rows at which the model is restarted.
    """

    time: Array
    signals: NamedArrays
    restarts: Sequence[int] = ()


@dataclass(frozen=True, eq=False)
class Distances:
    """Distance from a region over time.

    Attributes:
        ratio: Distance relative to the threshold, shape (rows,); above 1 outside; NaN if a coordinate is missing.
        farthest: Coordinate with the largest difference, shape (rows,).
        missing: Coordinates whose signals are missing, which are ignored.
    """

    time: Array
    ratio: Array
    farthest: Rows
    missing: Sequence[str]

    @property
    def inside(self) -> Flags:
        """Return True for the rows in the region, and for those that cannot be judged, as at the start of a window."""
        return ~(self.ratio > 1.0)


def region_of(
    stretches: Sequence[Stretch],
    inputs: Sequence[str],
    units: Mapping[str, str],
    step: float,
    free: Set[str] = frozenset(),
) -> Region:
    """Return the region of logs.

    Args:
        stretches: Inputs of the logs, with outputs of the model.
        inputs: Names of the inputs; other signals are outputs.
        step: Time between rows [s].
        free: Outputs on whose level nothing depends, such as a position; only their rates are coordinates.
    """
    names = [n for n in stretches[0].signals if n in inputs] + [n for n in stretches[0].signals if n not in inputs]
    every: list[tuple[str, Any]] = [(n, "input" if n in inputs else "output") for n in names]
    every += [(n, "rate") for n in names if n not in inputs]
    tables = [_table(stretch, every, _sample_ends(stretch.time, step)) for stretch in stretches]
    tables = [table[np.isfinite(table).all(axis=1)] for table in tables]
    rows = sum(map(len, tables))
    if rows < REGION_PARTS * MIN_PART_ROWS:
        return Region(
            reason=f"too few data: the region needs {REGION_PARTS * MIN_PART_ROWS} rows, and the logs have {rows}"
        )
    every_nth = max(1, rows // MAX_REGION_ROWS)
    lengths = [max(MIN_PART_ROWS, round(rows / REGION_PARTS / every_nth))] * len(tables)
    blocks, first = [], 0  # numbers with a gap between logs, so that only parts of one log are neighbours
    for k, table in enumerate(tables):
        tables[k] = table = table[::every_nth]
        blocks.append(first + np.arange(len(table)) // lengths[k])
        first = int(blocks[-1][-1]) + 2 if len(table) else first
    values, block = np.vstack(tables), np.concatenate(blocks)
    low, high = values.min(axis=0), values.max(axis=0)
    constant = high - low <= CONSTANT_SIGNAL_RANGE * np.maximum(1.0, np.maximum(np.abs(low), np.abs(high)))
    spread = np.where(constant, CONSTANT_SIGNAL_RANGE * np.maximum(1.0, np.abs(low)), np.std(values, axis=0))
    scaled, kept, left_out = (values - low) / spread, list[int](), dict[str, str]()
    shapes = (values - values.mean(axis=0)) / np.where(constant, 1.0, np.std(values, axis=0))
    for j, (signal, kind) in enumerate(every):
        name = f"rate of {signal}" if kind == "rate" else signal
        like = [i for i in kept if not constant[i] and abs(float(shapes[:, i] @ shapes[:, j])) > REPEATS * len(values)]
        if kind == "output" and signal in free:
            left_out[name] = "the model does not depend on its absolute value"
        elif kind == "rate" and constant[j]:
            left_out[name] = "constant"
        elif like:
            left_out[name] = f"repeats {every[like[0]][0]}"
        else:
            kept.append(j)
    scaled = scaled[:, kept]
    chosen = _spread_out(scaled, MAX_REGION_POINTS)
    threshold = conformal_quantile(_left_out_distances(scaled, block, chosen), REGION_COVERAGE)
    if not np.isfinite(threshold):
        return Region(reason="too few data: the threshold of the region needs parts of the logs to leave out in turn")
    coordinates = []
    for j in kept:
        signal, kind = every[j]
        unit = units.get(signal, "")
        shown = f"{unit}/s" if kind == "rate" and unit else "1/s" if kind == "rate" else unit
        sizes = {"low": float(low[j]), "high": float(high[j]), "scale": float(spread[j])}
        coordinates.append(Coordinate(signal=signal, kind=kind, unit=shown, **sizes))
    points = np.round(scaled[chosen], DECIMALS).tolist()
    return Region(step=step, coordinates=coordinates, left_out=left_out, threshold=threshold, points=points)


def _sample_ends(time: Array, step: float) -> Rows:
    """Return the row at which the sample of each row ends; the number of rows if no row is late enough."""
    return np.maximum(np.searchsorted(time, time + LEAST_SAMPLE * step), np.arange(time.size) + 1)


def _table(stretch: Stretch, coordinates: Sequence[tuple[str, Any]], ends: Rows) -> Array:
    """Return the values of coordinates, shape (rows, coordinates).

    A rate looks ahead to the end of the sample, as the command of a row acts until the next one. Samples that do not
    end have the last rate.
    """
    time, columns, missing = stretch.time, [], np.full(stretch.time.size, np.nan)
    begins = np.flatnonzero(ends < time.size)
    ends = ends[begins]
    restarts = np.array(stretch.restarts)
    crosses_restart = np.searchsorted(restarts, ends) > np.searchsorted(restarts, begins)
    for signal, kind in coordinates:
        values = stretch.signals.get(signal, missing)
        if kind == "rate":
            rates = (values[ends] - values[begins]) / (time[ends] - time[begins])
            values = np.full(time.size, rates[-1] if rates.size else 0.0)
            values[begins] = np.where(crosses_restart, np.nan, rates)
        columns.append(values)
    return np.column_stack(columns)


def _spread_out(points: Array, most: int) -> Rows:
    """Return the indices of points that cover all points well; each one is the farthest from all previous ones."""
    chosen = [0]
    apart = np.abs(points - points[0]).max(axis=1)
    while len(chosen) < min(most, len(points)) and apart.max() > 0.0:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.abs(points - points[chosen[-1]]).max(axis=1))
    return np.array(chosen)


def _left_out_distances(points: Array, block: Rows, chosen: Rows) -> list[Array]:
    """Return the distance of each block's points to the nearest chosen point outside the block and its neighbours."""
    from scipy.spatial import cKDTree

    found = []
    for number in np.unique(block):
        others = chosen[np.abs(block[chosen] - number) > 1]
        if others.size:
            found.append(cKDTree(points[others]).query(points[block == number], p=np.inf)[0])
    return found


def distances(region: Region, stretch: Stretch) -> Distances:
    """Return the distance of signals from a region, at rows about a step apart (at most MAX_REGION_ROWS)."""
    from scipy.spatial import cKDTree

    ends = _sample_ends(stretch.time, region.step)
    begins, next_begin = [0], ends.tolist()
    while (begin := next_begin[begins[-1]]) < len(next_begin):
        begins.append(begin)
    rows = np.array(begins)[:: -(-len(begins) // MAX_REGION_ROWS)]
    known = [j for j, c in enumerate(region.coordinates) if c.signal in stretch.signals]
    missing = [c.name for c in region.coordinates if c.signal not in stretch.signals]
    if not known:
        time = stretch.time[rows]
        return Distances(time, np.full(time.size, np.nan), np.zeros(time.size, np.intp), missing)
    coordinates = [region.coordinates[j] for j in known]
    values = _table(stretch, [(c.signal, c.kind) for c in coordinates], ends)[rows]
    low, scale = (np.array([getattr(c, key) for c in coordinates]) for key in ("low", "scale"))
    points = np.array(region.points)[:, known]
    good = np.isfinite(values).all(axis=1)
    ratio, farthest = np.full(len(values), np.nan), np.zeros(len(values), np.intp)
    farthest[~good] = np.array(known)[np.argmin(np.isfinite(values[~good]), axis=1)]
    if good.any():
        asked = (values[good] - low) / scale
        apart, nearest = cKDTree(points).query(asked, p=np.inf)
        ratio[good] = apart / max(region.threshold, 1e-300)
        farthest[good] = np.array(known)[np.argmax(np.abs(asked - points[nearest]), axis=1)]
    return Distances(stretch.time[rows], ratio, farthest, missing)
