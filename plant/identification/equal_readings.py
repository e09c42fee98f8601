"""Equal readings despite noise: a cell that is stuck, clipped, repeated or too coarse.

The probability of equal neighbours comes from the rest of the same recording, so that a quiet cell on a coarse
converter, with long equal runs everywhere, is no fault.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array, Flags

MAX_CHANCE = 1e-9  # probability of the longest run of equal readings; a bench has some thousand recordings at most
MIN_CLIPPED, MIN_CLIPPED_SHARE = 10, 0.02  # readings at the extreme value, and their share of the window
MAX_EQUAL_SHARE = 0.2  # share of equal neighbours at noise of 1.4 steps or more, where an extreme value is rare
MIN_REPEATED_SHARE = 0.4  # share of equal neighbours if each reading occurs about twice
REPEATED_JUMP = 4.0  # least change of a repeated reading in converter steps, larger than the noise
MIN_LEVELS = 4.0  # least number of steps between rest and window


@dataclass(frozen=True)
class EqualReadings:
    """A group of equal readings: kind, first row, number of rows, and value [V].

    Attributes:
        kind: `stuck`, `clipped`, `repeated` or `coarse`. For `repeated`, `value` is the number of rows per reading; for
            `coarse`, `value` is the step [V], and `count` the number of steps between rest and window.
    """

    kind: str
    row: int
    count: int
    value: float


def equal_readings(volts: Array, window: Flags, rest: Flags, rail: Flags) -> EqualReadings | None:
    """Return the most significant equal readings, or None.

    Args:
        rail: Saturated readings, which may be equal.
    """
    first, last = np.flatnonzero(window)[[0, -1]]
    begin = max(0, first - (last - first))  # the same duration before the window shows the normal behaviour
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
    """Return `repeated` or `coarse` readings of a window, or None."""
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
    """Return start and length of the longest equal run that reaches into the rows from `first`."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], equal, [False])).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]  # pairs of neighbours: a run of n readings has n − 1
    reach = ends >= first
    if not reach.any():
        return first, 1
    k = int(np.argmax(np.where(reach, ends - starts, 0)))
    return int(starts[k]), int(ends[k] - starts[k]) + 1
