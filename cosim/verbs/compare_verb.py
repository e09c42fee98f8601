"""`cosim compare` and `cosim.compare`: compare runs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.errors import CriterionMissed, InputError
from cosim.core.settings import Count, NotNegative
from cosim.core.text import some
from cosim.files.files import FilePath
from cosim.verbs.cli import say, say_json, show, table, warn

if TYPE_CHECKING:
    from cosim.comparison.differences import Compared
    from cosim.comparison.several import ComparedRuns, RunSource
    from cosim.simulation.run_signals import Signals

MAX_SIGNALS = 12  # on the terminal


def compare(
    a: FilePath | Count | Signals | Sequence[FilePath | Count | Signals],
    b: FilePath | Count | Signals | None = None,
    out: FilePath | None = None,
    *,
    baseline: FilePath | Count | Signals | None = None,
    tolerance: NotNegative | None = None,
    absolute: NotNegative = 0.0,
    force: bool = False,
) -> Compared | ComparedRuns:
    """Compare runs signal by signal with a baseline.

    A difference beyond the tolerance is not an error: see `Compared.same`.

    Args:
        a: Baseline: folder of a run, CSV file whose first column is time, number, name or pattern in `cosim list`, or
            result of a function; or a list of runs, however many.
        b: Run that is compared with the baseline `a`.
        out: Folder for comparison.json and report.html; None writes nothing.
        baseline: Baseline of a list of runs; by default its first run.
        tolerance: Allowed difference as a share of each signal's range in the baseline.
        absolute: Allowed difference in each signal's unit, added to `tolerance`.
        force: Write even if the folder is not empty; results in it are replaced.

    Returns:
        The difference of each signal, and the verdict if there is a tolerance: `Compared` of two runs `a` and `b`,
        `ComparedRuns` of a list.

    Raises:
        InputError: No such run, or runs without a common signal or a common time.
    """
    from cosim.comparison.page import comparison_page
    from cosim.comparison.workflow import compare as compare_runs

    is_pair = not isinstance(a, (list, tuple))
    first = [*a] if isinstance(a, (list, tuple)) else [a]
    sources, place = _sources([*first, *([] if b is None else [b])], baseline)
    if is_pair and len(sources) > 2:
        raise InputError.at(Path(str(a)), f"{len(sources)} runs match; give a list to compare them all")
    comparison, _ = compare_runs(
        sources,
        out,
        baseline=place,
        tolerance=tolerance,
        absolute=absolute,
        write=out is not None,
        report=comparison_page,
        force=force,
        as_pair=is_pair,
    )
    return comparison


def _sources(sides: Sequence[Any], baseline: Any = None, results: Path | None = None) -> tuple[list[RunSource], int]:
    """Return the runs to compare, and the index of the baseline.

    Args:
        sides: Paths, numbers, names and patterns of runs, and results of functions. Results that a pattern matches
            although they have no rows, as a sweep, are left out.
        results: Folder of results, by default `results`.

    Raises:
        InputError: Fewer than two runs, or a baseline that is not one run.
    """
    from cosim.comparison.several import RunSource
    from cosim.files.results import rows_in
    from cosim.files.run_entries import Selected, select_groups
    from cosim.simulation.run_files import RecordedRun, read_ran
    from cosim.simulation.run_signals import Run, Signals

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


def command(
    runs: list[str],
    *,
    baseline: str | None = None,
    tolerance: float | None = None,
    absolute: float = 0.0,
    results: Path | None = None,
    out: FilePath | None = None,
    report: bool = True,
    force: bool = False,
    open: bool = False,
    json: bool = False,
) -> None:
    """Compare runs signal by signal with a baseline.

    Prints the largest differences. Writes comparison.json and a report that shows all runs in the same charts.

    Args:
        runs (RUN...): Folders of runs, their numbers, names or patterns in `cosim list`, or CSV files of rows.
        baseline (RUN): Baseline (default: the first run).
        tolerance (--tol NUMBER): Allowed difference as a share of each signal's range; exit code 5 if exceeded.
        absolute (--abs NUMBER): Allowed difference in each signal's unit, added to --tol.
        out (--out -o PATH): Folder for the results (default: a new number in results/A-and-B).

    Example: cosim compare results/one results/two --tol 1e-3
    """
    from cosim.comparison.differences import Compared
    from cosim.comparison.page import comparison_page
    from cosim.comparison.workflow import compare as compare_runs

    sources, place = _sources(runs, baseline, results)
    if absolute and tolerance is None:
        tolerance = 0.0
    comparison, folder = compare_runs(
        sources,
        out,
        baseline=place,
        tolerance=tolerance,
        absolute=absolute,
        report=report and comparison_page,
        force=force,
        as_pair=len(sources) == 2,
    )
    if isinstance(comparison, Compared):
        warn(*comparison.a.warnings, *comparison.b.warnings)
        lines = _lines(comparison)
    else:
        warn(*comparison.left_out, *(warning for run in comparison.runs for warning in run.warnings))
        lines = _lines_of_several(comparison)
    if json:
        say_json(comparison.as_json())
    say(lines[0], met=comparison.same if comparison.judged else None)
    say(*lines[1:])
    say(f"differences: {folder / 'comparison.json'}")
    if report:
        say(f"report:      {folder / 'report.html'}")
        show(folder / "report.html", open)
    if comparison.judged and not comparison.same:
        raise CriterionMissed("; ".join(comparison.reasons))


def _lines_of_several(c: ComparedRuns) -> list[str]:
    """Return the lines to print: verdict, runs, inputs that differ, signals with the largest differences."""
    from cosim.comparison.signals import format_share, format_size
    from cosim.files.run_inputs import input_text

    lines = [c.summary]
    lines += [f"  {label}{'  (baseline)' if k == c.baseline else ''}" for k, label in enumerate(c.labels)]
    shown = c.drawn
    heads = [c.shorts[k] for k in shown]
    inputs = [(f"  {i.name}", *(input_text(i.values[k]) for k in shown)) for i in c.inputs[:MAX_SIGNALS]]
    lines += table(("  input", *heads), inputs) if inputs else []
    rows = []
    differing = c.differing
    for name, cells in list(differing.items())[:MAX_SIGNALS]:
        shares = ("" if (d := cells[k]) is None else f"{format_size(d, d.largest)}, {format_share(d)}" for k in shown)
        rows.append((f"  {name}", *shares))
    lines += table(("  largest difference", *heads), rows) if rows else []
    if len(differing) > MAX_SIGNALS:
        lines.append(f"  … and {len(differing) - MAX_SIGNALS} more that differ")
    return lines


def _lines(comparison: Compared) -> list[str]:
    """Return the lines to print: verdict, signals with the largest differences, signals in a single run."""
    from cosim.comparison.differences import sentence
    from cosim.comparison.signals import format_share, format_size

    ranked = [d for d in comparison.ranking if d.largest]
    rows = []
    for d in ranked[:MAX_SIGNALS]:
        verdict = ("beyond" if d.beyond else "within") if comparison.judged else ""
        sizes = format_size(d, d.largest), f"{d.at:.6g} s", format_size(d, d.rms), format_share(d)
        rows.append((f"  {d.name}", *sizes, verdict, d.note))
    lines = table(("  signal", "largest", "at", "rms", "of its range", "", ""), rows) if rows else []
    if len(ranked) > MAX_SIGNALS:
        lines.append(f"  … and {len(ranked) - MAX_SIGNALS} more that differ")
    for name, only in (("a", comparison.only_a), ("b", comparison.only_b)):
        lines += [f"  only in {name}: {some(only, MAX_SIGNALS)}"] if only else []
    return [sentence(comparison), *lines]
