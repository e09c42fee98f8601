"""How far the signals of two runs lie apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.arrays import Array
from cosim.comparison.between import Between, rows_between
from cosim.comparison.ran import Ran
from cosim.errors import Fault, InputError
from cosim.text import amount, counted, plain
from fmus.units import factor

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

SAME_TIME = 1e-9  # of a step
ROUNDING = 8 * float(np.finfo(float).eps)  # of a value, by a change of unit there and back
BETWEEN = "between rows of a"
DRAWN = 4  # signals in a picture, where nobody says which
SHOWN = 12  # signals, where a comparison is told in a few lines


@dataclass(frozen=True)
class Difference:
    """One signal of both runs.

    unit:    that of a, to which b is converted
    largest: most that |b − a| comes to, in its unit, at a time [s]; infinite where one run alone has no number, or
             where the dimensions of their units differ, so that numbers say nothing
    rms:     of b − a
    scale:   the range of a, its size where it is constant, or 1
    share:   largest / scale
    beyond:  the tolerance
    note:    what is to be known of units or text
    alike:   the dimensions of both units agree
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
        """Every signal of a is in b and within the tolerance, over the whole of both runs; b may have more."""
        return not self.reasons

    @property
    def reasons(self) -> list[str]:
        """Why they are not the same, in words; none where they are."""
        found = [f"{counted(len(self.beyond), 'signal')} beyond the tolerance"] if self.beyond else []
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
        from cosim.comparison.panels import panels_of
        from cosim.simulation.report.figures import sheet
        from cosim.yaml_file import did_you_mean

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
    rows, aligned = _rows(a, b)
    time = a.results.time[rows]
    if not time.size:
        spans = [
            f"{r.results.time[0]:g} … {r.results.time[-1]:g} s" if r.results.time.size else "no rows" for r in (a, b)
        ]
        raise InputError([Fault(b.path, 0, 0, f"shares no time with {a.path}: it has {spans[1]}, that {spans[0]}")])
    between = None if aligned else rows_between(a.results.time, b.results.time, _near(a.results.time))
    differences, values = [], {}
    for name in shared:
        if name in a.results.exact or name in b.results.exact:
            differences.append(_of_text(a, b, name, rows, between))
            continue
        first = a.results[name][rows]
        second = b.results[name][: time.size] if aligned else _at(time, b.results.time, b.results[name])
        unit, other = (r.results.units.get(name, "") for r in (a, b))
        scale = factor(other, unit)
        if scale is None:
            differences.append(_of_other_units(name, unit, other, time, judged=tolerance is not None))
            continue
        second = second * scale if scale != 1.0 else second
        values[name] = first, second
        found = _of_numbers(name, unit or other, time, first, second, tolerance, absolute, rounded=scale != 1.0)
        found = replace(found, note=_of_units(unit, other, found))
        if between is not None:
            found = _with(found, *between.outside(a.results[name], b.results[name] * scale), tolerance, absolute)
        differences.append(found)
    only_a, only_b = (tuple(n for n in (*r.results.columns, *r.results.exact) if n not in {*shared}) for r in (a, b))
    return Compared(
        a, b, tuple(differences), only_a, only_b, time, values, aligned, _shorter(a, b), tolerance, absolute
    )


def _rows(a: Ran, b: Ran) -> tuple[slice, bool]:
    """Rows of a at whose times b has values, and whether they are the rows of b."""
    first, second = a.results.time, b.results.time
    count = min(first.size, second.size)
    if not count:
        return slice(0, 0), False
    near = _near(first)
    if np.all(np.abs(first[:count] - second[:count]) <= near):
        return slice(0, count), True
    low, high = np.searchsorted(first, [second[0] - near, second[-1] + near])
    return slice(int(low), int(high)), False


def _near(time: Array) -> float:
    """How far apart two times are that are meant to be one [s]: far less than a step, more than rounding."""
    steps = np.diff(time)
    step = float(np.min(steps[steps > 0.0], initial=1.0))
    return max(SAME_TIME * step, ROUNDING * float(np.max(np.abs(time), initial=0.0)))


def _at(time: Array, times: Array, values: Array) -> Array:
    """Values at other times, straight between rows."""
    return np.interp(time, times, values)


def _of_numbers(
    name: str, unit: str, time: Array, first: Array, second: Array, tolerance: float | None, absolute: float,
    *, rounded: bool,
) -> Difference:  # fmt: skip
    """How far numbers of one unit lie apart; `rounded`: one side was converted, to the last bit or two."""
    same = (first == second) | (np.isnan(first) & np.isnan(second))
    finite = np.isfinite(first) & np.isfinite(second)
    gap = np.where(same, 0.0, np.inf)
    gap[finite] = np.abs(second[finite] - first[finite])
    if rounded:
        gap[finite & (gap <= ROUNDING * np.abs(first))] = 0.0
    row = int(np.argmax(gap))
    good = first[np.isfinite(first)]
    span = float(np.ptp(good)) if good.size else 0.0
    scale = span or (float(np.max(np.abs(good))) if good.size else 0.0) or 1.0
    largest = float(gap[row])
    beyond = tolerance is not None and not largest <= absolute + tolerance * scale
    rms = float(np.sqrt(np.mean(gap**2))) if math.isfinite(largest) else math.inf
    return Difference(name, unit, largest, float(time[row]), rms, scale, largest / scale, beyond)


def _with(d: Difference, outside: float, at: float, tolerance: float | None, absolute: float) -> Difference:
    """With what b does between the rows of a, where that is more."""
    if outside <= max(d.largest, ROUNDING * d.scale):
        return d
    beyond = tolerance is not None and not outside <= absolute + tolerance * d.scale
    note = "; ".join(filter(None, [d.note, BETWEEN]))
    return replace(d, largest=outside, at=at, share=outside / d.scale, beyond=d.beyond or beyond, note=note)


def _of_other_units(name: str, unit: str, other: str, time: Array, *, judged: bool) -> Difference:
    """Numbers in units between which there is no conversion."""
    note = f"in {unit} in one, in {other} in the other"
    return Difference(name, unit, math.inf, float(time[0]), math.inf, 1.0, math.inf, judged, note, alike=False)


def _of_units(unit: str, other: str, d: Difference) -> str:
    """What is to be known of the units of both sides."""
    if unit and other:
        return f"{other} in b, converted" if unit != other else ""
    return f"no unit in {'b' if unit else 'a'}, taken as {d.unit}" if (unit or other) and d.largest else ""


def _of_text(a: Ran, b: Ran, name: str, rows: slice, between: Between | None) -> Difference:
    """Text: 1 where a row differs, 0 where none does; at other times that of b holds until its next row."""
    aligned = between is None
    first, second = (list(r.results.exact.get(name) or [str(v) for v in r.results[name]]) for r in (a, b))
    time = a.results.time[rows]
    places = range(time.size) if aligned else np.searchsorted(b.results.time, time + SAME_TIME, side="right") - 1
    pairs = zip(first[rows], (second[max(0, int(k))] for k in places), strict=True)
    differs = next((float(time[k]) for k, (x, y) in enumerate(pairs) if x != y), None)
    if differs is None and between is not None:
        differs = between.other_text(first, second)
    if differs is None:
        return Difference(name, "", 0.0, float(time[0]), 0.0, 1.0, 0.0, False, "text")
    return Difference(name, "", 1.0, differs, 1.0, 1.0, 1.0, True, "text differs")


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


def sized(d: Difference, value: float) -> str:
    """A difference in the unit of its signal, a dash where there is none."""
    return amount(value if d.alike else math.nan, d.unit)


def shared(d: Difference) -> str:
    """A difference as a share of the range of its signal."""
    if not d.alike:
        return "not comparable"
    return f"{plain(100 * d.share, 2)} %" if math.isfinite(d.share) else "no number in one run"
