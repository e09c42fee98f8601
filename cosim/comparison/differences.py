"""How far the signals of two runs lie apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.arrays import Array
from cosim.comparison.ran import Ran
from cosim.errors import Fault, InputError
from cosim.text import amount, counted, plain

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

SAME_TIME = 1e-9  # of a step
DRAWN = 4  # signals in a picture, where nobody says which
SHOWN = 12  # signals, where a comparison is told in a few lines


@dataclass(frozen=True)
class Difference:
    """One signal of both runs.

    largest: most that |b − a| comes to, in its unit, at a time [s]; infinite where one run alone has no number
    rms:     of b − a
    scale:   the range of a, its size where it is constant, or 1
    share:   largest / scale
    beyond:  the tolerance
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


@dataclass(frozen=True, repr=False)
class Compared:
    """Two runs held against each other.

    only_a, only_b: signals of one alone
    time:    [s], of a, where b has values too; `b` holds them there
    aligned: both have the same times
    shorter: what is to be said where one ends before the other, "" where none does
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
        """Within the tolerance, over the whole of both runs."""
        return not self.beyond and not self.shorter

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
        cells = [(d.name, amount(d.largest, d.unit), f"{d.at:.6g} s", shared(d)) for d in ranked[:SHOWN]]
        return cells, f"… and {len(ranked) - SHOWN} more" if len(ranked) > SHOWN else ""

    def as_json(self) -> dict[str, Any]:
        """What a script asks, in plain data; what is not finite is null."""
        found = [
            {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in asdict(d).items()}
            for d in self.differences
        ]
        return {
            "a": str(self.a.path), "b": str(self.b.path), "tolerance": self.tolerance, "absolute": self.absolute,
            "within": self.same if self.judged else None, "shorter": self.shorter or None, "signals": found,
            "only_a": list(self.only_a), "only_b": list(self.only_b), "same_times": self.aligned,
            "criteria": [{"what": w, "a": a, "b": b} for w, a, b in criteria_of(self)],
        }  # fmt: skip


def compared(a: Ran, b: Ran, tolerance: float | None = None, absolute: float = 0.0) -> Compared:
    """Hold b against a, at the times of a; InputError where they share no signal or no time.

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
    differences, values = [], {}
    for name in shared:
        if name in a.results.exact or name in b.results.exact:
            differences.append(_of_text(a, b, name, aligned))
            continue
        first = a.results[name][rows]
        second = b.results[name][: time.size] if aligned else _at(time, b.results.time, b.results[name])
        values[name] = first, second
        differences.append(_of_numbers(a, b, name, time, first, second, tolerance, absolute))
    known = set(shared)
    return Compared(
        a, b, tuple(differences),
        tuple(n for n in a.results.columns if n not in known), tuple(n for n in b.results.columns if n not in known),
        time, values, aligned, _shorter(a, b), tolerance, absolute,
    )  # fmt: skip


def _rows(a: Ran, b: Ran) -> tuple[slice, bool]:
    """Rows of a at whose times b has values, and whether they are the rows of b."""
    first, second = a.results.time, b.results.time
    count = min(first.size, second.size)
    if not count:
        return slice(0, 0), False
    step = float(np.min(np.diff(first))) if first.size > 1 else 1.0
    if np.all(np.abs(first[:count] - second[:count]) <= SAME_TIME * max(step, abs(first[count - 1]) * 1e-6)):
        return slice(0, count), True
    low, high = np.searchsorted(first, [second[0] - SAME_TIME * step, second[-1] + SAME_TIME * step])
    return slice(int(low), int(high)), False


def _at(time: Array, times: Array, values: Array) -> Array:
    """Values at other times, straight between rows."""
    return np.interp(time, times, values)


def _of_numbers(
    a: Ran, b: Ran, name: str, time: Array, first: Array, second: Array, tolerance: float | None, absolute: float
) -> Difference:
    unit, other = a.results.units.get(name, ""), b.results.units.get(name, "")
    same = (first == second) | (np.isnan(first) & np.isnan(second))
    finite = np.isfinite(first) & np.isfinite(second)
    gap = np.where(same, 0.0, np.inf)
    gap[finite] = np.abs(second[finite] - first[finite])
    row = int(np.argmax(gap))
    good = first[np.isfinite(first)]
    span = float(np.ptp(good)) if good.size else 0.0
    scale = span or (float(np.max(np.abs(good))) if good.size else 0.0) or 1.0
    largest = float(gap[row])
    differ = f"[{unit}] in one, [{other}] in the other" if unit and other and unit != other else ""
    beyond = tolerance is not None and (bool(differ) or not largest <= absolute + tolerance * scale)
    rms = float(np.sqrt(np.mean(gap**2))) if math.isfinite(largest) else math.inf
    return Difference(name, unit or other, largest, float(time[row]), rms, scale, largest / scale, beyond, differ)


def _of_text(a: Ran, b: Ran, name: str, aligned: bool) -> Difference:
    """Text: 1 where a row differs, 0 where none does."""
    sides = [r.results.exact.get(name) or [str(v) for v in r.results[name]] for r in (a, b)]
    pairs = list(zip(*sides, strict=False))
    first = next((k for k, (x, y) in enumerate(pairs) if x != y), None) if aligned else 0
    time = a.results.time
    if first is None:
        return Difference(name, "", 0.0, float(time[0]), 0.0, 1.0, 0.0, False, "text")
    note = "text differs" if aligned else "text, at other times"
    return Difference(name, "", 1.0, float(time[first]), 1.0, 1.0, 1.0, aligned, note)


def _shorter(a: Ran, b: Ran) -> str:
    ends = [float(r.results.time[-1]) for r in (a, b)]
    step = float(np.max(np.diff(a.results.time))) if a.results.time.size > 1 else 0.0
    if abs(ends[0] - ends[1]) <= 1e-6 * step + 1e-9:
        return ""
    first, second = (a, b) if ends[0] < ends[1] else (b, a)
    return f"{first.path} ends at {min(ends):.6g} s, {second.path} at {max(ends):.6g} s"


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
    most = max(c.differences, key=lambda d: d.share)
    if not any(d.largest for d in c.differences):
        told = (
            f"All {counted(count, 'signal')} are equal in every row."
            if count > 1
            else "The signal is equal in every row."
        )
    elif c.judged and not c.beyond:
        told = f"All {counted(count, 'signal')} are within the tolerance; {_most(most)}."
    elif c.judged:
        verb = "is" if len(c.beyond) == 1 else "are"
        told = f"{len(c.beyond)} of {counted(count, 'signal')} {verb} beyond the tolerance; {_most(c.beyond[0])}."
    else:
        told = f"{sum(d.largest > 0 for d in c.differences)} of {counted(count, 'signal')} differ; {_most(most)}."
    return told + (f" {c.shorter}." if c.shorter else "")


def _most(d: Difference) -> str:
    return f"most {d.name}, by {amount(d.largest, d.unit)} at {d.at:.6g} s ({shared(d)} of its range)"


def shared(d: Difference) -> str:
    """A difference as a share of the range of its signal."""
    return f"{plain(100 * d.share, 2)} %" if math.isfinite(d.share) else "no number in one run"
