"""Output of the commands on a terminal: lines, JSON, tables, progress."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, InputError, SimulationError
from cosim.base.messages import Note, printable, with_severity
from cosim.verbs.streams import Coloured, echo

LONG_RUN, LONG_TIME = 2000, 2.0  # steps, or time [s], from which a progress bar is shown
StageNumber = Callable[[str], tuple[int, int]]


@dataclass
class Manner:
    """Amount and form of the output of a command.

    Attributes:
        quiet: Whether to print problems only.
        verbose: Whether to print more.
        as_json: Whether to print the result as JSON.
        has_json: Whether JSON has been printed.
        messages: Warnings and notes so far.
    """

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    has_json: bool = False
    messages: list[dict[str, str]] = field(default_factory=list)


LAST: list[Callable[[], None]] = []  # functions called when everything about the command has been printed
MANNER = Manner()  # of this process, set by the options -q and -v of any command


def say(*lines: str) -> None:
    """Print lines, except with -q or --json."""
    if not MANNER.quiet and not MANNER.as_json:
        for line in lines:
            echo(line)


def say_more(text: str) -> None:
    """Print a line with -v."""
    if MANNER.verbose:
        echo(text, err=True)


def say_json(value: Any) -> None:
    """Print JSON, also with -q. An object gets the warnings and notes so far."""
    if isinstance(value, dict) and MANNER.messages:
        value = {**value, "messages": MANNER.messages}
    echo(json.dumps(value, indent=2, ensure_ascii=False))
    MANNER.has_json = True


def say_failure(error: CosimError) -> None:
    """Print an error as JSON if --json is set and no JSON was printed."""
    if MANNER.as_json and not MANNER.has_json:
        faults = getattr(error, "faults", ())
        about = _describe_stop(error) if isinstance(error, SimulationError) else {}
        places = [{"file": str(f.file), "line": f.line, "column": f.column, "message": f.message} for f in faults]
        kind = type(error).__name__
        say_json({"error": str(error), "kind": kind, "exit_code": error.exit_code, "faults": places, **about})


def say_error(error: CosimError) -> None:
    """Print an error, or each fault on its own line."""
    if isinstance(error, InputError):
        for fault in error.faults:
            echo(str(fault), err=True)
    else:
        echo(f"error: {error}", err=True)


def _describe_stop(error: SimulationError) -> dict[str, Any]:
    """Return time and files of a stopped run; null for missing ones."""
    from cosim.storage.results import rows_in

    names = {"manifest": "manifest.json", "report": "report.html"}
    paths = {key: None if error.left is None else error.left / name for key, name in names.items()}
    paths["results"] = None if error.left is None else rows_in(error.left)
    files = {key: str(path) if path is not None and path.is_file() else None for key, path in paths.items()}
    time = error.time if math.isfinite(error.time) else None
    return {"status": "failed", "component": error.component, "time": time, "reason": error.reason, **files}


def say_usage(error: Any) -> int:
    """Print a faulty command line, also as JSON if it has --json; return the exit code."""
    options = {*sys.argv[1:]}
    MANNER.verbose = not options.isdisjoint({"-v", "--verbose"})
    message = error.format_message()
    error.format_message = lambda: printable(message)
    error.show()
    if "--json" in options:
        say_json({"error": message, "kind": "UsageError", "exit_code": error.exit_code, "faults": []})
    return int(error.exit_code)


def say_note(*texts: str) -> None:
    """Print notes on stderr."""
    if not MANNER.quiet:
        for text in texts:
            _record("note", text)
            echo(f"note: {text}", err=True)


def warn(*texts: str) -> None:
    """Print warnings and notes on stderr; -q omits notes."""
    for text in texts:
        is_note = isinstance(text, Note)
        _record("note" if is_note else "warning", text)
        if not (MANNER.quiet and is_note):
            echo(with_severity(text), err=True)


def _record(kind: str, text: str) -> None:
    """Keep a warning or note for JSON."""
    MANNER.messages.append({"kind": kind, "message": str(text)})


def say_finding(line: str) -> None:
    """Print a finding with its severity, also with -q."""
    echo(line, err=True)


def colour(met: bool, text: str) -> str:
    """Return a line in green or red; without colour for NO_COLOR or without a terminal."""
    return text if os.environ.get("NO_COLOR") else Coloured(text, "green" if met else "red")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table; each column is as wide as its widest cell, empty columns are omitted."""
    shown = ((printable(cell, one_line=True) for cell in line) for line in (header, *rows))
    columns = [column for column in zip(*shown, strict=True) if any(column[1:])]
    cells = [*zip(*columns, strict=True)]
    widths = [max(map(len, column)) for column in columns]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)
    return [line.rstrip() for line in lines]


def some(names: Sequence[str], most: int) -> str:
    """Return the first `most` names as a list, with an ellipsis for omitted names."""
    return ", ".join(names[:most]) + (", …" if len(names) > most else "")


def show(report: Path, *, open_: bool) -> None:
    """Open a report in the browser on request."""
    if open_ and not webbrowser.open(report.resolve().as_uri()):
        warn(f"no browser is found here; open {report}")


def files_in(folder: Path, *names: str) -> dict[str, str]:
    """Return name → path of result files in a folder."""
    return {name.partition(".")[0]: str(folder / name) for name in (*names, "report.html") if (folder / name).is_file()}


@contextmanager
def progress_bar(activity: str = "simulating") -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar on a terminal; yield the function that moves it, or None without a terminal."""
    if MANNER.quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    text = TextColumn("{task.description}", markup=False)
    columns = text, BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeRemainingColumn()
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task, first, label = None, math.inf, printable(activity, one_line=True)

    def advance(done: int, total: int) -> None:
        nonlocal task, first
        first = min(first, time.monotonic())
        if total < LONG_RUN and time.monotonic() - first < LONG_TIME:
            return
        if task is None:
            bar.start()
            task = bar.add_task(label, total=total)
        bar.update(task, completed=done)

    try:
        yield advance
    finally:
        bar.stop()


@contextmanager
def stages(numbered: StageNumber | None = None) -> Iterator[Callable[[str, float], None] | None]:
    """Show the current stage with its completed share and a clock on a terminal; with -v, one line per stage elsewhere.

    Args:
        numbered: Number of a stage and of all stages; a stage without a number belongs to the previous one.
    """
    if MANNER.quiet or not (sys.stderr.isatty() or MANNER.verbose):
        yield None
        return
    heading = _headings(numbered)
    if not sys.stderr.isatty():
        yield _lines(heading)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    clock = TimeElapsedColumn(table_column=Column(no_wrap=True))  # on a narrow terminal the bar gets shorter
    columns = clock, TextColumn("{task.description}", markup=False), BarColumn(bar_width=20)
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def advance(stage: str, share: float) -> None:
            # a stage that counts nothing, or has counted to its end while work goes on, has a bar that only moves
            bar.tasks[task].total = 1.0 if 0.0 < share < 1.0 else None
            bar.update(task, description=printable(heading(stage), one_line=True), completed=share)

        yield advance


def _headings(numbered: StageNumber | None) -> Callable[[str], str]:
    """Return a function that formats `stage 3 of 10: words`; a repeated stage keeps the highest number so far."""
    reached = 0

    def heading(stage: str) -> str:
        nonlocal reached
        if numbered is None:
            return stage
        number, of = numbered(stage)
        reached = max(reached, number)
        return f"stage {reached} of {of}: {stage}" if reached else stage

    return heading


def _lines(heading: Callable[[str], str]) -> Callable[[str, float], None]:
    """Return a function that prints each stage once, with the seconds since the start."""
    start, last = time.monotonic(), ""

    def print_stage(stage: str, share: float) -> None:
        nonlocal last
        if share == 0.0 and stage != last:
            say_more(f"{time.monotonic() - start:6.1f} s  {heading(stage)}")
            last = stage

    return print_stage
