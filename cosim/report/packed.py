"""Compact encoding of a page's signals: whole numbers on a decimal grid, differenced and deflated.

Each row is stored as its difference from the previous row in as few bytes as needed: seven bits a byte, the sign in the
lowest bit (zigzag, LEB128). A signal with small steps takes about a byte a row before it is deflated. The page's script
decodes the text with the browser's `DecompressionStream`.
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

DIGITS, SPAN_DIGITS = 5, 4  # significant digits of the largest value and of the span
ROUNDING = 1e-12  # of the largest value: a signal with a smaller span is constant
MAX_EXACT = 1e15  # whole numbers up to here are exact in the script
MAX_DECIMALS = 300  # decimals; larger powers of ten overflow
Integers = NDArray[np.int64]


def power(values: Array) -> int:
    """Return the number of decimals to store a column with, negative for large numbers."""
    good = values[np.isfinite(values)]
    if not good.size or not np.any(good):
        return 0
    largest = float(np.max(np.abs(good)))
    span = min(float(np.max(good)) - float(np.min(good)), sys.float_info.max)
    digits = DIGITS - 1 - math.floor(math.log10(largest))
    if span > ROUNDING * largest:
        digits = max(digits, SPAN_DIGITS - 1 - math.floor(math.log10(span)))
    return min(digits, math.floor(math.log10(MAX_EXACT) - math.log10(largest)), MAX_DECIMALS)


def power_of_time(time: Array) -> int:
    """Return the number of decimals to store time with.

    The decimals resolve a thousandth of the least step, and a microsecond, unless whole numbers exceed MAX_EXACT.
    """
    steps = np.diff(time)
    steps = steps[steps > 0.0]
    digits = max(6, 3 - math.floor(math.log10(float(steps.min())))) if steps.size else 6
    largest = float(np.max(np.abs(time), initial=1.0))
    return min(digits, math.floor(math.log10(MAX_EXACT / max(largest, 1.0))))


def on_grid(values: Array, decimals: int) -> Integers:
    """Return values as whole multiples of 10^−decimals; a missing value repeats its predecessor."""
    good = np.isfinite(values)
    last = np.maximum.accumulate(np.where(good, np.arange(values.size), -1))
    filled = np.where(last >= 0, values[np.maximum(last, 0)], 0.0)
    scaled = filled * 10.0**decimals if decimals >= 0 else filled / 10.0**-decimals
    return np.rint(scaled).astype(np.int64)


def pack(columns: Iterable[Integers]) -> str:
    """Return the columns in sequence, deflated, as base64 text."""
    return base64.b64encode(zlib.compress(b"".join(_bytes(column) for column in columns), 9)).decode("ascii")


def _bytes(column: Integers) -> bytes:
    """Return row differences as zigzag numbers of variable length."""
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
