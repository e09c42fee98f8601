"""Comparison of several runs with a baseline: signals, differing inputs, and files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.comparison.differences import (
    MAX_LISTED_SIGNALS,
    Compared,
    Difference,
    compare_runs,
    criteria_of,
    criterion_title,
    describe_largest,
    format_share,
    format_size,
)
from cosim.core.arrays import Array, far_beyond
from cosim.core.errors import Fault, FmuError, InputError, refuse
from cosim.core.extras import pandas_for_frames
from cosim.core.text import MISSING, counted, join_names, showing
from cosim.files.files import FilePath, check_writable, write_json, write_text
from cosim.files.folders import new_run, remove_earlier, replay_record
from cosim.files.results import Results, is_rounded, rows_in
from cosim.files.run_entries import select_groups
from cosim.files.run_inputs import PARAMETER, DifferingInput, differing_inputs, labels_of
from cosim.fmi.description import read_description
from cosim.scenario.scenario_file import sha256
from cosim.simulation.run_signals import RecordedRun, Run, Signals, read_ran

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


MAX_COMPARED_RUNS, MAX_FIGURE_SIGNALS, MAX_FIGURE_CURVES = 12, 24, 144  # largest number of drawn runs
MAX_DRAWN = 4  # signals in a figure by default
MOST_IN_MEMORY = 4  # number of runs above which drawn runs are read twice, to save memory
NO_RESULTS = Results(np.zeros(0), (), np.zeros((0, 0)))
COMPARISON_FILES = ("comparison.json", "report.html")
NO_VERDICT: Mapping[str, Any] = {"within": None, "reasons": None, "shorter": None, "only_a": [], "only_b": []}
MAX_RUN_NAME_CHARACTERS = 80  # of the name of a folder
NUMBERED_RUN = "run "  # beginning of the name of a numbered run


@dataclass(frozen=True)
class RunSource:
    """A run to compare.

    Attributes:
        short: Short name.
        longer: Longer name, for a run without an input that differs.
        read: Function that reads the run.
        is_optional: True for a match of a pattern, which is left out if it cannot be read or compared.
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
        runs: Runs without their rows, in the given order; `name` is a unique label.
        shorts: Short names of the runs.
        baseline: Index of the baseline.
        comparisons: Comparison of each other run with the baseline, without values.
        inputs: Inputs that differ between the runs.
        drawn: Indices of the drawn runs: the baseline and those that differ most.
        time: Times of the baseline [s].
        values: Signal → values of each drawn run at these times, in the unit of the baseline; NaN without a value. The
            signals that differ most come first.
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
    values: dict[str, list[Array]]
    units: dict[str, str]
    left_out: tuple[str, ...] = ()

    @property
    def labels(self) -> list[str]:
        """Return a label for each run: `run 3 (mass = 440)`."""
        return [run.name for run in self.runs]

    @property
    def others(self) -> list[int]:
        """Return the indices of all runs except the baseline."""
        return [k for k in range(len(self.runs)) if k != self.baseline]

    @property
    def by_run(self) -> dict[int, Compared]:
        """Return the comparison of each run, except the baseline, by its index."""
        return dict(zip(self.others, self.comparisons, strict=True))

    @property
    def judged(self) -> bool:
        """Return True if a tolerance was given, so that the comparison has a verdict."""
        return self.comparisons[0].judged

    @property
    def same(self) -> bool:
        """Return True if all runs match the baseline; see `Compared.same`."""
        return all(c.same for c in self.comparisons)

    @property
    def reasons(self) -> list[str]:
        """Return the reasons why runs do not match the baseline, as phrases."""
        return [f"{c.b.name}: {reason}" for c in self.comparisons for reason in c.reasons]

    @cached_property
    def table(self) -> dict[str, list[Difference | None]]:
        """Return signal → difference of each run, None for the baseline and without the signal; largest share first."""
        rows: dict[str, list[Difference | None]] = {}
        for k, comparison in self.by_run.items():
            for d in comparison.differences:
                rows.setdefault(d.name, [None] * len(self.runs))[k] = d
        return dict(sorted(rows.items(), key=lambda row: -max(d.share for d in row[1] if d)))

    @property
    def differing(self) -> dict[str, list[Difference | None]]:
        """Return the rows of the table with a difference."""
        return {name: cells for name, cells in self.table.items() if any(d and d.largest for d in cells)}

    @property
    def differences(self) -> list[Difference]:
        """Return the differences of all signals in all runs, largest share first."""
        return sorted((d for c in self.comparisons for d in c.differences), key=lambda d: -d.share)

    @property
    def beyond(self) -> list[Difference]:
        """Return the differences beyond the tolerance, largest share first."""
        return [d for d in self.differences if d.beyond]

    @property
    def summary(self) -> str:
        """Return the outcome in two sentences: criteria and differences."""
        return " ".join(filter(None, self.sentences))

    @property
    def sentences(self) -> tuple[str, str]:
        """Return a sentence on the criteria of the runs, "" without any, and one on their differences."""
        entries = [
            [e for outcomes in criteria_of(self.runs).values() if (e := outcomes[k])] for k in range(len(self.runs))
        ]
        goals, asked = "", [k for k, own in enumerate(entries) if own]
        if asked:
            met = [self.shorts[k] for k in asked if all(e.get("met") for e in entries[k])]
            share = f"{len(met)} of {counted(len(asked), 'run')}" if met else "No run"
            goals = f"{share} meet{'' if len(met) > 1 else 's'} all criteria"
            goals += f": {join_names(met)}" if 0 < len(met) < len(asked) else ""
            shares = {k: max(map(_share_of_limit, entries[k])) for k in asked}
            best, *others = sorted(asked, key=shares.__getitem__)
            if len(met) != 1 and others and shares[best] < shares[others[0]]:
                tightest = criterion_title(max(entries[best], key=_share_of_limit))
                goals += f"; {self.shorts[best]} is best: {tightest} is {100 * shares[best]:.0f}\u00a0% of its limit"
            goals += "."
        base, differing = self.shorts[self.baseline], self.differing
        text = f"{counted(len(self.table), 'signal')} equal {base}."
        if differing:
            worst = max((d for c in self.comparisons for d in c.differences), key=lambda d: d.share)
            where = next(c for c in self.comparisons if worst in c.differences)
            verb = "differ by more than the tolerance from" if self.judged else "differ from"
            count = (
                sum(any(d and d.beyond for d in row) for row in differing.values()) if self.judged else len(differing)
            )
            text = f"{count} of {counted(len(self.table), 'signal')} {verb} {base}; "
            text += f"largest: {describe_largest(worst)}" + (f", in {where.b.name}." if len(self.runs) > 2 else ".")
        for k, c in self.by_run.items():
            text += f" {self.shorts[k]} lacks {counted(len(c.only_a), 'signal')} of {base}." if c.only_a else ""
            text += f" {c.shorter}." if c.shorter else ""
        return goals, text

    def __repr__(self) -> str:
        rows = self.cells[1:]
        more = [f"… and {len(rows) - MAX_LISTED_SIGNALS} more"] if len(rows) > MAX_LISTED_SIGNALS else []
        return "\n  ".join([self.summary, *("  ".join(row) for row in rows[:MAX_LISTED_SIGNALS]), *more])

    def _repr_html_(self) -> str:
        from cosim.comparison.page import panels_of
        from cosim.core.notebook import heading, table
        from cosim.report.cell.cell import cell_of, rows_to_show

        heads, *cells = self.cells
        drawn = dict(islice(self.values.items(), MAX_DRAWN))
        rows = rows_to_show([values for curves in drawn.values() for values in curves])
        panels = [p for name, curves in drawn.items() for p in panels_of(self, name, [v[rows] for v in curves])]
        omitted = len(cells) - len(drawn)
        chart = cell_of(self.time[rows], panels, self.summary, rows=len(self.time), omitted=omitted)
        return heading(self.summary) + table(heads, cells[:MAX_LISTED_SIGNALS], len(cells) - MAX_LISTED_SIGNALS) + chart

    def plot(self, *names: str) -> Figure:
        """Return a matplotlib figure of signals in all runs, by default the signals that differ most.

        Raises:
            KeyError: A signal has no curves.
        """
        from cosim.comparison.page import panels_of
        from cosim.core.text import did_you_mean
        from cosim.simulation.report.figures import sheet

        for name in names:
            if name not in self.values:
                raise KeyError(f'no curves for "{name}"{did_you_mean(name, self.values)}')
        shown = names or [*self.values][:MAX_DRAWN]
        return sheet(self.time, [panel for name in shown for panel in panels_of(self, name, self.values[name])])

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """Return the headings of a table, and a row for each signal, largest difference first."""

        def text(d: Difference | None) -> str:
            if d is None:
                return MISSING
            return f"{format_size(d, d.largest)} ({format_share(d)})" if d.largest else "equal"

        rows = ((name, *(text(cells[k]) for k in self.others)) for name, cells in self.table.items())
        return [("signal", *(self.labels[k] for k in self.others)), *rows]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the largest difference of each signal (rows) in each run (columns); raise ImportError without pandas.

        Differences are in the unit of the baseline.
        """
        library, others = pandas_for_frames(), self.others
        sizes = {n: [d.largest if (d := cells[k]) else math.nan for k in others] for n, cells in self.table.items()}
        labels = [self.labels[k] for k in others]
        frame: pandas.DataFrame = library.DataFrame.from_dict(sizes, orient="index", columns=labels)
        return frame

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain data; non-finite becomes None."""
        first, by_run = self.comparisons[0], self.by_run
        verdicts = [c.verdict() if (c := by_run.get(k)) else NO_VERDICT for k in range(len(self.runs))]
        signals = [(name, [None if d is None else d.as_json() for d in cells]) for name, cells in self.table.items()]
        return {
            "a": str(self.runs[self.baseline].path),
            "b": [str(self.runs[k].path) for k in self.others],
            "baseline": self.labels[self.baseline],
            "tolerance": first.tolerance,
            "absolute": first.absolute,
            "within": self.same if self.judged else None,
            "runs": [
                {"label": run.name, "path": str(run.path), **verdict}
                for run, verdict in zip(self.runs, verdicts, strict=True)
            ],
            "inputs": [{"kind": i.kind, "name": i.name, "values": list(i.values)} for i in self.inputs],
            "criteria": [{"what": title, "outcomes": outcomes} for title, outcomes in criteria_of(self.runs).items()],
            "signals": [{"name": name, "differences": cells} for name, cells in signals],
            "drawn": {"runs": [self.labels[k] for k in self.drawn], "signals": [*self.values]},
        }


def compare_several(
    sources: Sequence[RunSource], baseline: int = 0, tolerance: float | None = None, absolute: float = 0.0
) -> ComparedRuns:
    """Compare runs with a baseline.

    Args:
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time with the baseline; the error names all of
            them.
    """
    read = lru_cache(MOST_IN_MEMORY)(lambda k: sources[k].read())
    base = read(baseline)
    comparisons: dict[int, Compared] = {}
    faults: list[Fault] = []
    left_out: list[Fault] = []
    for k, source in enumerate(sources):
        if k == baseline:
            continue
        try:
            found = compare_runs(base, read(k), tolerance, absolute)
        except InputError as error:
            (left_out if source.is_optional else faults).extend(error.faults)
            continue
        comparisons[k] = replace(found, b=replace(found.b, results=NO_RESULTS), values={}, time=NO_RESULTS.time)
    refuse(faults or ([] if comparisons else left_out))
    kept = sorted([baseline, *comparisons])
    bare = [replace(base, results=NO_RESULTS) if k == baseline else comparisons[k].b for k in kept]
    place, names = kept.index(baseline), [sources[k].short for k in kept]
    shorts = [  # shorten to `run 3`, or `tank` and `tank #2`
        f"{name} #{names[: k + 1].count(name)}" if name in names[:k] else name for k, name in enumerate(names)
    ]
    longer = [s if s != sources[k].short else sources[k].longer or s for k, s in zip(kept, shorts, strict=True)]
    records = [run.manifest or replay_record(run.path) for run in bare]
    inputs = differing_inputs(records)
    labels = labels_of(shorts, inputs, unique=[str(run.path) for run in bare], longer=longer, baseline=place)
    inputs = [_with_declared_starts(row, records) for row in inputs]
    runs = {k: replace(run, name=label) for k, run, label in zip(kept, bare, labels, strict=True)}
    named = tuple(replace(c, a=runs[baseline], b=runs[k]) for k, c in sorted(comparisons.items()))
    ranked = sorted(comparisons, key=lambda k: -max(d.share for d in comparisons[k].differences))
    drawn = sorted([baseline, *ranked[: MAX_COMPARED_RUNS - 1]])
    about = tuple(runs.values()), tuple(shorts), place, named, tuple(inputs), tuple(map(kept.index, drawn))
    compared = ComparedRuns(*about, base.results.time, {}, {}, tuple(map(str, left_out)))
    numbers = base.results.with_integers()
    drawable = [n for n in compared.table if n in numbers and not (n in numbers.exact and is_rounded(numbers[n]))]
    curves = {n: list[Array]() for n in drawable[: min(MAX_FIGURE_SIGNALS, MAX_FIGURE_CURVES // len(drawn))]}
    for k in drawn:
        found = compare_runs(base, read(k))
        first = int(np.searchsorted(compared.time, found.time[0]))
        for name, of_runs in curves.items():
            values = np.full(compared.time.size, np.nan)
            if name in found.values:
                values[first : first + found.time.size] = found.values[name][1]
            of_runs.append(values)
    return replace(compared, values=curves, units={name: numbers.units.get(name, "") for name in curves})


def _with_declared_starts(row: DifferingInput, records: Sequence[Mapping[str, Any]]) -> DifferingInput:
    """Return an input in which unset values are replaced by the FMU's start value as text, such as `0.98 (FMU)`."""
    component, _, variable = row.name.partition(".")
    if row.kind != PARAMETER:
        return row
    values = list(row.values)
    for k, (value, record) in enumerate(zip(values, records, strict=True)):
        fmus = record.get("fmus")
        entry = fmus.get(component) if isinstance(fmus, dict) else None
        if value is None and isinstance(entry, dict):
            start = _declared_start(str(entry.get("path")), str(entry.get("sha256")), variable)
            values[k] = None if start is None else f"{start} (FMU)"
    return replace(row, values=tuple(values))


@lru_cache
def _declared_start(path: str, digest: str, variable: str) -> str | None:
    """Return the start value that an FMU declares; None if the file has changed since the run."""
    with suppress(InputError, FmuError, OSError):
        if sha256(Path(path)) == digest:
            return next((v.start for v in read_description(Path(path)).modelVariables if v.name == variable), None)
    return None


def _sources(sides: Sequence[Any], baseline: Any, results: Path | None) -> tuple[list[RunSource], int]:
    """Return the runs to compare, and the index of the baseline.

    Args:
        sides: Paths, numbers, names and patterns of runs, and results of functions. Matches of a pattern without rows,
            such as sweeps, are left out.
        results: Folder of results, by default `results`.

    Raises:
        InputError: There are fewer than two runs, or the baseline is not exactly one run.
    """

    def runs_of(sides: Sequence[Any]) -> list[RunSource]:
        groups = iter(select_groups([str(side) for side in sides if not isinstance(side, Signals)], results))
        found = []
        for side in sides:
            if isinstance(side, Signals):
                path, manifest = side.folder or Path(side.title), side.manifest if isinstance(side, Run) else {}
                run = RecordedRun(path, side.title, side.results, manifest)
                found.append(RunSource(side.title, path, partial(lambda run: run, run)))
                continue
            for s in next(groups):
                if not s.by_pattern or rows_in(s.path) is not None:
                    found.append(RunSource(s.short, s.path, partial(read_ran, s.path), s.by_pattern, s.longer))
        return found

    sources, place = runs_of(sides), 0
    if baseline is not None:
        base = runs_of([baseline])
        if len(base) != 1:
            raise InputError.at(Path(str(baseline)), f"{len(base)} runs match; give one as the baseline")
        paths, path = [source.path.resolve() for source in sources], base[0].path.resolve()
        if path in paths:
            place = paths.index(path)
            sources[place] = base[0]
        else:
            sources.insert(0, base[0])
    if len(sources) < 2:
        raise InputError.at(Path(str(sides[0] if sides else "runs")), "give at least two runs to compare")
    return sources, place


def displays(comparison: ComparedRuns) -> list[Mapping[str, Any]]:
    """Return the records of the runs, which contain their display units."""
    return [run.manifest or replay_record(run.path) for run in comparison.runs]


def _share_of_limit(outcome: Mapping[str, Any]) -> float:
    """Return the value of a criterion as a share of its limit; infinite if it was never reached."""
    value, limit = outcome.get("value"), outcome.get("max") or 0.0
    if value is None:
        return math.inf
    return float(value) / limit if limit > 0 else 0.0 if value <= limit else math.inf


@far_beyond
def compare(
    sides: Sequence[Any],
    folder: FilePath | None = None,
    *,
    baseline: Any = None,
    results: Path | None = None,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: bool = True,
    write: bool = True,
    force: bool = False,
) -> tuple[ComparedRuns, Path]:
    """Compare runs with a baseline; write comparison.json and report.html.

    Args:
        sides: Paths, numbers, names and patterns of runs, and results of functions.
        baseline: One of them, or another run; by default the first run.
        results: Folder of results, by default `results`.
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.
        report: Write report.html.
        write: Write files.
        force: Write even if the folder is not empty.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time.
    """
    sources, place = _sources(sides, baseline, results)
    ordered = [sources[place], *(source for k, source in enumerate(sources) if k != place)]
    shorts, paths = [source.short for source in ordered], [source.path for source in ordered]
    comparison = compare_several(sources, place, tolerance, absolute)
    if not write:
        return comparison, Path()
    numbers = [short.removeprefix(NUMBERED_RUN) for short in shorts]
    name = f"runs {'-'.join(numbers)}" if all(map(str.isdecimal, numbers)) else " and ".join(shorts)
    if len(name) > MAX_RUN_NAME_CHARACTERS:
        name = f"{shorts[0]} and {len(shorts) - 1} others"
    with new_run(folder, name, "cosim compare", force=force) as out:
        check_writable(out, COMPARISON_FILES, paths)
        remove_earlier(out, read=paths)
        write_json(out / "comparison.json", comparison.as_json())
        if report:
            from cosim.comparison.page import comparison_page

            with showing(*displays(comparison)):
                write_text(out / "report.html", comparison_page(comparison))
    return comparison, out
