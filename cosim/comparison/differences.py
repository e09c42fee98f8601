"""How far the signals of two runs lie apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.text import amount, counted
from cosim.base.units import Conversion, conversion
from cosim.comparison.intermediate_rows import rows_between
from cosim.comparison.signals import (
    Difference,
    at_times,
    near,
    of_numbers,
    of_other_units,
    of_text,
    of_units,
    rows_of,
    shared,
    sized,
    with_rows_between,
)  # fmt: skip
from cosim.simulation.run_files import Ran

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

DRAWN = 4  # signals in a picture, where nobody says which
SHOWN = 12  # signals, where a comparison is told in a few lines


@dataclass(frozen=True, repr=False)
class Compared:
    """Two runs held against each other.

    only_a, only_b: signals of one alone
    time:    [s], of a, where b has values too; `b` holds them there
    aligned: both have the same times
    shorter: what is to be said where one begins or ends before the other, "" where none does
    """

    a: Ran
    b: Ran
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
        """Signals that differ by more than the tolerance, most of their scale first."""
        return sorted((d for d in self.differences if d.beyond), key=lambda d: -d.share)

    @property
    def judged(self) -> bool:
        """A tolerance was given."""
        return self.tolerance is not None

    @property
    def same(self) -> bool:
        """Every signal of a is in b, within the tolerance (without one, equal), over the whole of both."""
        return not self.reasons

    @property
    def reasons(self) -> list[str]:
        """Why they are not the same, in words; none where they are."""
        apart = self.beyond if self.judged else [d for d in self.differences if d.largest]
        far = sum(d.alike for d in apart)
        verb = "beyond the tolerance" if self.judged else "differs" if far == 1 else "differ"
        found = [f"{counted(far, 'signal')} {verb}"] if far else []
        found += [f"{d.name} is {d.note}" for d in apart if not d.alike]
        if self.only_a:
            more = ", …" if len(self.only_a) > SHOWN else ""
            verb = "is" if len(self.only_a) == 1 else "are"
            what = f"{counted(len(self.only_a), 'signal')} of {self.a.path} {verb} missing in {self.b.path}"
            found.append(f"{what}: {', '.join(self.only_a[:SHOWN])}{more}")
        return found + ([self.shorter] if self.shorter else [])

    def __repr__(self) -> str:
        ranked, more = self._ranked()
        lines = ["  ".join(cells) for cells in ranked] + ([more] if more else [])
        return "\n  ".join([self._heading(), *lines])

    def to_pandas(self) -> pandas.DataFrame:
        """A row a signal that both have, the most different first; ImportError where pandas is not installed."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        ranked = sorted(self.differences, key=lambda d: -d.share)
        return pandas.DataFrame([asdict(d) for d in ranked]).set_index("name")

    def plot(self, *names: str) -> Figure:
        """A matplotlib figure of both runs over each other and of b − a; of the most different signals without names.

        KeyError of a name that has no numbers in both.
        """
        from cosim.comparison.signal_panels import panels_of
        from cosim.simulation.report.figures import sheet
        from cosim.storage.yaml_file import did_you_mean

        for name in names:
            if name not in self.values:
                raise KeyError(f'no signal "{name}" in both{did_you_mean(name, self.values)}')
        ranked = sorted((d for d in self.differences if d.name in self.values), key=lambda d: -d.share)
        drawn = [d for d in ranked if d.name in names] if names else ranked[:DRAWN]
        runs = self.a.name, self.b.name
        return sheet(self.time, [p for d in drawn for p in panels_of(d.name, d.unit, runs, self.values[d.name])])

    def _repr_html_(self) -> str:
        from html import escape

        ranked, more = self._ranked()
        head = "".join(f"<th>{word}</th>" for word in ("signal", "largest", "at", "of its range"))
        rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>" for cells in ranked)
        note = f"<p>{more}</p>" if more else ""
        return f"<p><b>{escape(self._heading())}</b></p><table><tr>{head}</tr>{rows}</table>{note}"

    def _heading(self) -> str:
        return f"{self.a.name} and {self.b.name}: {sentence(self)}"

    def _ranked(self) -> tuple[list[tuple[str, str, str, str]], str]:
        """The signals that differ most, as text, and how many more there are."""
        ranked = sorted(self.differences, key=lambda d: -d.share)
        cells = [(d.name, sized(d, d.largest), f"{d.at:.6g} s", shared(d)) for d in ranked[:SHOWN]]
        return cells, f"… and {len(ranked) - SHOWN} more" if len(ranked) > SHOWN else ""

    def as_json(self) -> dict[str, Any]:
        """What a script asks, in plain data; what is not finite is null."""
        found = [
            {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(d).items()}
            for d in self.differences
        ]
        return {
            "a": str(self.a.path), "b": str(self.b.path), "tolerance": self.tolerance, "absolute": self.absolute,
            "within": self.same if self.judged else None, "reasons": self.reasons if self.judged else None,
            "shorter": self.shorter or None, "signals": found,
            "only_a": list(self.only_a), "only_b": list(self.only_b), "same_times": self.aligned,
            "criteria": [{"what": w, "a": a, "b": b} for w, a, b in criteria_of(self)],
        }  # fmt: skip


def compared(a: Ran, b: Ran, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    """Hold b against a, at the times of a, and its rows between against what a spans there.

    Raises InputError where they share no signal or no time.

    tolerance: a share of each signal's range in a; absolute: in its unit, added to that
    """
    there = {*b.results.columns, *b.results.exact}
    shared = [n for n in (*a.results.columns, *a.results.exact) if n in there]
    if not shared:
        names = [", ".join((*r.results.columns, *r.results.exact)[:5]) or "none" for r in (a, b)]
        raise InputError(
            [Fault(b.path, 0, 0, f"shares no signal with {a.path}: it has {names[1]}; that has {names[0]}")]
        )
    rows, aligned = rows_of(a, b)
    time = a.results.time[rows]
    if not time.size:
        spans = [
            f"{r.results.time[0]:g} … {r.results.time[-1]:g} s" if r.results.time.size else "no rows" for r in (a, b)
        ]
        raise InputError([Fault(b.path, 0, 0, f"shares no time with {a.path}: it has {spans[1]}, that {spans[0]}")])
    between = None if aligned else rows_between(a.results.time, b.results.time, near(a.results.time))
    differences, values = [], {}
    for name in shared:
        if name in a.results.exact or name in b.results.exact:
            differences.append(of_text(a, b, name, rows, between, judged=tolerance is not None))
            continue
        first = a.results[name][rows]
        second = b.results[name][: time.size] if aligned else at_times(time, b.results.time, b.results[name])
        unit, other = (r.results.units.get(name, "") for r in (a, b))
        by = conversion(other, unit)
        if by is None:
            differences.append(of_other_units(name, unit, other, time, judged=tolerance is not None))
            continue
        is_converted = by != Conversion()
        second = by.factor * second + by.offset if is_converted else second
        values[name] = first, second
        found = of_numbers(
            name, unit or other, time, first, second, tolerance, absolute, rounded=is_converted, offset=by.offset
        )
        found = replace(found, note=of_units(unit, other, found))
        if between is not None:
            found = with_rows_between(
                found, *between.outside(a.results[name], by.factor * b.results[name] + by.offset), tolerance, absolute
            )
        differences.append(found)
    only_a, only_b = (tuple(n for n in (*r.results.columns, *r.results.exact) if n not in {*shared}) for r in (a, b))
    return Compared(
        a, b, tuple(differences), only_a, only_b, time, values, aligned, _shorter(a, b), tolerance, absolute
    )


def criteria_of(c: Compared) -> Sequence[tuple[str, Any, Any]]:
    """Each criterion of either run: what it is, and how it came out in a and in b, None where it is not there."""
    found: dict[str, list[Any]] = {}
    for side, ran in enumerate((c.a, c.b)):
        for entry in ran.criteria:
            found.setdefault(_what(entry), [None, None])[side] = entry
    return [(what, *both) for what, both in found.items()]


def _what(entry: dict[str, Any]) -> str:
    parts = [f"{str(entry.get('kind', '?')).replace('_', ' ')} of {entry.get('of', '?')}"]
    parts += [f"{word} {entry[word]}" for word in ("to", "band", "after", "until") if entry.get(word)]
    return " ".join(parts)


def sentence(c: Compared) -> str:
    """What the comparison came to."""
    count = len(c.differences)
    all_ = f"All {counted(count, 'signal')}{' that both have' if c.only_a else ''}"
    most = max(c.differences, key=lambda d: d.share)
    if not any(d.largest for d in c.differences):
        where = "in every row" if c.aligned else "at the times of a, and between them nowhere outside of it"
        one = "The signal that both have" if c.only_a else "The signal"
        told = f"{all_} are equal {where}." if count > 1 else f"{one} is equal {where}."
    elif c.judged and not c.beyond:
        told = (
            f"{all_} are within the tolerance; {_most(most)}." if count > 1 else f"Within the tolerance: {_most(most)}."
        )
    elif c.judged:
        verb = "is" if len(c.beyond) == 1 else "are"
        told = f"{len(c.beyond)} of {counted(count, 'signal')} {verb} beyond the tolerance; {_most(c.beyond[0])}."
    else:
        verb = "differs" if sum(d.largest > 0 for d in c.differences) == 1 else "differ"
        told = f"{sum(d.largest > 0 for d in c.differences)} of {counted(count, 'signal')} {verb}; {_most(most)}."
    if c.only_a:
        told += f" {counted(len(c.only_a), 'signal')} of a {'is' if len(c.only_a) == 1 else 'are'} not in b."
    return told + (f" {c.shorter}." if c.shorter else "")


def _most(d: Difference) -> str:
    if not d.alike:
        return f"{d.name} is {d.note}"
    if not math.isfinite(d.share):
        return f"most {d.name}, which has no number in one run at {d.at:.6g} s"
    return f"most {d.name}, by {amount(d.largest, d.unit)} at {d.at:.6g} s ({shared(d)} of its range)"


def _shorter(a: Ran, b: Ran) -> str:
    """Which begins late and which ends early, in words."""
    step = float(np.max(np.diff(a.results.time))) if a.results.time.size > 1 else 0.0
    told = []
    for verb, row in (("begins", 0), ("ends", -1)):
        at = [float(r.results.time[row]) for r in (a, b)]
        if abs(at[0] - at[1]) > 1e-6 * step + 1e-9:
            first, second = (a, b) if at[0] < at[1] else (b, a)
            told.append(f"{first.path} {verb} at {min(at):.6g} s, {second.path} at {max(at):.6g} s")
    return "; ".join(told)
