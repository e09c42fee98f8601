"""Differences between the signals of two runs: numbers, texts, and rows at different times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.blocks.component import Signal
from cosim.core.arrays import Array, Rows
from cosim.core.errors import InputError
from cosim.core.text import amount, counted, percent, plain, some
from cosim.core.times import TIME_TOLERANCE_SHARE, rounding
from cosim.core.units import Conversion, conversion, definition_of
from cosim.credibility.validity import bands_of_run
from cosim.files.results import is_rounded
from cosim.files.table import as_text
from cosim.simulation.run_signals import RecordedRun

# tolerance of equal values after a unit conversion there and back, as a fraction
CONVERSION_TOLERANCE = 8 * float(np.finfo(float).eps)
MAX_LISTED_SIGNALS = 12  # signals in a short text


class RowsBetween(NamedTuple):
    """Rows of a run, each with the rows `first` to `last` of another run that span its allowed range.

    Attributes:
        is_jump: True if a run has several rows at the time of the row.
    """

    rows: Rows
    first: Rows
    last: Rows
    is_jump: NDArray[np.bool_]

    def apart(self, *, jumps: bool = False) -> RowsBetween:
        """Return the rows without a row of equal time in the other run; with `jumps`, only those at jumps."""
        chosen = (self.first < self.last) & (self.is_jump | (not jumps))
        return RowsBetween(self.rows[chosen], self.first[chosen], self.last[chosen], self.is_jump[chosen])

    def range_of(self, values: Array) -> tuple[Array, Array]:
        """Return the smallest and the largest value of the other run around each row."""
        padded = np.append(values, np.nan)  # A range may end with the last row.
        ends = np.column_stack((self.first, self.last + 1)).ravel()
        return np.fmin.reduceat(padded, ends)[::2], np.fmax.reduceat(padded, ends)[::2]

    def nearest(self, other: Array, own: Array) -> Array:
        """Return the values of the run, with each of the rows replaced by the nearest value in its allowed range."""
        values = own.copy()
        values[self.rows] = np.clip(own[self.rows], *self.range_of(other))
        return values

    def distances(self, other: Array, own: Array) -> Array:
        """Return the distance of each row from its allowed range; infinite if a number is missing in one run only."""
        (low, high), values = self.range_of(other), own[self.rows]
        with np.errstate(invalid="ignore"):
            out = np.fmax(np.fmax(low - values, values - high), 0.0)
        out = np.where((values == low) | (values == high), 0.0, out)  # equal infinities differ by 0
        has_gap = self.range_of(np.isnan(other))[1] > 0
        return np.where(np.isnan(values), np.where(has_gap, 0.0, np.inf), np.where(np.isnan(low), np.inf, out))

    def other_texts(self, other: Sequence[str], own: Sequence[str]) -> list[int]:
        """Return the rows with a text that differs from the surrounding texts of the other run."""
        spans = zip(*(part.tolist() for part in self[:3]), strict=True)
        return [row for row, first, last in spans if own[row] not in other[first : last + 1]]


def surroundings(other: Array, own: Array, tolerance: float) -> RowsBetween:
    """Return the rows at times `own` within the time of the other run; a row of equal time is its only neighbour.

    Args:
        tolerance: Largest difference of equal times [s].
    """
    after, upto = (np.searchsorted(other, own - tolerance, "left"), np.searchsorted(other, own + tolerance, "right"))
    is_apart = np.diff(own) > tolerance
    alone = np.append(True, is_apart) & np.append(is_apart, True)
    matched = alone & (upto - after == 1)
    first, last = np.where(matched, after, after - 1), np.where(matched, after, upto)
    rows = np.flatnonzero((own >= other[0] - tolerance) & (own <= other[-1] + tolerance))
    is_jump = ((upto - after > 1) | ~alone)[rows]
    return RowsBetween(rows, np.maximum(first[rows], 0), np.minimum(last[rows], other.size - 1), is_jump)


@dataclass(frozen=True)
class Difference:
    """Difference of a signal between two runs.

    Attributes:
        unit: Unit of a; b is converted to it.
        largest: Largest |b − a| in the unit, at time `at` [s]; infinite if a number is missing in one run only or
            dimensions differ.
        rms: Root mean square of b − a.
        scale: Range of a; for a constant its magnitude, or 1 if it is zero.
        share: largest / scale.
        beyond: True if the tolerance is exceeded.
        note: Note on different units, or on text.
        alike: True if the units of both runs have the same dimension.
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

    def as_json(self) -> dict[str, Any]:
        """Return the difference as plain data, without the signal's name; non-finite numbers become None."""
        values = [(k, v) for k, v in asdict(self).items() if k != "name"]
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values}


def common_rows(a: RecordedRun, b: RecordedRun) -> tuple[slice, bool]:
    """Return the rows of a within the time of b, and True if both runs have the same times in these rows."""
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
    """Return the tolerance [s] of equal times: below a step, above rounding."""
    steps = np.diff(time)
    step = float(np.min(steps[steps > 0.0], initial=1.0))
    return max(TIME_TOLERANCE_SHARE * step, CONVERSION_TOLERANCE * float(np.max(np.abs(time), initial=0.0)))


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
        gap[finite & (gap <= CONVERSION_TOLERANCE * np.maximum(np.abs(first), abs(by.offset)))] = 0.0
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
        return f"{unit} has another definition, converted" if by != Conversion() else ""
    if unit and other:
        return f"converted from {other}"
    where = "here" if unit else "in the baseline"
    return f"no unit {where}, assumed {d.unit}" if (unit or other) and d.largest else ""


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

    A text between two rows of the other run must equal the text of one of these rows.

    Args:
        held: Rows of b with the surrounding rows of a, and vice versa; None for equal times.
    """
    first, second = ([*map(as_text, r.results.exact.get(name) or r.results[name])] for r in (a, b))
    time = a.results.time[rows]
    if held is None:
        pairs = zip(first[rows], second[: time.size], strict=True)
        differs = next((float(time[k]) for k, (x, y) in enumerate(pairs) if x != y), None)
    else:
        times = [float(a.results.time[row]) for row in held[1].other_texts(second, first)]
        times += [float(b.results.time[row]) for row in held[0].other_texts(first, second)]
        differs = min(times, default=None)
    if differs is None:
        return Difference(name, "", 0.0, float(time[0]), 0.0, 1.0, 0.0, False, "text")
    return Difference(name, "", 1.0, differs, 1.0, 1.0, 1.0, has_tolerance, "text differs")


def format_size(d: Difference, value: float) -> str:
    """Return a difference as text in the signal's unit; a dash if the signal is not comparable."""
    return amount(value if d.alike else math.nan, d.unit, difference=True)


def format_share(d: Difference) -> str:
    """Return a difference relative to the signal's range."""
    if not d.alike:
        return "not comparable"
    return f"{plain(100 * d.share, 2)} %" if math.isfinite(d.share) else "no number in one run"


@dataclass(frozen=True)
class Compared:
    """Differences of two runs.

    Attributes:
        only_a: Signals that only run a has.
        only_b: Signals that only run b has.
        time: Times [s] of a at which b has values too.
        aligned: True if both runs have the same times.
        shorter: Note about the shorter of two runs; "" for equal spans of time.
    """

    a: RecordedRun
    b: RecordedRun
    differences: tuple[Difference, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    time: Array
    values: dict[str, tuple[Array, Array]]
    aligned: bool
    shorter: str
    tolerance: float | None
    absolute: float

    @property
    def beyond(self) -> list[Difference]:
        """Return signals beyond the tolerance, largest share first."""
        return sorted((d for d in self.differences if d.beyond), key=lambda d: -d.share)

    @property
    def judged(self) -> bool:
        """Return True if a tolerance was given, so that the comparison has a verdict."""
        return self.tolerance is not None

    @property
    def same(self) -> bool:
        """Return True if run b matches run a.

        Every signal of a must be in b and agree within the tolerance (exactly, if there is none). Both runs must
        cover the same time.
        """
        return not self.reasons

    @property
    def reasons(self) -> list[str]:
        """Return the reasons why b does not match a, as phrases; an empty list if b matches."""
        different = self.beyond if self.judged else [d for d in self.differences if d.largest]
        count = sum(d.alike for d in different)
        verb = "beyond the tolerance" if self.judged else "differs" if count == 1 else "differ"
        reasons = [f"{counted(count, 'signal')} {verb}"] if count else []
        reasons += [f"{d.name} is {d.note}" for d in different if not d.alike]
        if missing := len(self.only_a):
            names = some(self.only_a, MAX_LISTED_SIGNALS)
            verb = "is" if missing == 1 else "are"
            reasons.append(f"{counted(missing, 'signal')} of {self.a.path} {verb} missing in {self.b.path}: {names}")
        return reasons + ([self.shorter] if self.shorter else [])

    def verdict(self) -> dict[str, Any]:
        """Return the verdict and its reasons as plain data."""
        return {
            "within": self.same if self.judged else None,
            "reasons": self.reasons if self.judged else None,
            "shorter": self.shorter or None,
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
        }


def compare_runs(a: RecordedRun, b: RecordedRun, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    """Compare b with a at the times of a, and at the other times of b.

    A continuous signal of b is interpolated at the times of a. A row of b between two rows of a counts as equal if its
    value is within the range of both rows. The same rule applies to rows of a between two rows of b for a discrete
    signal.

    Args:
        tolerance: Share of each signal's range in a.
        absolute: Size in the signal's unit, added to the share.

    Raises:
        InputError: The runs have no common signal or time.
    """
    a, b = (replace(run, results=run.results.with_integers()) for run in (a, b))
    in_a, in_b = (dict.fromkeys((*run.results.columns, *run.results.exact)) for run in (a, b))
    common = [name for name in in_a if name in in_b]
    if not common:
        names = [", ".join([*each][:5]) or "none" for each in (in_a, in_b)]
        raise InputError.at(b.path, f"has no signal in common with {a.path}: {names[1]} here, {names[0]} there")
    rows, aligned = common_rows(a, b)
    time = a.results.time[rows]
    if not time.size:
        spans = [f"{t[0]:g} … {t[-1]:g} s" if t.size else "no rows" for t in (a.results.time, b.results.time)]
        raise InputError.at(b.path, f"has no time in common with {a.path}: {spans[1]} here, {spans[0]} there")
    of_a, of_b, has_tolerance = a.results, b.results, tolerance is not None
    values: dict[str, tuple[Array, Array]] = {}
    differences, held = list[Difference](), None
    if not aligned:
        close = min(map(time_tolerance, (of_a.time, of_b.time)))
        held = theirs, ours = surroundings(of_a.time, of_b.time, close), surroundings(of_b.time, of_a.time, close)
        between, jumps = theirs.apart(), ours.apart(jumps=True)
    for name in common:
        if not all(name in r and not (name in r.exact and is_rounded(r[name])) for r in (of_a, of_b)):
            differences.append(compare_text(a, b, name, rows, held, has_tolerance=has_tolerance))
            continue
        unit, other, by = of_a.units.get(name, ""), of_b.units.get(name, ""), unit_conversion(b, a, name)
        if by is None:
            note = f"{unit or '1'} in one run, {other or '1'} in the other: these units cannot be converted"
            far = math.inf
            sizes = far, float(time[0]), far, 1.0, far
            differences.append(Difference(name, unit, *sizes, has_tolerance, note, alike=False))
            continue
        first, second = of_a[name], of_b[name] if by == Conversion() else by.factor * of_b[name] + by.offset
        around = None
        if held is None:
            at_times = second[: time.size]
        elif is_held(a, b, name):
            around, at_times = theirs, ours.nearest(second, first)[rows]
        else:
            at_jumps = np.isin(np.arange(of_a.time.size)[rows], jumps.rows)
            at_times = np.where(at_jumps, jumps.nearest(second, first)[rows], np.interp(time, of_b.time, second))
            around = between
        values[name] = first[rows], at_times
        found = compare_numbers(name, unit or other, time, values[name], by)
        notes = [unit_note(unit, other, found, by)]
        if found.largest and (half := bands_of_run(a.manifest, name, time)) is not None:
            gaps = np.abs(at_times - first[rows])[np.isfinite(half)]
            beyond_band = float(np.mean(gaps > half[np.isfinite(half)])) if gaps.size else 0.0
            notes.append(f"for {percent(beyond_band)} of the time beyond the error band of the baseline")
        if around is not None and around.rows.size:
            outside = around.distances(first, second)  # of intermediate rows of b from the range of a
            row = int(np.argmax(outside))
            if (size := float(outside[row])) > max(found.largest, CONVERSION_TOLERANCE * found.scale):
                at = float(of_b.time[around.rows[row]])
                found = replace(found, largest=size, at=at, share=size / found.scale)
                notes.append("between rows of the baseline")
        is_beyond = tolerance is not None and not found.largest <= absolute + tolerance * found.scale  # also of NaN
        differences.append(replace(found, beyond=is_beyond, note="; ".join(filter(None, notes))))
    step = float(np.max(np.diff(of_a.time))) if of_a.time.size > 1 else 0.0
    ends = []
    for verb, row in (("begins", 0), ("ends", -1)):
        at, then = float(of_a.time[row]), float(of_b.time[row])
        if abs(at - then) > rounding(max(abs(at), abs(then)), 1e3 * step):
            earlier, later = (a.path, b.path) if at < then else (b.path, a.path)
            ends.append(f"{earlier} {verb} at {min(at, then):.6g} s, {later} at {max(at, then):.6g} s")
    only_a, only_b = tuple(n for n in in_a if n not in in_b), tuple(n for n in in_b if n not in in_a)
    shorter = "; ".join(ends)
    return Compared(a, b, tuple(differences), only_a, only_b, time, values, aligned, shorter, tolerance, absolute)


def unit_conversion(of: RecordedRun, to: RecordedRun, name: str) -> Conversion | None:
    """Return the conversion of a signal to its unit in another run; None if the dimensions differ.

    Unit definitions of the FMUs are used if both runs have recorded them.
    """
    units = [run.results.units.get(name, "") for run in (of, to)]
    definitions: list[Any] = [run.manifest.get("unit_definitions") for run in (of, to)]
    if None in definitions or not any(name in known for known in definitions):
        return conversion(*units)
    here, there = (
        Signal(name, unit, tuple(known[name]) if name in known else definition_of(unit))
        for unit, known in zip(units, definitions, strict=True)
    )
    by = here.conversion(there)
    return None if by is None else Conversion(*by)


def is_held(a: RecordedRun, b: RecordedRun, name: str) -> bool:
    """Return True if a signal is constant between rows, by a run's record or because both runs have integers."""
    recorded = [run for run in (a, b) if "discrete" in run.manifest]
    if not recorded:
        return all(name in run.results.whole for run in (a, b))
    return any(name in {*r.results.whole, *r.results.exact, *r.manifest["discrete"]} for r in recorded)


def criteria_of(runs: Sequence[RecordedRun]) -> dict[str, list[dict[str, Any] | None]]:
    """Return title → outcome in each run, None for runs without the criterion."""
    by_title: dict[str, list[dict[str, Any] | None]] = {}
    for k, run in enumerate(runs):
        for entry in run.criteria:
            by_title.setdefault(criterion_title(entry), [None] * len(runs))[k] = entry
    return by_title


def criterion_title(outcome: Mapping[str, Any]) -> str:
    """Return a criterion without its limit as text: `settling time of plant.x band 0.02`."""
    title = f"{str(outcome.get('kind', '?')).replace('_', ' ')} of {outcome.get('of', '?')}"
    return title + "".join(f" {w} {outcome[w]}" for w in ("to", "band", "after", "until") if outcome.get(w))


def describe_largest(d: Difference) -> str:
    """Return a phrase on the largest difference of a signal."""
    if not d.alike:
        return f"{d.name} is {d.note}"
    if not math.isfinite(d.share):
        return f"{d.name}, which has no number in one run at {d.at:.6g} s"
    return f"{d.name} by {format_size(d, d.largest)} at {d.at:.6g} s ({format_share(d)} of its range)"
