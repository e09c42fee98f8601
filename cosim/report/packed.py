"""Every row of a page's signals in little space: whole numbers on a decimal grid, their differences, deflated.

A column is written as the differences of its rows from the row before, each in as few bytes as it needs, seven bits in
one and the sign in the lowest (zigzag, LEB128), so that a signal that moves little from row to row takes about a byte a
row before it is deflated. The page's script undoes it with the browser's own `DecompressionStream`.
"""

from __future__ import annotations

import base64
import math
import sys
import zlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array

DIGITS, OF_SPAN = 5, 4  # kept of the largest value, and of how far a signal moves
ROUNDING = 1e-12  # of the largest value: a signal that moves less stands still
LARGEST = 1e15  # a whole number that every script knows exactly
FINEST = 300  # decimals; a power of ten beyond is no double
Whole = NDArray[np.int64]


def power(values: Array) -> int:
    """Decimals of a column's grid: enough digits of its largest value and of its span; below 0 for large numbers."""
    good = values[np.isfinite(values)]
    if not good.size or not np.any(good):
        return 0
    largest = float(np.max(np.abs(good)))
    span = min(float(np.max(good)) - float(np.min(good)), sys.float_info.max)
    digits = DIGITS - 1 - math.floor(math.log10(largest))
    if span > ROUNDING * largest:
        digits = max(digits, OF_SPAN - 1 - math.floor(math.log10(span)))
    return min(digits, math.floor(math.log10(LARGEST) - math.log10(largest)), FINEST)


def power_of_time(time: Array) -> int:
    """Decimals that tell rows apart to a thousandth of the least step, and a microsecond at least."""
    steps = np.diff(time)
    steps = steps[steps > 0.0]
    digits = max(6, 3 - math.floor(math.log10(float(steps.min())))) if steps.size else 6
    largest = float(np.max(np.abs(time), initial=1.0))
    return min(digits, math.floor(math.log10(LARGEST / max(largest, 1.0))))


def whole(values: Array, decimals: int) -> Whole:
    """Values on the grid; one that is missing stands as the one before it."""
    good = np.isfinite(values)
    last = np.maximum.accumulate(np.where(good, np.arange(values.size), -1))
    filled = np.where(last >= 0, values[np.maximum(last, 0)], 0.0)
    scaled = filled * 10.0**decimals if decimals >= 0 else filled / 10.0**-decimals
    return np.rint(scaled).astype(np.int64)


def packed(columns: Iterable[Whole]) -> str:
    """Columns one behind the other, deflated, as text."""
    return base64.b64encode(zlib.compress(b"".join(_bytes(column) for column in columns), 9)).decode("ascii")


def _bytes(column: Whole) -> bytes:
    """Differences from row to row as zigzag numbers of seven bits a byte."""
    steps = np.diff(column, prepend=np.int64(0))
    zigzag = ((steps << 1) ^ (steps >> 63)).astype(np.uint64)
    lengths = np.ones(zigzag.size, np.int64)
    for bits in range(7, 63, 7):
        lengths += zigzag >= (1 << bits)
    ends = np.cumsum(lengths)
    out = np.zeros(int(ends[-1]) if ends.size else 0, np.uint8)
    begins = ends - lengths
    for k in range(int(lengths.max(initial=0))):
        longer = lengths > k
        seven = (zigzag[longer] >> np.uint64(7 * k)) & np.uint64(0x7F)
        more = np.where(lengths[longer] > k + 1, 0x80, 0).astype(np.uint64)
        out[begins[longer] + k] = (seven | more).astype(np.uint8)
    return out.tobytes()
