"""Differences between the signals of two runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.text import amount, counted
from cosim.base.times import rounding
from cosim.base.units import Conversion, conversion, definition_of
from cosim.blocks.component import Signal
from cosim.comparison import signals
from cosim.comparison.intermediate_rows import rows_at_jumps, rows_between, surroundings
from cosim.comparison.signals import Difference, Tolerance, format_share, format_size
from cosim.simulation.run_files import RecordedRun
from cosim.storage.results import is_rounded

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

MAX_PLOTTED = 4  # signals in a figure by default
MAX_LISTED = 12  # signals in a short text


@dataclass(frozen=True, repr=False)
class Compared:
    """Differences of two runs.

    Attributes:
        only_a: Signals of run a alone.
        only_b: Signals of run b alone.
        time: Times [s] of a at which b has values too.
        aligned: Whether both runs have the same times.
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
    def ranking(self) -> list[Difference]:
        """Return all signals, largest share first."""
        return sorted(self.differences, key=lambda d: -d.share)

    @property
    def beyond(self) -> list[Difference]:
        """Return signals beyond the tolerance, largest share first."""
        return [d for d in self.ranking if d.beyond]

    @property
    def judged(self) -> bool:
        """Return whether a tolerance was given, so that the comparison has a verdict."""
        return self.tolerance is not None

    @property
    def same(self) -> bool:
        """Return whether run b matches run a.

        Every signal of a must be in b and agree within the tolerance (exactly, if there is none). Both runs must
        cover the same time.
        """
        return not self.reasons

    @property
    def reasons(self) -> list[str]:
        """Return the reasons why b does not match a, as phrases; empty for a match."""
        different = self.beyond if self.judged else [d for d in self.differences if d.largest]
        count = sum(d.alike for d in different)
        verb = "beyond the tolerance" if self.judged else _differ(count)
        reasons = [f"{counted(count, 'signal')} {verb}"] if count else []
        reasons += [f"{d.name} is {d.note}" for d in different if not d.alike]
        if missing := len(self.only_a):
            names = ", ".join(self.only_a[:MAX_LISTED]) + (", …" if missing > MAX_LISTED else "")
            verb = "is" if missing == 1 else "are"
            reasons.append(f"{counted(missing, 'signal')} of {self.a.path} {verb} missing in {self.b.path}: {names}")
        return reasons + ([self.shorter] if self.shorter else [])

    def __repr__(self) -> str:
        cells, more = self._table()
        lines = ["  ".join(row) for row in cells] + ([more] if more else [])
        return "\n  ".join([self._heading(), *lines])

    def to_pandas(self) -> pandas.DataFrame:
        """Return one row per common signal, the largest difference first; raise ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        return pandas.DataFrame([asdict(d) for d in self.ranking]).set_index("name")

    def plot(self, *names: str) -> Figure:
        """Return a matplotlib figure with both runs and b − a, by default for the most different signals.

        Raises:
            KeyError: A name is not numeric in both runs.
        """
        from cosim.comparison.signal_panels import panels_of
        from cosim.simulation.report.figures import sheet
        from cosim.storage.yaml_file import did_you_mean

        for name in names:
            if name not in self.values:
                raise KeyError(f'no signal "{name}" in both{did_you_mean(name, self.values)}')
        numeric = [d for d in self.ranking if d.name in self.values]
        plotted = [d for d in numeric if d.name in names] if names else numeric[:MAX_PLOTTED]
        runs = self.a.name, self.b.name
        return sheet(self.time, [p for d in plotted for p in panels_of(d.name, d.unit, runs, self.values[d.name])])

    def _repr_html_(self) -> str:
        from cosim.comparison.signal_panels import panels_of
        from cosim.report.cell.cell import cell_of, heading, rows_to_show, table

        cells = self._table()[0]
        listed = table(("signal", "largest", "at", "of its range"), cells, len(self.differences) - len(cells))
        drawn = [d for d in self.ranking if d.name in self.values][:MAX_PLOTTED]
        rows = rows_to_show([values for d in drawn for values in self.values[d.name]])
        pairs = [(self.values[d.name][0][rows], self.values[d.name][1][rows]) for d in drawn]
        runs = self.a.name, self.b.name
        panels = [p for d, pair in zip(drawn, pairs, strict=True) for p in panels_of(d.name, d.unit, runs, pair)]
        omitted = len(self.values) - len(drawn)
        chart = cell_of(self.time[rows], panels, self._heading(), rows=len(self.time), omitted=omitted)
        return heading(self._heading()) + listed + chart

    def _heading(self) -> str:
        return f"{self.a.name} and {self.b.name}: {sentence(self)}"

    def _table(self) -> tuple[list[tuple[str, str, str, str]], str]:
        """Return the rows of the largest differences as texts, and a text with the number of omitted signals."""
        cells = [(d.name, format_size(d, d.largest), f"{d.at:.6g} s", format_share(d)) for d in self.ranking]
        return cells[:MAX_LISTED], f"… and {len(cells) - MAX_LISTED} more" if len(cells) > MAX_LISTED else ""

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain data; non-finite becomes None."""
        return {
            "a": str(self.a.path),
            "b": str(self.b.path),
            "tolerance": self.tolerance,
            "absolute": self.absolute,
            "within": self.same if self.judged else None,
            "reasons": self.reasons if self.judged else None,
            "shorter": self.shorter or None,
            "signals": [
                {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(d).items()}
                for d in self.differences
            ],
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "same_times": self.aligned,
            "criteria": [{"what": w, "a": a, "b": b} for w, a, b in criteria_of(self)],
        }


def compare_runs(a: RecordedRun, b: RecordedRun, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    """Compare b with a at the times of a, and at the other times of b.

    A continuous signal of b is interpolated at the times of a. A row of b between two rows of a counts as equal if its
    value is within the range of both rows. For a discrete signal this holds for rows of a between two rows of b too.

    Args:
        tolerance: Share of each signal's range in a.
        absolute: Size in the signal's unit, added to the share.

    Raises:
        InputError: The runs have no common signal or time.
    """
    a, b = (replace(run, results=run.results.with_integers()) for run in (a, b))
    in_both = {*_names(a)} & {*_names(b)}
    common = [name for name in _names(a) if name in in_both]
    if not common:
        names = [", ".join(_names(r)[:5]) or "none" for r in (a, b)]
        raise InputError.at(b.path, f"shares no signal with {a.path}: it has {names[1]}; that has {names[0]}")
    rows, aligned = signals.common_rows(a, b)
    time = a.results.time[rows]
    if not time.size:
        spans = [f"{t[0]:g} … {t[-1]:g} s" if t.size else "no rows" for t in (a.results.time, b.results.time)]
        raise InputError.at(b.path, f"shares no time with {a.path}: it has {spans[1]}, that {spans[0]}")
    overlap = _Overlap(a, b, rows, aligned, Tolerance(tolerance, absolute))
    differences = tuple(overlap.difference(name) for name in common)
    only_a, only_b = (tuple(name for name in _names(r) if name not in in_both) for r in (a, b))
    data = differences, only_a, only_b, time, overlap.values, aligned
    return Compared(a, b, *data, _describe_ends(a, b), tolerance, absolute)


def _names(run: RecordedRun) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*run.results.columns, *run.results.exact)))


class _Overlap:
    """Rows of run a within the time of run b.

    Attribute `values` collects the numbers of both runs for each compared signal.
    """

    def __init__(self, a: RecordedRun, b: RecordedRun, rows: slice, aligned: bool, allowed: Tolerance) -> None:
        self.a, self.b, self.rows, self.aligned, self.allowed = a, b, rows, aligned, allowed
        times = a.results.time, b.results.time
        self.time = times[0][rows]
        close = min(map(signals.time_tolerance, times))
        self.between = None if aligned else rows_between(*times, close)
        self.jumps = None if aligned else rows_at_jumps(*times[::-1], close)
        self.held = None if aligned else (surroundings(*times, close), surroundings(*times[::-1], close))
        self.values: dict[str, tuple[Array, Array]] = {}

    def difference(self, name: str) -> Difference:
        """Return the comparison of a signal."""
        a, b = self.a.results, self.b.results
        has_tolerance = self.allowed.relative is not None
        if not all(name in r and not (name in r.exact and is_rounded(r[name])) for r in (a, b)):
            return signals.compare_text(self.a, self.b, name, self.rows, self.held, has_tolerance=has_tolerance)
        unit, other = a.units.get(name, ""), b.units.get(name, "")
        by = unit_conversion(self.b, self.a, name)
        if by is None:
            return signals.compare_other_units(name, unit, other, self.time, has_tolerance=has_tolerance)
        first, second = a[name], b[name] if by == Conversion() else by.factor * b[name] + by.offset
        between = self.between
        if self.held is None or self.jumps is None:
            at_times = second[: self.time.size]
        elif is_held(self.a, self.b, name):
            between, theirs = self.held
            at_times = theirs.nearest(second, first)[self.rows]
        else:
            at_times = np.interp(self.time, b.time, second)
            at_jumps = np.isin(np.arange(a.time.size)[self.rows], self.jumps.rows)
            at_times = np.where(at_jumps, self.jumps.nearest(second, first)[self.rows], at_times)
        self.values[name] = first[self.rows], at_times
        difference = signals.compare_numbers(name, unit or other, self.time, self.values[name], self.allowed, by)
        difference = replace(difference, note=signals.unit_note(unit, other, difference, by))
        if between is None:
            return difference
        outside, at = between.outside(first, second)
        return signals.include_rows_between(difference, outside, at, self.allowed)


def unit_conversion(of: RecordedRun, to: RecordedRun, name: str) -> Conversion | None:
    """Return the conversion of a signal to its unit in another run; None for other dimensions.

    Definitions of units by the FMUs count if both runs have a record of them.
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
    """Return whether a signal holds between rows: by the record of a run, else if it has whole numbers in both."""
    known = [run.holds(name) for run in (a, b)]
    return True in known or (known == [None, None] and all(name in run.results.whole for run in (a, b)))


def criteria_of(c: Compared) -> Sequence[tuple[str, Any, Any]]:
    """Return all criteria with outcomes in a and b."""
    by_title: dict[str, list[Any]] = {}
    for side, run in enumerate((c.a, c.b)):
        for entry in run.criteria:
            by_title.setdefault(criterion_title(entry), [None, None])[side] = entry
    return [(title, *both) for title, both in by_title.items()]


def criterion_title(entry: dict[str, Any]) -> str:
    """Return a criterion without its limit as text."""
    parts = [f"{str(entry.get('kind', '?')).replace('_', ' ')} of {entry.get('of', '?')}"]
    parts += [f"{word} {entry[word]}" for word in ("to", "band", "after", "until") if entry.get(word)]
    return " ".join(parts)


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _differ(count: int) -> str:
    return "differs" if count == 1 else "differ"


def is_one_run(a: RecordedRun, b: RecordedRun) -> bool:
    """Return whether two runs were read from one path."""
    return a.path.exists() and a.path.resolve() == b.path.resolve()


def sentence(c: Compared) -> str:
    """Return a summary of the comparison in a sentence."""
    if is_one_run(c.a, c.b) and not any(d.largest for d in c.differences):
        return f"This is one run, compared with itself: {counted(len(c.differences), 'signal')} equal."
    return _sentence_of_two(c)


def _sentence_of_two(c: Compared) -> str:
    count, different = len(c.differences), sum(d.largest > 0 for d in c.differences)
    of_both = " that both have" if c.only_a else ""
    every = f"All {counted(count, 'signal')}{of_both} are" if count > 1 else ""
    most = describe_largest(max(c.differences, key=lambda d: d.share))
    if not different:
        where = "in every row" if c.aligned else "at the times of a, and between them nowhere outside of it"
        text = f"{every or f'The signal{of_both} is'} equal {where}."
    elif not c.judged:
        text = f"{different} of {counted(count, 'signal')} {_differ(different)}; {most}."
    elif c.beyond:
        beyond, largest = len(c.beyond), describe_largest(c.beyond[0])
        text = f"{beyond} of {counted(count, 'signal')} {_are(beyond)} beyond the tolerance; {largest}."
    else:
        text = f"{every} within the tolerance; {most}." if every else f"Within the tolerance: {most}."
    if c.only_a:
        text += f" {counted(len(c.only_a), 'signal')} of a {_are(len(c.only_a))} not in b."
    return text + (f" {c.shorter}." if c.shorter else "")


def describe_largest(d: Difference) -> str:
    """Return a phrase on the largest difference of a signal."""
    if not d.alike:
        return f"{d.name} is {d.note}"
    if not math.isfinite(d.share):
        return f"most {d.name}, which has no number in one run at {d.at:.6g} s"
    return f"most {d.name}, by {amount(d.largest, d.unit)} at {d.at:.6g} s ({format_share(d)} of its range)"


def _describe_ends(a: RecordedRun, b: RecordedRun) -> str:
    """Return a phrase on the shorter run; "" if both runs cover the same time."""
    step = float(np.max(np.diff(a.results.time))) if a.results.time.size > 1 else 0.0
    parts = []
    for verb, row in (("begins", 0), ("ends", -1)):
        at = [float(r.results.time[row]) for r in (a, b)]
        if abs(at[0] - at[1]) > rounding(max(map(abs, at)), 1e3 * step):
            first, second = (a.path, b.path) if at[0] < at[1] else (b.path, a.path)
            parts.append(f"{first} {verb} at {min(at):.6g} s, {second} at {max(at):.6g} s")
    return "; ".join(parts)
