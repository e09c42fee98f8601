"""Differences of several runs from a baseline run, with the inputs that differ between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import Fault, InputError, refuse
from cosim.base.text import counted
from cosim.comparison.differences import (
    Compared,
    compare_runs,
    criterion_title,
    describe_largest,
    is_held,
    unit_conversion,
)
from cosim.comparison.signals import Difference, format_share, format_size, time_tolerance
from cosim.history.inputs import DifferingInput, differing_inputs, labels_of
from cosim.simulation.run_files import RecordedRun
from cosim.storage.folders import replay_record
from cosim.storage.results import Results

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from cosim.report.panels import Panel

MAX_RUNS, MAX_SIGNALS = 12, 12  # drawn
MAX_PLOTTED, MAX_LISTED = 4, 12  # signals in a figure by default, and in a short text
MOST_CELLS = 50_000_000  # values of runs that stay in memory; beyond, drawn runs are read twice
NOTHING = Results(np.zeros(0), (), np.zeros((0, 0)))


@dataclass(frozen=True)
class RunSource:
    """A run to compare.

    Attributes:
        short: Short name.
        longer: Name that says more, for a run without an input that differs.
        read: Function that reads the run.
        is_optional: Whether the run is left out if it cannot be read or compared, because a pattern matched it.
    """

    short: str
    path: Path
    read: Callable[[], RecordedRun]
    is_optional: bool = False
    longer: str = ""


@dataclass(frozen=True, repr=False)
class ComparedRuns:
    """Differences of several runs from a baseline.

    Attributes:
        runs: Runs without their rows, in the given order; `name` is a label that differs from all others.
        shorts: Short names of the runs.
        baseline: Index of the baseline.
        comparisons: Comparison of each other run with the baseline, without values.
        inputs: Inputs that differ between the runs.
        drawn: Indices of the drawn runs: the baseline and those that differ most.
        time: Times of the baseline [s].
        curves: Signal → values of each drawn run at these times, in the unit of the baseline; NaN without a value.
        units: Signal → unit.
        left_out: Reasons why results that a pattern matched are not compared.
    """

    runs: tuple[RecordedRun, ...]
    shorts: tuple[str, ...]
    baseline: int
    comparisons: tuple[Compared, ...]
    inputs: tuple[DifferingInput, ...]
    drawn: tuple[int, ...]
    time: Array
    curves: dict[str, list[Array]]
    units: dict[str, str]
    left_out: tuple[str, ...] = ()

    @property
    def labels(self) -> list[str]:
        """Return a label for each run: `run 3 (mass = 440)`."""
        return [run.name for run in self.runs]

    @property
    def others(self) -> list[int]:
        """Return the indices of the runs that are compared with the baseline."""
        return [k for k in range(len(self.runs)) if k != self.baseline]

    @property
    def judged(self) -> bool:
        """Return whether a tolerance was given, so that the comparison has a verdict."""
        return self.comparisons[0].judged

    @property
    def same(self) -> bool:
        """Return whether all runs match the baseline; see `Compared.same`."""
        return all(c.same for c in self.comparisons)

    @property
    def reasons(self) -> list[str]:
        """Return the reasons why runs do not match the baseline, as phrases."""
        return [f"{c.b.name}: {reason}" for c in self.comparisons for reason in c.reasons]

    @property
    def ranking(self) -> list[str]:
        """Return the signals of the baseline that another run has, largest share first."""
        shares: dict[str, float] = {}
        for comparison in self.comparisons:
            for d in comparison.differences:
                shares[d.name] = max(shares.get(d.name, 0.0), d.share)
        return sorted(shares, key=lambda name: -shares[name])

    @property
    def table(self) -> dict[str, list[Difference | None]]:
        """Return signal → difference of each run, None for the baseline and for runs without the signal."""
        by_run: list[dict[str, Difference]] = [{} for _ in self.runs]
        for k, comparison in zip(self.others, self.comparisons, strict=True):
            by_run[k] = {d.name: d for d in comparison.differences}
        return {name: [differences.get(name) for differences in by_run] for name in self.ranking}

    @property
    def differing(self) -> dict[str, list[Difference | None]]:
        """Return the rows of the table with a difference."""
        return {name: cells for name, cells in self.table.items() if any(d and d.largest for d in cells)}

    @property
    def equal(self) -> list[str]:
        """Return the signals that are equal in all runs that have them."""
        differing = self.differing
        return [name for name in self.table if name not in differing]

    @property
    def criteria(self) -> dict[str, list[dict[str, Any] | None]]:
        """Return title → outcome in each run, None for runs without the criterion."""
        by_title: dict[str, list[dict[str, Any] | None]] = {}
        for k, run in enumerate(self.runs):
            for entry in run.criteria:
                by_title.setdefault(criterion_title(entry), [None] * len(self.runs))[k] = entry
        return by_title

    def __repr__(self) -> str:
        rows = [(n, *map(_cell, cells)) for n, cells in list(self.table.items())[:MAX_LISTED]]
        more = [f"… and {len(self.ranking) - MAX_LISTED} more"] if len(self.ranking) > MAX_LISTED else []
        return "\n  ".join([sentence(self), *("  ".join(row) for row in rows), *more])

    def _repr_html_(self) -> str:
        from cosim.report.cell.cell import cell_of, heading, rows_to_show, table

        listed = [(name, *map(_cell, cells)) for name, cells in list(self.table.items())[:MAX_LISTED]]
        differences = table(("signal", *self.labels), listed, len(self.ranking) - len(listed))
        drawn = self._most_different()
        rows = rows_to_show([values for name in drawn for values in self.curves[name]])
        panels = self._panels(drawn, rows)
        omitted = len(self.ranking) - len(drawn)
        chart = cell_of(self.time[rows], panels, sentence(self), rows=len(self.time), omitted=omitted)
        return heading(sentence(self)) + differences + chart

    def to_pandas(self) -> pandas.DataFrame:
        """Return the largest difference of each signal (rows) in each run (columns); raise ImportError without pandas.

        Differences are in the unit of the baseline.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        others = self.others
        sizes = {n: [d.largest if (d := cells[k]) else math.nan for k in others] for n, cells in self.table.items()}
        return pandas.DataFrame.from_dict(sizes, orient="index", columns=[self.labels[k] for k in others])

    def plot(self, *names: str) -> Figure:
        """Return a matplotlib figure of the drawn runs, by default with the most different signals.

        Raises:
            KeyError: A signal is not drawn.
        """
        from cosim.simulation.report.figures import sheet
        from cosim.storage.yaml_file import did_you_mean

        for name in names:
            if name not in self.curves:
                raise KeyError(f'no curves of "{name}"{did_you_mean(name, self.curves)}')
        return sheet(self.time, self._panels(names or self._most_different(), slice(None)))

    def _most_different(self) -> list[str]:
        """Return the signals that a figure has by default: those that differ most, of equal runs some."""
        equal = {*self.equal}
        return ([name for name in self.curves if name not in equal] or [*self.curves])[:MAX_PLOTTED]

    def _panels(self, names: Sequence[str], rows: Rows | slice) -> list[Panel]:
        """Return the panels of signals; one that is equal in all runs has a single curve."""
        from cosim.comparison.signal_panels import equal_panel, overlay

        labels, base = [self.labels[k] for k in self.drawn], self.drawn.index(self.baseline)
        curves = {name: [values[rows] for values in self.curves[name]] for name in names}
        equal = {*self.equal}
        return [
            equal_panel(name, self.units[name], values[base])
            if name in equal
            else overlay(name, self.units[name], labels, values, base)
            for name, values in curves.items()
        ]

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain data; non-finite becomes None."""
        first = self.comparisons[0]
        by_run = dict(zip(self.others, self.comparisons, strict=True))
        return {
            "a": str(self.runs[self.baseline].path),
            "b": [str(self.runs[k].path) for k in self.others],
            "baseline": self.labels[self.baseline],
            "tolerance": first.tolerance,
            "absolute": first.absolute,
            "within": self.same if self.judged else None,
            "runs": [_run_as_json(run, by_run.get(k)) for k, run in enumerate(self.runs)],
            "inputs": [{"kind": i.kind, "name": i.name, "values": list(i.values)} for i in self.inputs],
            "criteria": [{"what": title, "outcomes": outcomes} for title, outcomes in self.criteria.items()],
            "signals": [
                {"name": name, "differences": [None if d is None else _plain(d) for d in cells]}
                for name, cells in self.table.items()
            ],
            "drawn": {"runs": [self.labels[k] for k in self.drawn], "signals": [*self.curves]},
        }


def compare_several(
    sources: Sequence[RunSource], baseline: int = 0, tolerance: float | None = None, absolute: float = 0.0
) -> ComparedRuns:
    """Compare runs with a baseline.

    Args:
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.

    Raises:
        InputError: Every run that cannot be read, or that shares no signal or time with the baseline.
    """
    reader = _Reader(sources)
    base = reader[baseline]
    others = {k: source for k, source in enumerate(sources) if k != baseline}
    comparisons, left_out = _compare_each(base, others, reader, tolerance, absolute)
    bare = {baseline: replace(base, results=NOTHING), **{k: c.b for k, c in comparisons.items()}}
    kept = sorted(bare)
    shorts, labels, inputs = _names_of([sources[k] for k in kept], [bare[k] for k in kept], kept.index(baseline))
    runs = {k: replace(bare[k], name=label) for k, label in zip(kept, labels, strict=True)}
    named = tuple(replace(c, a=runs[baseline], b=runs[k]) for k, c in sorted(comparisons.items()))
    ranked = sorted(comparisons, key=lambda k: -max(d.share for d in comparisons[k].differences))
    drawn = sorted([baseline, *ranked[: MAX_RUNS - 1]])
    places = tuple(map(kept.index, drawn))
    about = tuple(map(runs.__getitem__, kept)), shorts, kept.index(baseline), named, inputs, places
    compared = ComparedRuns(*about, base.results.time, {}, {}, left_out)
    return _with_curves(compared, base, (reader[k] for k in drawn))


def _with_curves(compared: ComparedRuns, baseline: RecordedRun, drawn: Iterable[RecordedRun]) -> ComparedRuns:
    """Add the values of the signals that differ most in the drawn runs, at the times of the baseline."""
    base = baseline.results.with_integers()
    baseline = replace(baseline, results=base)
    names = [name for name in compared.ranking if name in base][:MAX_SIGNALS]
    units = {name: base.units.get(name, "") for name in names}
    runs = (replace(run, results=run.results.with_integers()) for run in drawn)
    by_run = [[_at_times(run, baseline, name) for name in names] for run in runs]
    curves = {name: [values[place] for values in by_run] for place, name in enumerate(names)}
    return replace(compared, curves=curves, units=units)


def _names_of(
    sources: Sequence[RunSource], runs: Sequence[RecordedRun], baseline: int
) -> tuple[tuple[str, ...], Sequence[str], tuple[DifferingInput, ...]]:
    """Return short names and labels of runs, and the inputs that differ."""
    shorts = _different([source.short for source in sources])
    longer = [
        short if short != source.short else source.longer or short
        for source, short in zip(sources, shorts, strict=True)
    ]
    labels, inputs = label_runs(runs, shorts, longer, baseline)
    return tuple(shorts), labels, tuple(inputs)


def _compare_each(
    base: RecordedRun, others: Mapping[int, RunSource], reader: _Reader, tolerance: float | None, absolute: float
) -> tuple[dict[int, Compared], tuple[str, ...]]:
    """Compare runs with the baseline; return comparisons by index without rows, and reasons of what is left out.

    Raises:
        InputError: Every run that cannot be read or compared, unless it is optional.
    """
    comparisons: dict[int, Compared] = {}
    faults: list[Fault] = []
    left_out: list[Fault] = []
    for k, source in others.items():
        try:
            found = compare_runs(base, reader[k], tolerance, absolute)
        except InputError as error:
            (left_out if source.is_optional else faults).extend(error.faults)
            continue
        comparisons[k] = replace(found, b=replace(found.b, results=NOTHING), values={}, time=NOTHING.time)
    refuse(faults or ([] if comparisons else left_out))
    return comparisons, tuple(map(str, left_out))


def label_runs(
    runs: Sequence[RecordedRun], shorts: Sequence[str], longer: Sequence[str], baseline: int | None = None
) -> tuple[list[str], list[DifferingInput]]:
    """Return a label for each run, with the inputs that differ between the runs: `run 3 (mass = 440)`."""
    inputs = differing_inputs([run.manifest or replay_record(run.path) for run in runs])
    return labels_of(shorts, inputs, unique=[str(run.path) for run in runs], longer=longer, baseline=baseline), inputs


class _Reader:
    """Runs, read when they are needed; they stay in memory as far as there is room."""

    def __init__(self, sources: Sequence[RunSource]) -> None:
        self._sources = sources
        self._kept: dict[int, RecordedRun] = {}
        self._cells = 0

    def __getitem__(self, k: int) -> RecordedRun:
        if k in self._kept:
            return self._kept[k]
        run = self._sources[k].read()
        self._cells += run.results.values.size
        if self._cells <= MOST_CELLS:
            self._kept[k] = run
        return run


def _at_times(run: RecordedRun, base: RecordedRun, name: str) -> Array:
    """Return a signal of a run at the times of the baseline, in its unit there; NaN where the run has no value."""
    time = base.results.time
    results = run.results
    by = unit_conversion(run, base, name) if name in results else None
    if by is None or not results.time.size:
        return np.full(time.size, np.nan)
    values = results[name]
    if not np.array_equal(results.time, time):
        at = np.interp(time, results.time, values, left=math.nan, right=math.nan)
        if is_held(base, run, name):
            close = time_tolerance(time)
            rows = np.maximum(np.searchsorted(results.time, time + close, side="right") - 1, 0)
            at = np.where(np.isnan(at), np.nan, values[rows])
        values = at
    return np.asarray(by.factor * values + by.offset)


def _different(names: Sequence[str]) -> list[str]:
    """Return short names that differ: `run 3`, or `tank` and `tank #2`."""
    return [
        name if names.count(name) == 1 or name not in names[:k] else f"{name} #{names[: k + 1].count(name)}"
        for k, name in enumerate(names)
    ]


def _cell(d: Difference | None) -> str:
    return "–" if d is None else f"{format_size(d, d.largest)} ({format_share(d)})" if d.largest else "equal"


def _plain(d: Difference) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in asdict(d).items()
        if key != "name"
    }


def _run_as_json(run: RecordedRun, comparison: Compared | None) -> dict[str, Any]:
    """Return a run and its verdict; the baseline has no comparison."""
    about = {"label": run.name, "path": str(run.path)}
    if comparison is None:
        return {**about, "within": None, "reasons": None, "shorter": None, "only_a": [], "only_b": []}
    return {
        **about,
        "within": comparison.same if comparison.judged else None,
        "reasons": comparison.reasons if comparison.judged else None,
        "shorter": comparison.shorter or None,
        "only_a": list(comparison.only_a),
        "only_b": list(comparison.only_b),
    }


def sentence(c: ComparedRuns) -> str:
    """Return a summary of the comparison in a sentence."""
    base, count = c.labels[c.baseline], len(c.comparisons)
    largest = [(max(x.differences, key=lambda d: d.share), x) for x in c.comparisons]
    worst, where = max(largest, key=lambda pair: pair[0].share)
    most = f"{describe_largest(worst)}, in {where.b.name}"
    if not worst.largest:
        return f"{'All' if count > 1 else 'The'} {counted(count, 'other run')} equal {base} in every common signal."
    if not c.judged:
        differ = sum(d.largest > 0 for d, _ in largest)
        return f"{differ} of {counted(count, 'run')} {'differs' if differ == 1 else 'differ'} from {base}; {most}."
    within = sum(x.same for x in c.comparisons)
    return (
        f"{within} of {counted(count, 'run')} {'is' if within == 1 else 'are'} within the tolerance of {base}; {most}."
    )
