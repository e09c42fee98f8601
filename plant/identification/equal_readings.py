"""Readings that are equal where noise should move them: a cell that is stuck, clipped, repeated or too coarse.

Each is judged by how often neighbouring readings of the same recording are equal elsewhere, so that a quiet cell on a
coarse converter is no fault: its readings are equal for long everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Flags

MAX_CHANCE = 1e-9  # of a run of equal readings as long as the longest; a bench has some thousand recordings at most
MIN_CLIPPED, MIN_CLIPPED_SHARE = 10, 0.02  # readings at the extreme value, and their share of the window
MAX_EQUAL_SHARE = 0.2  # of equal neighbours: noise of 1.4 steps or more, so that an extreme value is rare
MIN_REPEATED_SHARE = 0.4  # of equal neighbours: each reading stands there about twice
REPEATED_JUMP = 4.0  # steps of the converter by which a repeated reading changes, at least: noise is that large
MIN_LEVELS = 4.0  # steps by which a cell moves from rest to the window, at least


@dataclass(frozen=True)
class EqualReadings:
    """A group of equal readings: its kind, first row, number of rows, and the value [V].

    kind: `stuck`, `clipped`, `repeated` or `coarse`; of `repeated`, `value` is how many rows a reading lasts;
        of `coarse`, the step of the readings [V], and `count` the number of steps that the cell moves by
    """

    kind: str
    row: int
    count: int
    value: float


def equal_readings(volts: Array, window: Flags, rest: Flags, rail: Flags) -> EqualReadings | None:
    """Return the most telling group of equal readings in a window, None where there is none.

    rail: readings at an end of the converter's range, which may be equal
    """
    first, last = np.flatnonzero(window)[[0, -1]]
    begin = max(0, first - (last - first))  # as long before the window: what the cell does when nothing is wrong
    near, ends = volts[begin : last + 1], rail[begin : last + 1]
    equal = (np.diff(near) == 0.0) & ~ends[1:]
    start, length = _longest(equal, first - begin)
    if length == near.size - (first - begin) and not np.ptp(volts[: last + 1]):
        return EqualReadings("stuck", int(first), length, float(volts[first]))
    outside = np.ones(equal.size, dtype=bool)
    outside[start : start + length - 1] = False
    share = (float(equal[outside].sum()) + 1.0) / (float((outside & ~ends[1:]).sum()) + 2.0)
    if near.size * share ** (length - 1) < MAX_CHANCE:
        value = float(near[start])
        low, high = float(volts[window].min()), float(volts[window].max())
        kind = "clipped" if low < high and value in (low, high) else "stuck"
        return EqualReadings(kind, int(max(begin + start, first)), length, value)
    inside = volts[window & ~rail]
    if inside.size and share <= MAX_EQUAL_SHARE:
        for extreme in (float(inside.min()), float(inside.max())):
            count = int((inside == extreme).sum())
            if count >= max(MIN_CLIPPED, MIN_CLIPPED_SHARE * inside.size):
                row = int(np.flatnonzero(window & (volts == extreme))[0])
                return EqualReadings("clipped", row, count, extreme)
    return _coarse(volts[window | rest], near, equal, int(first))


def _coarse(volts: Array, near: Array, equal: Flags, first: int) -> EqualReadings | None:
    """Return readings that are repeated, or as coarse as what they measure; None where there are none."""
    changes, jumps = (d[d > 0.0] for d in (np.abs(np.diff(volts)), np.abs(np.diff(near))))
    if not changes.size:
        return None
    share, step, span = float(equal.mean()), float(changes.min()), float(np.ptp(volts))
    if share > MIN_REPEATED_SHARE and float(np.median(jumps)) > REPEATED_JUMP * step:
        return EqualReadings("repeated", first, int(equal.sum()), 1.0 / (1.0 - share))
    if share > MAX_EQUAL_SHARE and span < (MIN_LEVELS - 0.5) * step:
        return EqualReadings("coarse", first, round(span / step), step)
    return None


def _longest(equal: Flags, first: int) -> tuple[int, int]:
    """Return start and length of the longest run of equal readings that reaches into the rows from `first` on."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], equal, [False])).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]  # pairs of neighbours: a run of n readings has n − 1
    reach = ends >= first
    if not reach.any():
        return first, 1
    k = int(np.argmax(np.where(reach, ends - starts, 0)))
    return int(starts[k]), int(ends[k] - starts[k]) + 1
