"""Output of the commands on a terminal: lines, JSON, tables, progress."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer

from cosim.core.errors import CosimError, FmuError, InputError, SimulationError
from cosim.core.messages import Note, printable, with_severity

LONG_TIME = 2.0  # [s] until a progress bar is shown
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


def echo(text: str, *, err: bool = False, nl: bool = True, met: bool | None = None) -> None:
    """Write to stdout or stderr without control characters; do nothing if the reader has closed the stream.

    Args:
        met: Whether the text is green or red; None for no colour, as for NO_COLOR or without a terminal.
    """
    shown = printable(text)
    if met is not None and not os.environ.get("NO_COLOR"):
        shown = typer.style(shown, fg="green" if met else "red")
    try:
        typer.echo(shown, err=err, nl=nl)
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # of a stream that is no file
            nobody = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nobody, (sys.stderr if err else sys.stdout).fileno())
            os.close(nobody)


def say(*lines: str, met: bool | None = None) -> None:
    """Print lines, in green or red if `met` is given; print nothing with -q or --json."""
    if not MANNER.quiet and not MANNER.as_json:
        for line in lines:
            echo(line, met=met)


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


def say_error(error: CosimError, exit_code: int | None = None) -> int:
    """Print an error, or each fault on its own line, and the files of a stopped run; return the exit code.

    With --json the error is printed as JSON too if no JSON was printed.
    """
    faults = error.faults if isinstance(error, InputError) else ()
    for text in map(str, faults) if faults else [f"error: {error}"]:
        echo(text, err=True)
    code = error.exit_code if exit_code is None else exit_code
    about: dict[str, Any] = {}
    if isinstance(error, SimulationError):
        from cosim.files.results import rows_in

        files: dict[str, str | None] = dict.fromkeys(("manifest", "report", "results"))
        if (folder := error.left) is not None:
            paths = {"manifest": folder / "manifest.json", "report": folder / "report.html", "results": rows_in(folder)}
            files |= {key: str(path) for key, path in paths.items() if path is not None and path.is_file()}
        with suppress(OSError):  # stdout may be on the disk that is full
            for title, key in (("rows so far:", "results"), ("report:     ", "report")):
                say(*([f"{title} {files[key]}"] if files[key] else []))
        time = error.time if math.isfinite(error.time) else None
        about = {"status": "failed", "component": error.component, "time": time, "reason": error.reason, **files}
    if MANNER.as_json and not MANNER.has_json:
        places = [
            {
                "kind": FmuError.__name__ if f.exit_code == FmuError.exit_code else InputError.__name__,
                "file": str(f.file),
                "line": f.line,
                "column": f.column,
                "message": f.message,
            }
            for f in faults
        ]
        with suppress(OSError):
            kind = type(error).__name__
            say_json({"error": str(error), "kind": kind, "exit_code": code, "faults": places, **about})
    return code


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
    """Print notes on stderr, except with -q."""
    warn(*map(Note, texts))


def warn(*texts: str) -> None:
    """Print warnings and notes on stderr, and keep them for JSON; -q omits notes."""
    for text in texts:
        is_note = isinstance(text, Note)
        MANNER.messages.append({"kind": "note" if is_note else "warning", "message": str(text)})
        if not (MANNER.quiet and is_note):
            echo(with_severity(text), err=True)


def say_finding(line: str) -> None:
    """Print a finding with its severity, also with -q."""
    echo(line, err=True)


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


def show(report: Path, opens: bool) -> None:
    """Open a report in the browser on request."""
    if opens and report.is_file() and not webbrowser.open(report.resolve().as_uri()):
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
    from rich.markup import escape
    from rich.progress import Progress

    bar, start = Progress(console=Console(stderr=True), transient=True), time.monotonic()
    task = bar.add_task(escape(printable(activity, one_line=True)))

    def advance(done: int, total: int) -> None:
        if time.monotonic() - start >= LONG_TIME:
            bar.start()
            bar.update(task, completed=done, total=total)

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
    is_terminal, reached, last, start = sys.stderr.isatty(), 0, "", time.monotonic()
    if MANNER.quiet or not (is_terminal or MANNER.verbose):
        yield None
        return

    def heading(stage: str) -> str:
        nonlocal reached
        number, of = (0, 0) if numbered is None else numbered(stage)
        reached = max(reached, number)
        return f"stage {reached} of {of}: {stage}" if reached else stage

    def print_stage(stage: str, share: float) -> None:
        nonlocal last
        if share == 0.0 and stage != last:
            say_more(f"{time.monotonic() - start:6.1f} s  {heading(stage)}")
            last = stage

    if not is_terminal:
        yield print_stage
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
