"""Differences of several runs from a baseline run, with the inputs that differ between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.comparison.differences import Compared, Comparison, compare_runs, criteria_of, describe_largest
from cosim.comparison.signals import Difference, format_share, format_size
from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.text import counted
from cosim.files.folders import replay_record
from cosim.files.results import Results, is_rounded
from cosim.files.run_inputs import DifferingInput, differing_inputs, labels_of
from cosim.simulation.run_files import RecordedRun

if TYPE_CHECKING:
    import pandas

MAX_RUNS, MAX_SIGNALS = 12, 12  # drawn
MOST_IN_MEMORY = 4  # runs; beyond, drawn runs are read twice
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
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        others = self.others
        sizes = {n: [d.largest if (d := cells[k]) else math.nan for k in others] for n, cells in self.table.items()}
        return pandas.DataFrame.from_dict(sizes, orient="index", columns=[self.labels[k] for k in others])

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
            "runs": [
                {
                    "label": run.name,
                    "path": str(run.path),
                    **(dict.fromkeys(("within", "reasons", "shorter")) if k == self.baseline else by_run[k].verdict()),
                    "only_a": [] if k == self.baseline else list(by_run[k].only_a),
                    "only_b": [] if k == self.baseline else list(by_run[k].only_b),
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
