"""Comparison of several runs with a baseline run, with the inputs that differ, and its files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.comparison.differences import (
    Compared,
    Comparison,
    Difference,
    compare_runs,
    criteria_of,
    describe_largest,
    format_share,
    format_size,
    is_one_run,
)
from cosim.core.arrays import Array, far_beyond
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.extras import pandas_for_frames
from cosim.core.text import counted, showing
from cosim.files.files import FilePath, check_writable, write_json, write_text
from cosim.files.folders import new_run, remove_earlier, replay_record
from cosim.files.results import Results, is_rounded, rows_in
from cosim.files.run_entries import Selected, select_groups
from cosim.files.run_inputs import DifferingInput, differing_inputs, labels_of
from cosim.simulation.run_signals import RecordedRun, Run, Signals, read_ran

if TYPE_CHECKING:
    import pandas


MAX_RUNS, MAX_SIGNALS = 12, 12  # drawn
MOST_IN_MEMORY = 4  # runs; beyond, drawn runs are read twice
NOTHING = Results(np.zeros(0), (), np.zeros((0, 0)))
FILES = ("comparison.json", "report.html")
LONGEST_NAME, NUMBERED = 80, "run "  # characters of the name of a folder; the beginning of the name of a numbered run


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
class ComparedRuns(Comparison):
    """Differences of several runs from a baseline.

    Attributes:
        runs: Runs without their rows, in the given order; `name` is a label that differs from all others.
        shorts: Short names of the runs.
        baseline: Index of the baseline.
        comparisons: Comparison of each other run with the baseline, without values.
        inputs: Inputs that differ between the runs.
        drawn: Indices of the drawn runs: the baseline and those that differ most.
        time: Times of the baseline [s].
        values: Signal → values of each drawn run at these times, in the unit of the baseline; NaN without a value.
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
        """Return the indices of the runs that are compared with the baseline."""
        return [k for k in range(len(self.runs)) if k != self.baseline]

    @property
    def by_run(self) -> dict[int, Compared]:
        """Return the comparison of each run but the baseline, by its index."""
        return dict(zip(self.others, self.comparisons, strict=True))

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
        by_run = {k: {d.name: d for d in c.differences} for k, c in self.by_run.items()}
        return {name: [by_run.get(k, {}).get(name) for k in range(len(self.runs))] for name in self.ranking}

    @property
    def differing(self) -> dict[str, list[Difference | None]]:
        """Return the rows of the table with a difference."""
        return {name: cells for name, cells in self.table.items() if any(d and d.largest for d in cells)}

    @property
    def equal(self) -> list[str]:
        """Return the signals without a difference between runs; a run may lack the signal."""
        differing = self.differing
        return [name for name in self.table if name not in differing]

    @property
    def drawable(self) -> list[str]:
        """Return the signals with curves, equal ones last."""
        equal = {*self.equal}
        return sorted(self.values, key=lambda name: name in equal)

    @property
    def summary(self) -> str:
        """Return the outcome in a sentence."""
        base, count = self.labels[self.baseline], len(self.comparisons)
        largest = [(max(x.differences, key=lambda d: d.share), x) for x in self.comparisons]
        worst, where = max(largest, key=lambda pair: pair[0].share)
        most = f"{describe_largest(worst)}, in {where.b.name}"
        if not worst.largest:
            return f"{'All' if count > 1 else 'The'} {counted(count, 'other run')} equal {base} in every common signal."
        if not self.judged:
            differ = sum(d.largest > 0 for d, _ in largest)
            return f"{differ} of {counted(count, 'run')} {'differs' if differ == 1 else 'differ'} from {base}; {most}."
        within = sum(x.same for x in self.comparisons)
        verb = "is" if within == 1 else "are"
        return f"{within} of {counted(count, 'run')} {verb} within the tolerance of {base}; {most}."

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """Return the headings of a table, and a row for each signal, largest share first."""

        def text(d: Difference | None) -> str:
            if d is None:
                return "–"
            return f"{format_size(d, d.largest)} ({format_share(d)})" if d.largest else "equal"

        return [("signal", *self.labels), *((name, *map(text, cells)) for name, cells in self.table.items())]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the largest difference of each signal (rows) in each run (columns); raise ImportError without pandas.

        Differences are in the unit of the baseline.
        """
        library = pandas_for_frames()
        others = self.others
        sizes = {n: [d.largest if (d := cells[k]) else math.nan for k in others] for n, cells in self.table.items()}
        labels = [self.labels[k] for k in others]
        frame: pandas.DataFrame = library.DataFrame.from_dict(sizes, orient="index", columns=labels)
        return frame

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain data; non-finite becomes None."""
        first = self.comparisons[0]
        by_run = self.by_run
        return {
            "a": str(self.runs[self.baseline].path),
            "b": [str(self.runs[k].path) for k in self.others],
            "baseline": self.labels[self.baseline],
            "tolerance": first.tolerance,
            "absolute": first.absolute,
            "within": self.same if self.judged else None,
            "runs": [
                {
                    "label": run.name,
                    "path": str(run.path),
                    **(c.verdict() if (c := by_run.get(k)) else dict.fromkeys(("within", "reasons", "shorter"))),
                    "only_a": list(c.only_a if c else ()),
                    "only_b": list(c.only_b if c else ()),
                }
                for k, run in enumerate(self.runs)
            ],
            "inputs": [{"kind": i.kind, "name": i.name, "values": list(i.values)} for i in self.inputs],
            "criteria": [{"what": title, "outcomes": outcomes} for title, outcomes in criteria_of(self.runs).items()],
            "signals": [
                {"name": name, "differences": [None if d is None else d.as_json(named=False) for d in cells]}
                for name, cells in self.table.items()
            ],
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
        InputError: Every run that cannot be read, or that shares no signal or time with the baseline.
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
        comparisons[k] = replace(found, b=replace(found.b, results=NOTHING), values={}, time=NOTHING.time)
    refuse(faults or ([] if comparisons else left_out))
    kept = sorted([baseline, *comparisons])
    bare = [replace(base, results=NOTHING) if k == baseline else comparisons[k].b for k in kept]
    place = kept.index(baseline)
    names = [sources[k].short for k in kept]
    shorts = [  # `run 3`, or `tank` and `tank #2`
        f"{name} #{names[: k + 1].count(name)}" if name in names[:k] else name for k, name in enumerate(names)
    ]
    longer = [s if s != sources[k].short else sources[k].longer or s for k, s in zip(kept, shorts, strict=True)]
    labels, inputs = label_runs(bare, shorts, longer, place)
    runs = {k: replace(run, name=label) for k, run, label in zip(kept, bare, labels, strict=True)}
    named = tuple(replace(c, a=runs[baseline], b=runs[k]) for k, c in sorted(comparisons.items()))
    ranked = sorted(comparisons, key=lambda k: -max(d.share for d in comparisons[k].differences))
    drawn = sorted([baseline, *ranked[: MAX_RUNS - 1]])
    about = tuple(runs.values()), tuple(shorts), place, named, tuple(inputs), tuple(map(kept.index, drawn))
    compared = ComparedRuns(*about, base.results.time, {}, {}, tuple(map(str, left_out)))
    numbers = base.results.with_integers()
    is_number = {n: n in numbers and not (n in numbers.exact and is_rounded(numbers[n])) for n in compared.ranking}
    curves: dict[str, list[Array]] = {n: [] for n in [n for n, is_so in is_number.items() if is_so][:MAX_SIGNALS]}
    for k in drawn:
        found = compare_runs(base, read(k))
        first = int(np.searchsorted(compared.time, found.time[0]))
        for name, of_runs in curves.items():
            values = np.full(compared.time.size, np.nan)
            if name in found.values:
                values[first : first + found.time.size] = found.values[name][1]
            of_runs.append(values)
    return replace(compared, values=curves, units={name: numbers.units.get(name, "") for name in curves})


def label_runs(
    runs: Sequence[RecordedRun], shorts: Sequence[str], longer: Sequence[str], baseline: int | None = None
) -> tuple[list[str], list[DifferingInput]]:
    """Return a label for each run, with the inputs that differ between the runs: `run 3 (mass = 440)`."""
    inputs = differing_inputs([run.manifest or replay_record(run.path) for run in runs])
    return labels_of(shorts, inputs, unique=[str(run.path) for run in runs], longer=longer, baseline=baseline), inputs


def _sources(sides: Sequence[Any], baseline: Any, results: Path | None) -> tuple[list[RunSource], int]:
    """Return the runs to compare, and the index of the baseline.

    Args:
        sides: Paths, numbers, names and patterns of runs, and results of functions. Results that a pattern matches
            although they have no rows, as a sweep, are left out.
        results: Folder of results, by default `results`.

    Raises:
        InputError: Fewer than two runs, or a baseline that is not one run.
    """

    def read(selected: Selected) -> RecordedRun:
        """Return a recorded run; raise InputError if it was removed or replaced since it was listed."""
        run = read_ran(selected.path)
        if selected.entry is not None:
            selected.entry.check_current()
        return run

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
                    found.append(RunSource(s.short, s.path, partial(read, s), s.by_pattern, s.longer))
        return found

    if not sides:
        raise InputError.at(Path("runs"), "no run is given; name at least two runs to compare")
    sources, place = runs_of(sides), 0
    if baseline is not None:
        base = runs_of([baseline])
        if len(base) != 1:
            raise InputError.at(Path(str(baseline)), f"{len(base)} runs match; name one as the baseline")
        paths, path = [source.path.resolve() for source in sources], base[0].path.resolve()
        if path not in paths:
            sources.insert(0, base[0])
        else:
            place = paths.index(path)
            sources[place] = base[0]
    if len(sources) < 2:
        path = sources[0].path if sources else Path(str(sides[0]))
        raise InputError.at(path, "is one run; name at least two runs to compare")
    return sources, place


def displays(comparison: Compared | ComparedRuns) -> list[Mapping[str, Any]]:
    """Return the records of the runs, which have their display units."""
    runs = (comparison.a, comparison.b) if isinstance(comparison, Compared) else comparison.runs
    return [run.manifest or replay_record(run.path) for run in runs]


@far_beyond
def compare(
    sides: Sequence[Any],
    folder: FilePath | None = None,
    *,
    baseline: Any = None,
    results: Path | None = None,
    as_pair: bool | None = None,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: bool = True,
    write: bool = True,
    force: bool = False,
) -> tuple[Compared | ComparedRuns, Path]:
    """Compare runs with a baseline; write comparison.json and report.html.

    Args:
        sides: Paths, numbers, names and patterns of runs, and results of functions.
        baseline: One of them, or another run; by default the first run.
        results: Folder of results, by default `results`.
        as_pair: Whether to return a comparison of two runs as `Compared`; by default if there are two.
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.
        report: Whether to write report.html.
        write: Whether to write files.
        force: Whether `folder` may have files.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time.
    """
    sources, place = _sources(sides, baseline, results)
    if as_pair and len(sources) > 2:
        raise InputError.at(Path(str(sides[0])), f"{len(sources)} runs match; give a list to compare them all")
    ordered = [sources[place], *(source for k, source in enumerate(sources) if k != place)]
    shorts, paths = [source.short for source in ordered], [source.path for source in ordered]
    comparison: Compared | ComparedRuns
    if len(sources) == 2 and as_pair is not False:
        runs = [source.read() for source in ordered]
        if is_one_run(*runs):
            runs = [replace(runs[0], name=shorts[0]), replace(runs[1], name="the same run")]
        elif shorts[0] == shorts[1] or shorts != [run.name for run in runs]:
            labels, _ = label_runs(runs, shorts, [source.longer or source.short for source in ordered])
            runs = [replace(run, name=label) for run, label in zip(runs, labels, strict=True)]
        comparison = compare_runs(runs[0], runs[1], tolerance, absolute)
    else:
        comparison = compare_several(sources, place, tolerance, absolute)
    if not write:
        return comparison, Path()
    numbers = [short.removeprefix(NUMBERED) for short in shorts]
    name = f"runs {'-'.join(numbers)}" if all(map(str.isdecimal, numbers)) else " and ".join(shorts)
    if len(name) > LONGEST_NAME:
        name = f"{shorts[0]} and {len(shorts) - 1} others"
    with new_run(folder, name, "cosim compare", force=force) as out:
        check_writable(out, FILES, paths)
        remove_earlier(out, read=paths)
        write_json(out / "comparison.json", comparison.as_json())
        if report:
            from cosim.comparison.page import comparison_page

            with showing(*displays(comparison)):
                write_text(out / "report.html", comparison_page(comparison))
    return comparison, out
