"""Commands on existing results: compare, report, list, open, view, gc, and `cosim.read`."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from cosim.core.errors import CriterionMissed, InputError, refuse
from cosim.core.registry import resolve
from cosim.core.settings import Count, NotNegative, Port, Whole
from cosim.core.text import counted, some
from cosim.files.artefact import artefacts
from cosim.files.files import FilePath, check_writable
from cosim.files.folders import RESULTS_FOLDER, manifest_in, newest_run, warnings_on
from cosim.verbs.cli import progress_bar, say, say_json, show, show_page, table, warn

if TYPE_CHECKING:
    from cosim.calibration.fitted import Fitted
    from cosim.comparison.several import ComparedRuns
    from cosim.files.run_entries import Removal
    from cosim.refinement.refinement import Refined
    from cosim.residuals.replay_signals import Replay
    from cosim.simulation.run_signals import Run, Signals
    from cosim.sweeps.store import Runs


MAX_TERMINAL_SIGNALS = 12  # number of signals on the terminal
MAX_CELL_WIDTH = 60  # characters of an outcome, of values and of changes in a table
SORTED: Mapping[str, Callable[[Any], Any]] = {  # key of --sort → order of entries
    "when": lambda e: e.time,
    "command": lambda e: e.verb,
    "name": lambda e: e.name,
    "outcome": lambda e: (e.met is not False, e.outcome),
}
NAMED_RUNS = 5  # removed runs listed on the terminal
LAYOUTS = "view.json"
GRACE_S = 10.0  # [s] without a page until the command ends
MOST_REMOVED = 10


def compare(
    a: FilePath | Count | Signals | Sequence[FilePath | Count | Signals],
    b: FilePath | Count | Signals | None = None,
    out: FilePath | None = None,
    *,
    baseline: FilePath | Count | Signals | None = None,
    tolerance: NotNegative | None = None,
    absolute: NotNegative = 0.0,
    force: bool = False,
) -> ComparedRuns:
    """Compare runs signal by signal with a baseline.

    A difference beyond the tolerance is not an error: see `same` of the result.

    Args:
        a: Baseline: folder of a run, CSV file whose first column is time, number, name or pattern in `cosim list`, or
            result of a function; or a list of runs.
        b: Run to compare with the baseline `a`.
        out: Folder for comparison.json and report.html; None writes nothing.
        baseline: Baseline of a list of runs; by default its first run.
        tolerance: Allowed difference as a share of each signal's range in the baseline.
        absolute: Allowed difference in each signal's unit, added to `tolerance`.
        force: Write even if the folder is not empty; results in it are replaced.

    Returns:
        The differences of each signal, and the verdict if there is a tolerance.

    Raises:
        InputError: No such run, or runs without a common signal or a common time.
    """
    from cosim.comparison.several import compare as compare_runs

    sides = [*(a if isinstance(a, (list, tuple)) else [a]), *([] if b is None else [b])]
    comparison, _ = compare_runs(
        sides,
        out,
        baseline=baseline,
        tolerance=tolerance,
        absolute=absolute,
        write=out is not None,
        force=force,
    )
    return comparison


def compare_command(
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
    from cosim.comparison.several import compare as compare_runs
    from cosim.comparison.several import displays
    from cosim.core.text import showing

    if absolute and tolerance is None:
        tolerance = 0.0
    comparison, folder = compare_runs(
        runs,
        out,
        baseline=baseline,
        results=results,
        tolerance=tolerance,
        absolute=absolute,
        report=report,
        force=force,
    )
    warn(*comparison.left_out, *(warning for run in comparison.runs for warning in run.warnings))
    with showing(*displays(comparison)):
        lines = _comparison_lines(comparison)
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


def _comparison_lines(c: ComparedRuns) -> list[str]:
    """Return the lines to print: verdict, runs, inputs that differ, signals with the largest differences."""
    from cosim.comparison.differences import format_share, format_size
    from cosim.files.run_inputs import input_text

    lines = [c.summary]
    lines += [f"  {label}{'  (baseline)' if k == c.baseline else ''}" for k, label in enumerate(c.labels)]
    inputs = [(f"  {i.name}", *(input_text(i.values[k]) for k in c.drawn)) for i in c.inputs[:MAX_TERMINAL_SIGNALS]]
    lines += table(("  input", *(c.shorts[k] for k in c.drawn)), inputs) if inputs else []
    others = [k for k in c.drawn if k != c.baseline]
    rows = []
    differing = c.differing
    for name, cells in list(differing.items())[:MAX_TERMINAL_SIGNALS]:
        found = [cells[k] for k in others]
        texts = ["" if d is None else f"{format_size(d, d.largest)}, {format_share(d)}, {d.at:.6g} s" for d in found]
        notes = dict.fromkeys(d.note for d in found if d is not None and d.note)
        rows.append((f"  {name}", *texts, ", ".join(notes)))
    lines += table(("  largest difference", *(c.shorts[k] for k in others), ""), rows) if rows else []
    if len(differing) > MAX_TERMINAL_SIGNALS:
        lines.append(f"  … and {len(differing) - MAX_TERMINAL_SIGNALS} more that differ")
    for k, pair in c.by_run.items():
        for where, only in ((c.shorts[c.baseline], pair.only_a), (c.shorts[k], pair.only_b)):
            lines += [f"  only in {where}: {some(only, MAX_TERMINAL_SIGNALS)}"] if only else []
    return lines


def report_command(folder: Path, *, open: bool = False, json: bool = False) -> None:
    """Write the report of a run again from its results.

    Args:
        folder: Folder of a run.

    Example: cosim report results/one --open
    """
    from cosim.files.kinds import check_given
    from cosim.files.results import rows_in
    from cosim.simulation.report.run_page import write_report
    from cosim.simulation.run_signals import read_ran

    path = newest_run(folder)
    if not path.is_dir():
        check_given(path, "the folder of a run")
    if not isinstance(manifest_in(path).get("scenario"), dict):
        raise InputError.at(
            path, "has no manifest.json, or a damaged one; give the folder with the results of `cosim run`"
        )
    run = read_ran(path)
    if not run.results.time.size:
        raise InputError.at(rows_in(path) or path, "has no rows: the run stopped before the first row; run it again")
    check_writable(path, ("report.html",))
    warn(*run.warnings)
    try:
        write_report(path / "report.html", run.results, run.manifest)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"is damaged ({type(error).__name__}: {error}); run the scenario again"
        raise InputError.at(path / "manifest.json", reason) from None
    page = path / "report.html"
    say(f"report:  {page}")
    if json:
        say_json({"report": str(page)})
    show(page, open)


def list_command(
    names: list[str] | None = None, *, results: Path | None = None, sort: str = "when", json: bool = False
) -> None:
    """List results: time, command, outcome, criteria, and inputs that changed.

    Args:
        names ([RUN]): Numbers, names or patterns such as 'tank/*' (default: all).
        sort (KEY): when, command, name, outcome, or a criterion such as 'peak of tank.h', the smallest first.

    Example: cosim list 'tank*'
    """
    from cosim.core.text import did_you_mean
    from cosim.files.run_entries import find_entries

    root = results or RESULTS_FOLDER
    listed = find_entries(names, root)
    titles = {title for entry in listed for title in entry.merits}
    if sort in titles:
        listed = sorted(listed, key=lambda e: e.merits.get(sort, (math.inf, ""))[0])
    elif sort in SORTED:
        listed = sorted(listed, key=SORTED[sort])
    else:
        keys = ", ".join((*SORTED, *sorted(titles)))
        text = f"no results have {sort!r}{did_you_mean(sort, (*SORTED, *titles))}; sort by one of {keys}"
        raise InputError.at(Path("--sort"), text)
    found = [(entry, datetime.fromtimestamp(entry.time)) for entry in listed]
    warn(*(text for entry, _ in found for text in entry.warnings))
    if json:
        say_json(
            {
                "results": [
                    {
                        "number": e.number,
                        "name": e.name,
                        "folder": str(e.folder),
                        "command": e.verb,
                        "time": when.astimezone().isoformat(timespec="seconds"),
                        "outcome": e.outcome,
                        "criteria": [*e.criteria],
                        "changes": dict(e.changes),
                        "other_version": e.version or None,
                        "warnings": [*e.warnings],
                    }
                    for e, when in found
                ]
            }
        )
    rows = []
    for e, when in found:
        merits = ", ".join(f"{title} {text}" for title, (_, text) in e.merits.items())
        texts = (
            t if len(t) <= MAX_CELL_WIDTH else f"{t[: MAX_CELL_WIDTH - 1]}…" for t in (e.outcome, merits, e.changed)
        )
        rows.append((str(e.number), f"{when:%Y-%m-%d %H:%M}", e.verb, e.name, *texts, e.version))
    heads = ("no.", "when", "command", "name", "outcome", "values", "changed", "of cosim")
    head, *lines = table(heads, rows) if rows else [f"no results in {root}"]
    say(head)
    for (e, _), line in zip(found, lines, strict=False):
        say(line, met=False if e.met is False or e.outcome.startswith("failed") else None)


def open_command(
    run: str | None = None, *, results: Path | None = None, browser: bool = True, json: bool = False
) -> None:
    """Open the report of results in a browser.

    Args:
        run ([RUN]): Number, name or pattern of results, or their folder (default: the newest results).
        browser: Open the page; otherwise only print its path.

    Example: cosim open 3
    """
    from cosim.files.folders import state_of
    from cosim.files.run_entries import Selected, entries, select_groups

    root = results or RESULTS_FOLDER
    found = [Selected(e.folder, e) for e in entries(root)[-1:]] if run is None else select_groups([run], root)[0]
    if len(found) != 1:
        names = some([f"{s.entry.number} {s.entry.name}" for s in found if s.entry is not None], NAMED_RUNS)
        raise InputError.at(
            Path(run or root), f"{len(found)} results: {names or 'none'}; give one name or number of `cosim list`"
        )
    folder, entry = found[0].path, found[0].entry
    page = folder / "report.html"
    if not page.is_file():
        state, place = state_of(folder), shlex.quote(str(folder))
        reason = f"its command is {state}" if state else f"`cosim report {place}` writes the report of a run"
        raise InputError.at(folder, f"has no report.html; {reason}")
    warn(*dict.fromkeys((*warnings_on(folder), *(entry.warnings if entry is not None else ()))))
    say(f"report: {page}")
    if json:
        say_json({"report": str(page)})
    show(page, browser)


def view_command(
    runs: list[str] | None = None,
    *,
    results: Path | None = None,
    layout: Path | None = None,
    columns: list[str] | None = None,
    port: Port = 0,
    browser: bool = True,
    prepare: bool = False,
    json: bool = False,
) -> None:
    """Show the signals of runs in a browser page, served on this machine only.

    Args:
        runs ([RUN]): Numbers, names or patterns of results, folders, or tables of rows (default: the newest results).
        columns (--column COLUMN=SIGNAL): Signal of a column of a table, for example stamp=time.
        layout: File of saved layouts (default: view.json in the folder of results).
        port: Port of the page (0: any).
        browser: Open the page; otherwise only print its address.
        prepare: Convert large tables, without opening a page.

    Example: cosim view 'tank*'
    """
    from cosim.logs.log import read_column_names
    from cosim.pages.layouts import Layouts
    from cosim.pages.runs import find_runs, open_runs
    from cosim.pages.view_page import view_page

    root = results or RESULTS_FOLDER
    layouts = Layouts(layout or root / LAYOUTS)
    named = read_column_names(columns, Path((runs or ["--column"])[0]))
    places, notes = find_runs(runs or (), root, named)
    with progress_bar() as show:
        opened, warnings = open_runs(places, show)
    warn(*notes, *warnings)
    labels = [run.place.label for run in opened]
    signals, rows = sum(len({*r.rows.units, *r.rows.texts}) for r in opened), sum(r.rows.rows for r in opened)
    amounts = counted(len(opened), "run"), counted(signals, "signal"), counted(rows, "row")
    say(f"{', '.join(amounts)}: {some(labels, NAMED_RUNS)}")
    about = {"runs": [{"name": r.place.name, "file": str(r.place.file), "rows": r.rows.rows} for r in opened]}
    if prepare:
        if json:
            say_json(about)
        return
    title = labels[0] if len(labels) == 1 else counted(len(labels), "run")
    page = view_page(title, opened, layouts, port, notes=[*notes, *warnings])
    if json:
        say_json({"url": page.url, **about})
    show_page(page, "signals", title, float("inf"), GRACE_S, opens=browser)


def gc_command(
    names: list[str] | None = None,
    *,
    keep: Whole = 0,
    older: NotNegative = 0.0,
    results: Path | None = None,
    yes: bool = False,
    json: bool = False,
) -> None:
    """Remove earlier runs; the newest results of each name are kept.

    Shows what would be removed, and asks for confirmation.

    Args:
        names ([RUN]): Numbers, names or patterns such as 'tank/*' (default: all).
        keep (NUMBER): Number of earlier runs of each name to keep.
        older (DAYS): Remove runs older than this number of days.
        yes (--yes -y): Remove without asking.

    Example: cosim gc --keep 5
    """
    from cosim.files.run_entries import Removal, entries, find_entries, plan_removal, remove

    root = results or RESULTS_FOLDER
    chosen = find_entries(names, root)
    plan = plan_removal(entries(root), keep=keep, older=older, chosen=chosen)
    warn(*(text for entry in chosen for text in entry.warnings))
    planned = [entry.name for entry in plan.entries]
    if planned:
        say(f"to remove: {_amount(plan)}: {some(planned, MOST_REMOVED)}")
        if not yes:
            if json or not sys.stdin.isatty():
                raise InputError.at(root, "nothing was removed, because the question was not answered; add --yes")
            if not typer.confirm("Remove these results?"):
                planned = []
    done = remove(plan.entries) if planned else Removal((), 0)
    kept = "" if plan.entries else ": the newest results of a name are kept; give its earlier runs, such as 'tank/*'"
    say(f"removed: {_amount(done)}" if done.entries else f"nothing to remove{kept}")
    if json:
        say_json({"removed": [entry.name for entry in done.entries], "bytes": done.size})
    refuse(done.faults)


def _amount(removal: Removal) -> str:
    """Return a number of runs and their size as text."""
    from rich.filesize import decimal

    return f"{counted(len(removal.entries), 'earlier run')}, {decimal(removal.size)}"


def read(folder: FilePath) -> Run | Replay | Fitted | Refined | Runs | Signals:
    """Read the results of a verb from a folder, or the signals of a CSV file.

    Args:
        folder: Folder of `run`, `simulate`, `replay`, `fit`, `refine` or `sweep`, or a CSV file whose first column is
            time.

    Returns:
        The object that the verb's function returns; `Runs` of a sweep; `Signals` of a CSV file.

    Raises:
        InputError: There are no such results.
    """
    from cosim.simulation.run_signals import read_run

    path = newest_run(Path(folder))
    for artefact in artefacts():
        if artefact.reader and artefact.is_left_in(path):
            result: Run | Replay | Fitted | Refined | Runs | None = resolve(artefact.reader)(path)
            if result is not None:
                return result
    return read_run(path)
