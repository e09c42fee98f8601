"""Difference of one signal between two runs: numbers, texts, and rows at other times."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cosim.comparison.intermediate_rows import RowsBetween
from cosim.core.arrays import Array
from cosim.core.text import amount, plain
from cosim.core.units import Conversion
from cosim.files.table import as_text
from cosim.simulation.run_files import RecordedRun

SAME_TIME = 1e-9  # fraction of a step
ROUNDING = 8 * float(np.finfo(float).eps)  # fraction of a value, for a unit conversion there and back
BETWEEN = "between rows of a"


@dataclass(frozen=True)
class Difference:
    """Difference of a signal between two runs.

    Attributes:
        unit: Unit of a; b is converted to it.
        largest: Largest |b − a| in the unit, at time `at` [s]; infinite if a number is missing in a single run or
            dimensions differ.
        rms: Root mean square of b − a.
        scale: Range of a, for a constant its magnitude, or 1.
        share: largest / scale.
        beyond: Whether the tolerance is exceeded.
        note: Note on units or text.
        alike: Whether the dimensions agree.
    """

    name: str
    unit: str
    largest: float
    at: float
    rms: float
    scale: float
    share: float
    beyond: bool
    note: str = ""
    alike: bool = True

    def as_json(self, *, named: bool = True) -> dict[str, Any]:
        """Return the difference as plain data; non-finite becomes None."""
        values = [(k, v) for k, v in asdict(self).items() if named or k != "name"]
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values}


def common_rows(a: RecordedRun, b: RecordedRun) -> tuple[slice, bool]:
    """Return the rows of a within the time of b, and whether both runs have the same times in these rows."""
    first, second = a.results.time, b.results.time
    count = min(first.size, second.size)
    if not count:
        return slice(0, 0), False
    close = time_tolerance(first)
    if np.all(np.abs(first[:count] - second[:count]) <= close):
        return slice(0, count), True
    low, high = np.searchsorted(first, [second[0] - close, second[-1] + close])
    return slice(int(low), int(high)), False


def time_tolerance(time: Array) -> float:
    """Return the largest difference [s] of two times that count as equal: less than a step, more than rounding."""
    steps = np.diff(time)
    step = float(np.min(steps[steps > 0.0], initial=1.0))
    return max(SAME_TIME * step, ROUNDING * float(np.max(np.abs(time), initial=0.0)))


def compare_numbers(name: str, unit: str, time: Array, values: tuple[Array, Array], by: Conversion) -> Difference:
    """Return the difference of a numeric signal with convertible units.

    Args:
        values: Values of a, and of b converted to the unit of a.
        by: Conversion of b; differences within its rounding count as 0.
    """
    first, second = values
    same = (first == second) | (np.isnan(first) & np.isnan(second))
    finite = np.isfinite(first) & np.isfinite(second)
    gap = np.where(same, 0.0, np.inf)
    gap[finite] = np.abs(second[finite] - first[finite])
    if by != Conversion():
        gap[finite & (gap <= ROUNDING * np.maximum(np.abs(first), abs(by.offset)))] = 0.0
    row = int(np.argmax(gap))
    good = first[np.isfinite(first)]
    span = float(np.ptp(good)) if good.size else 0.0
    scale = (span if math.isfinite(span) else 0.0) or (float(np.max(np.abs(good))) if good.size else 0.0) or 1.0
    largest = float(gap[row])
    rms = float(np.sqrt(np.mean(gap**2))) if math.isfinite(largest) else math.inf
    return Difference(name, unit, largest, float(time[row]), rms, scale, largest / scale, beyond=False)


def unit_note(unit: str, other: str, d: Difference, by: Conversion) -> str:
    """Return a note on the units of both runs."""
    if unit and unit == other:
        return f"{unit} of another definition in b, converted" if by != Conversion() else ""
    if unit and other:
        return f"{other} in b, converted"
    return f"no unit in {'b' if unit else 'a'}, taken as {d.unit}" if (unit or other) and d.largest else ""


def compare_text(
    a: RecordedRun,
    b: RecordedRun,
    name: str,
    rows: slice,
    held: tuple[RowsBetween, RowsBetween] | None,
    *,
    has_tolerance: bool,
) -> Difference:
    """Return the difference of text: 1 if any row differs, else 0.

    A text between two rows of the other run must be that of one of them.

    Args:
        held: Rows of b with the surrounding rows of a, and the reverse; None for equal times.
    """
    first, second = ([*map(as_text, r.results.exact.get(name) or r.results[name])] for r in (a, b))
    time = a.results.time[rows]
    if held is None:
        pairs = zip(first[rows], second[: time.size], strict=True)
        differs = next((float(time[k]) for k, (x, y) in enumerate(pairs) if x != y), None)
    else:
        times = held[1].other_text(second, first), held[0].other_text(first, second)
        differs = min((t for t in times if t is not None), default=None)
    if differs is None:
        return Difference(name, "", 0.0, float(time[0]), 0.0, 1.0, 0.0, False, "text")
    return Difference(name, "", 1.0, differs, 1.0, 1.0, 1.0, has_tolerance, "text differs")


def format_size(d: Difference, value: float) -> str:
    """Return a difference as text in the signal's unit; a dash if the signal is not comparable."""
    return amount(value if d.alike else math.nan, d.unit)


def format_share(d: Difference) -> str:
    """Return a difference relative to the signal's range."""
    if not d.alike:
        return "not comparable"
    return f"{plain(100 * d.share, 2)} %" if math.isfinite(d.share) else "no number in one run"
