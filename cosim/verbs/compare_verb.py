"""`cosim compare` and `cosim.compare`: compare two runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.base.errors import CriterionMissed, InputError
from cosim.base.messages import join
from cosim.base.settings import NotNegative
from cosim.storage.files import FilePath
from cosim.verbs import messages
from cosim.verbs.options import Force, Json, Open, Report, out_option
from cosim.verbs.terminal import colour, say, say_json, show, some, table

if TYPE_CHECKING:
    from cosim.comparison.differences import Compared
    from cosim.simulation.run_files import RecordedRun
    from cosim.simulation.run_signals import Signals

MAX_SIGNALS = 12  # on the terminal


def compare(
    a: FilePath | Signals,
    b: FilePath | Signals,
    out: FilePath | None = None,
    *,
    tolerance: NotNegative | None = None,
    absolute: NotNegative = 0.0,
    force: bool = False,
) -> Compared:
    """Compare two runs signal by signal.

    A difference beyond the tolerance is not an error: see `Compared.same`.

    Args:
        a: Baseline: folder of a run, CSV file whose first column is time, or result of a function.
        b: Run that is compared with the baseline.
        out: Folder for comparison.json and report.html; None writes nothing.
        tolerance: Allowed difference as a share of each signal's range in `a`.
        absolute: Allowed difference in each signal's unit, added to `tolerance`.
        force: Overwrite results of other runs or of another command in `out`.

    Returns:
        The difference of each signal, and the verdict if there is a tolerance.

    Raises:
        InputError: The runs have no common signal or no common time.
    """
    from cosim.comparison.workflow import compare as compare_runs

    comparison, _ = compare_runs(
        _run_of(a), _run_of(b), out, tolerance=tolerance, absolute=absolute, write=out is not None, force=force
    )
    return comparison


def _run_of(side: FilePath | Signals) -> Any:
    from cosim.simulation.run_files import RecordedRun, read_ran
    from cosim.simulation.run_signals import Run, Signals

    if not isinstance(side, Signals):
        return read_ran(Path(side))
    manifest = side.manifest if isinstance(side, Run) else {}
    return RecordedRun(side.folder or Path(side.title), side.title, side.results, manifest)


def _named_run(path: Path) -> RecordedRun:
    """Return a run by its path, or by its number or name in `cosim list`."""
    from cosim.history.entries import entries, match_entries
    from cosim.simulation.run_files import read_ran

    matches = [] if path.exists() else match_entries(str(path), entries())
    if not matches:
        return read_ran(path)
    if len(matches) > 1:
        raise InputError.at(path, messages.SEVERAL_RUNS(count=len(matches)))
    return replace(read_ran(matches[0].folder), name=matches[0].label)


def command(
    a: Annotated[
        Path,
        typer.Argument(help="Baseline: folder of a run, its number or name in `cosim list`, or a CSV file of rows."),
    ],
    b: Annotated[Path, typer.Argument(help="Run that is compared with the baseline.")],
    *,
    tolerance: Annotated[
        float | None,
        typer.Option("--tol", help="Allowed difference as a share of each signal's range; exit code 5 if exceeded."),
    ] = None,
    absolute: Annotated[
        float, typer.Option("--abs", help="Allowed difference in each signal's unit, added to --tol.")
    ] = 0.0,
    out: Annotated[Path | None, out_option("results/A-and-B")] = None,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Compare two runs signal by signal.

    Prints the largest differences. Writes comparison.json and a report that shows both runs in the same charts.

    Example: cosim compare results/one results/two --tol 1e-3
    """
    from cosim.comparison.workflow import compare as compare_runs

    if absolute and tolerance is None:
        tolerance = 0.0
    comparison, folder = compare_runs(
        _named_run(a), _named_run(b), out, tolerance=tolerance, absolute=absolute, report=report, force=force
    )
    if as_json:
        say_json(comparison.as_json())
    else:
        say(*_lines(comparison))
        say(f"differences: {folder / 'comparison.json'}")
        if report:
            say(f"report:      {folder / 'report.html'}")
    show(folder / "report.html", open_=report and open_)
    if comparison.judged and not comparison.same:
        raise CriterionMissed(join("; ", comparison.reasons))


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
    verdict = sentence(comparison)
    return [colour(comparison.same, verdict) if comparison.judged else verdict, *lines]
