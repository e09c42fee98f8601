"""Error bands by conformal prediction over blocks.

Errors of held-out replays form n blocks, one per replay. Each block has the weight 1/(n + 1), spread evenly over its
rows; an infinite error has the remaining weight. If a further replay is exchangeable with these blocks, the quantile of
level 1 − α of the weights bounds the absolute error of its rows with a probability between 1 − α and 1 − α + 1/(n + 1),
whatever the distribution of the errors (Lee, Barber and Willett 2023, Distribution-free inference with hierarchical
data). With blocks of one row this is split conformal prediction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from cosim.core.arrays import Array, Flags, NamedArrays, Rows
from cosim.core.text import join_names, percent

Finite = Annotated[float, Field(allow_inf_nan=False)]
BAND_COVERAGE = 0.9  # of the bands
MIN_REPLAYS = 10  # replays of the longest horizon
MAX_HORIZON_RATIO = 2.0  # largest ratio of neighbouring horizons
FREE_RUN_PARTS = 8  # parts of a free run over a log, each counted as one replay
LEAST_ROWS = 4  # of the first interval


def conformal_quantile(blocks: Sequence[Array], level: float) -> float:
    """Return a size that a row of a further block does not exceed with a probability of at least `level`.

    Args:
        blocks: Sizes of the errors in each block; empty blocks are ignored.

    Returns:
        The size, infinite for too few blocks.
    """
    blocks = [block for block in blocks if block.size]
    if not blocks:
        return math.inf
    sizes = np.concatenate(blocks)
    order = np.argsort(sizes)
    weights = np.concatenate([np.full(block.size, 1.0 / block.size) for block in blocks])[order] / (len(blocks) + 1)
    place = int(np.searchsorted(np.cumsum(weights), level - 1e-9))
    return float(sizes[order][place]) if place < sizes.size else math.inf


@dataclass(frozen=True, eq=False)
class Track:
    """Errors of the replays of a log over one horizon.

    Attributes:
        errors: Output → measured − model, NaN where one of them is missing, infinite where the model diverges.
        ages: Time since the start of the replay [s], shape (rows,), NaN before the first replay.
        replays: Number of the replay of each row.
        inside: True for rows in the region of the logs; None if this is unknown.
    """

    errors: NamedArrays
    ages: Array
    replays: Rows
    inside: Flags | None = None


def track_of(
    time: Array, starts: Sequence[int], errors: NamedArrays, *, inside: Flags | None = None, free: bool = False
) -> Track:
    """Return the track of replays that begin at the rows `starts`; a start row belongs to the previous replay.

    Args:
        free: True for a single free run, which is divided into blocks.
    """
    begins = np.asarray(starts, np.intp)
    replays = np.searchsorted(begins, np.arange(time.size), side="left") - 1
    ages = np.where(replays >= 0, time - time[begins[np.maximum(replays, 0)]], np.nan)
    if free:
        replays = np.arange(time.size) * FREE_RUN_PARTS // time.size
    return Track(errors, ages, replays, inside)


def band_horizons(durations: Sequence[float], first: float) -> list[float]:
    """Return horizons for bands [s], from `first` to the longest one with enough consecutive replays in the logs.

    Args:
        durations: Time of each log that replays can cover [s].
    """
    ends = (d / n for d in durations for n in range(1, MIN_REPLAYS + 1))
    longest = max((h for h in ends if sum(int(d / h + 1e-9) for d in durations) >= MIN_REPLAYS), default=0)
    if longest < first:
        return []
    count = 1 + math.ceil(math.log(longest / first) / math.log(MAX_HORIZON_RATIO) - 1e-9)
    return [float(f"{h:.4g}") for h in np.geomspace(first, longest * (1.0 - 1e-3), max(1, count))]


class Bands(BaseModel):
    """Half-width of the error band of each output, by the time since the start of a run.

    level: probability that an error of a further replay is within the band
    horizons: ends of the intervals of time since the start [s], increasing
    replays: number of replays from which each interval is computed
    widths: output → half-width in each interval, in the unit of the output; null: unknown
    units: output → unit
    held_out: true if each replayed log was left out of the estimate that replayed it
    free_run: true if the last interval is computed from free runs over whole logs
    reason: reason why there is no band; empty if there is one
    """

    level: Finite = BAND_COVERAGE
    horizons: list[Finite] = []
    replays: list[int] = []
    widths: dict[str, list[Finite | None]] = {}
    units: dict[str, str] = {}
    held_out: bool = False
    free_run: bool = False
    reason: str = ""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        """Raise ValueError for widths that do not fit the horizons."""
        if any(a >= b for a, b in pairwise(self.horizons)):
            raise ValueError("the horizons of bands increase")
        if any(len(widths) != len(self.horizons) for widths in self.widths.values()):
            raise ValueError("a band has one width for each horizon")
        if any(all(w is None for w in widths) for widths in self.widths.values()):
            raise ValueError("a band has a known width")
        return self

    def at(self, name: str, ages: Array) -> Array:
        """Return the half-width of an output at times since the start [s], NaN where unknown."""
        widths = np.array([math.nan if w is None else w for w in (*self.widths.get(name, ()), None)])
        if widths.size == 1:
            return np.full(ages.shape, math.nan)
        places = np.searchsorted(np.array(self.horizons), ages * (1.0 - 1e-9), side="left")
        return np.where(np.isfinite(ages), widths[places], math.nan)


def bands_of(tracks: Mapping[float, Sequence[Track]], units: Mapping[str, str], *, held_out: bool, free: bool) -> Bands:
    """Return the bands from held-out replays. The interval up to each horizon is computed from replays of this horizon.

    Args:
        tracks: Horizon [s] → track of each log.
        free: True if the last horizon is a free run.
    """
    horizons = sorted(tracks)
    names = dict.fromkeys(name for each in tracks.values() for track in each for name in track.errors)
    widths: dict[str, list[float | None]] = {name: [] for name in names}
    counts, low = list[int](), 0.0
    for horizon in horizons:
        blocks = {name: [b for t in tracks[horizon] for b in _blocks(t, name, low, horizon)] for name in names}
        counts.append(max((len(of) for of in blocks.values()), default=0))
        for name, sizes in blocks.items():
            width = max(
                [conformal_quantile(sizes, BAND_COVERAGE), *(math.inf if w is None else w for w in widths[name][-1:])]
            )
            widths[name].append(width if math.isfinite(width) else None)
        low = horizon
    widths = {name: of for name, of in widths.items() if any(w is not None for w in of)}
    if not widths:
        count = f"{max(counts)} of the longest" if counts else "none"
        reason = f"too few data: a band needs {MIN_REPLAYS} replays of one horizon, and the logs have {count}"
        return Bands(reason=reason, held_out=held_out)
    shown = {name: units.get(name, "") for name in widths}
    return Bands(
        horizons=horizons,
        replays=counts,
        widths=widths,
        units=shown,
        held_out=held_out,
        free_run=free and bool(horizons),
    )


def _blocks(track: Track, name: str, low: float, high: float) -> list[Array]:
    """Return the absolute errors of an output within an interval of time since the start, by replay."""
    if name not in track.errors:
        return []
    sizes = np.abs(track.errors[name])
    rows = np.flatnonzero(~np.isnan(sizes) & (track.ages > low) & (track.ages <= high * (1.0 + 1e-9)))
    if not rows.size:
        return []
    edges = np.flatnonzero(np.diff(track.replays[rows])) + 1
    return np.split(sizes[rows], edges)


class Coverage(BaseModel):
    """Share of the errors on sealed logs that are within the error bands.

    outputs: output → share of errors within the band, in rows within the region
    rows: number of these rows, over all outputs
    inside: share of the rows of sealed logs within the region
    """

    outputs: dict[str, Finite]
    rows: int
    inside: Finite

    @property
    def sentence(self) -> str:
        """Return the coverage as a sentence."""
        shares = join_names([f"{percent(share)} of {name}" for name, share in self.outputs.items()])
        inside = f"{percent(self.inside)} of the sealed rows lie in the region of the logs"
        return f"{inside}. There, the {100 * BAND_COVERAGE:g} % error bands of the FMU hold {shares}."


def coverage_of(bands: Bands, tracks: Mapping[float, Sequence[Track]]) -> Coverage | None:
    """Return the coverage of replays that were not used for the bands; None without rows."""
    counts: dict[str, list[int]] = {name: [0, 0] for name in bands.widths}
    inside, low = [], 0.0
    for horizon in sorted(tracks):
        for track in tracks[horizon]:
            within = np.ones(track.ages.size, bool) if track.inside is None else track.inside
            recent = (track.ages > low) & (track.ages <= horizon * (1.0 + 1e-9))
            inside.append(within[recent])
            for name in counts.keys() & track.errors.keys():
                width = bands.at(name, np.minimum(track.ages, horizon))
                judged = recent & within & ~np.isnan(track.errors[name]) & ~np.isnan(width)
                counts[name][0] += int((np.abs(track.errors[name]) <= width)[judged].sum())
                counts[name][1] += int(judged.sum())
        low = horizon
    rows = sum(count for _, count in counts.values())
    if not rows:
        return None
    shares = {name: covered / count for name, (covered, count) in counts.items() if count}
    return Coverage(outputs=shares, rows=rows, inside=float(np.mean(np.concatenate(inside))))
