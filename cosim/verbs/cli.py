"""The command line that all verbs share: output on a terminal, options, exit codes.

The parameters of a command are its options, or arguments if they have no default or a metavar in brackets. `Args` has
their meanings, metavars and other names: `columns (--column COLUMN=VARIABLE): Variable of a column.` `**given` are
the parameters of the verb's Python function but those `(in Python)`.

Args:
    results: Folder of results (default: results).
    report: Write report.html, or do not.
    force: Write even if the folder is not empty; results in it are replaced.
    open: Open the report in a browser.
    live: Open a page that shows the progress of the work.
    port: Port of the live page (default: any free port); implies --live.
    json: Print JSON instead of text.
    quiet (--quiet -q): Print only warnings, errors and JSON.
    verbose (--verbose -v): Print more, such as the order of steps and timings.
"""

from __future__ import annotations

import functools
import json
import math
import os
import re
import sys
import warnings
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from inspect import Parameter, Signature, getdoc, signature
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.core.drafts import is_full
from cosim.core.errors import CosimError, FmuError, InputError, SimulationError, Terminated
from cosim.core.messages import Note, printable, with_severity
from cosim.core.registry import Verb, attempt, resolve
from cosim.core.settings import adapter, check_values
from cosim.core.version import __version__
from cosim.verbs import verbs

ITEM = re.compile(r"^    (\w+)(?: \((.*?)\))?: (.*?)(?=^    \w|\n\n|\Z)", re.MULTILINE | re.DOTALL)


@dataclass
class Output:
    """Settings of the output of a command, with the warnings and notes so far."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    has_json: bool = False
    messages: list[dict[str, str]] = field(default_factory=list)


OUTPUT = Output()  # of this process, set by the options of any command
TONE_COLOURS = {"good": "green", "warn": "yellow", "bad": "red"}
AT_THE_END: list[Callable[[], None]] = []  # functions called when everything about the command has been printed


def echo(text: str, *, err: bool = False, tone: str = "") -> None:
    """Write a line without control characters, in the colour of its tone, unless the stream is closed."""
    colour = None if os.environ.get("NO_COLOR") else TONE_COLOURS.get(tone)
    try:
        typer.secho(printable(text), err=err, fg=colour)
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # a stream that is not a file
            os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if err else sys.stdout).fileno())


def say(*lines: str, met: bool | None = None, tone: str = "") -> None:
    """Print lines, in the colour of a criterion or a tone; print nothing with -q or --json."""
    tone = tone if met is None else "good" if met else "bad"
    for line in () if OUTPUT.quiet or OUTPUT.as_json else lines:
        echo(line, tone=tone)


def warn(*texts: str) -> None:
    """Print warnings and notes on stderr, and store them for JSON; -q omits notes."""
    for text in texts:
        OUTPUT.messages.append({"kind": "note" if isinstance(text, Note) else "warning", "message": str(text)})
        if not (OUTPUT.quiet and isinstance(text, Note)):
            echo(with_severity(text), err=True)


def say_json(value: Any) -> None:
    """Print JSON, also with -q. The warnings and notes so far are added to an object."""
    if isinstance(value, dict) and OUTPUT.messages:
        value = {**value, "messages": OUTPUT.messages}
    echo(json.dumps(value, indent=2, ensure_ascii=False))
    OUTPUT.has_json = True


def say_error(error: CosimError, exit_code: int | None = None) -> int:
    """Print an error and the files of a stopped run, with --json also as JSON; return the exit code."""
    faults = error.faults if isinstance(error, InputError) else ()
    answer: dict[str, Any] = {"error": str(error), "kind": type(error).__name__, "faults": []}
    answer["exit_code"] = error.exit_code if exit_code is None else exit_code
    for fault in faults:
        kind = "FmuError" if fault.exit_code == FmuError.exit_code else "InputError"
        is_option = str(fault.file).startswith("--")
        place = {"file": None if is_option else str(fault.file), "line": fault.line, "column": fault.column}
        answer["faults"].append({"kind": kind, **place, "message": str(fault) if is_option else fault.message})
    for line in faults or [f"error: {error}"]:
        echo(str(line), err=True)
    with suppress(OSError):  # stdout may be a file on the full disk
        if isinstance(error, SimulationError):
            from cosim.files.results import rows_in

            time = error.time if math.isfinite(error.time) else None
            answer |= {"status": "failed", "component": error.component, "time": time, "reason": error.reason}
            answer |= dict.fromkeys(("manifest", "report", "results"))
            if error.left is not None:
                rows = rows_in(error.left)
                answer |= files_in(error.left, "manifest.json", *([rows.name] if rows else []))
            lines = {"rows so far:": answer["results"], "report:     ": answer["report"]}
            say(*(f"{title} {file}" for title, file in lines.items() if file))
        if OUTPUT.as_json and not OUTPUT.has_json:
            say_json(answer)
    return int(answer["exit_code"])


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table; each column is as wide as its widest cell, empty columns are omitted."""
    shown = ((printable(cell, one_line=True) for cell in line) for line in (header, *rows))
    columns = [column for column in zip(*shown, strict=True) if any(column[1:])]
    padded = ([cell.ljust(max(map(len, column))) for cell in column] for column in columns)
    return ["  ".join(line).rstrip() for line in zip(*padded, strict=True)]


def show(report: Path, opens: bool) -> None:
    """Open a report in the browser on request."""
    if opens and report.is_file() and not webbrowser.open(report.resolve().as_uri()):
        warn(f"no browser was found; open {report}")


def files_in(folder: Path, *names: str) -> dict[str, str]:
    """Return name → path of result files in a folder."""
    return {name.partition(".")[0]: str(folder / name) for name in (*names, "report.html") if (folder / name).is_file()}


@contextmanager
def progress_bar(activity: str = "simulating") -> Iterator[Callable[[Any, float], None] | None]:
    """Yield a function of (completed, all steps) or (stage, share) that draws a bar on a terminal, else None."""
    if OUTPUT.quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TimeElapsedColumn(), TextColumn("{task.description}", markup=False), BarColumn(bar_width=20)
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        bar.add_task("starting", total=None)
        (task,) = bar.tasks

        def advance(first: Any, second: float) -> None:
            share = second if isinstance(first, str) else first / max(second, 1)
            text = printable(first if isinstance(first, str) else f"{activity}: {int(10 * share)}0 %", one_line=True)
            task.total = 1.0 if 0.0 < share < 1.0 else None  # the bar never moves backwards
            bar.update(task.id, description=text, completed=share)

        yield advance


def show_page(page: Any, kind: str, title: str, *limits: float, opens: bool = True) -> None:
    """Open a served page in the browser; it is served until the user closes it."""
    from cosim.pages.server import open_page

    AT_THE_END.append(lambda: page.wait_for_close(warn, *limits))
    note = Note(f"{kind}: {page.url}")
    warn(note) if opens and open_page(page.url, title) else echo(note, err=True)


def live_page(kind: str, title: str, *, live: bool, port: int | None, **settings: Any) -> Any:
    """Return the live page of a verb, of a class in `work_pages`; without --live, a context of None."""
    if not live and port is None:
        return nullcontext()
    from cosim.pages import work_pages

    page = getattr(work_pages, kind)(title, port or 0, **settings)
    show_page(page, "live page", title)
    return page


def _with_options(command: Callable[..., Any], verb: Verb) -> Callable[..., None]:
    """Return a command with options for Typer; it returns None, i.e. exit code 0."""

    def run(*, quiet: bool = False, verbose: bool = False, **given: Any) -> None:
        OUTPUT.quiet, OUTPUT.verbose, OUTPUT.as_json, OUTPUT.has_json = quiet, verbose, bool(given.get("json")), False
        OUTPUT.messages.clear()
        values = {name: value for name, value in given.items() if value is not None}
        adapters = {name: adapter(*types[name], strict=False) for name in values}
        command(**{**given, **check_values(adapters, values, labels)})

    parameters, labels, types = dict[str, Parameter](), dict[str, str](), dict[str, tuple[Any, Any]]()
    functions = [resolve(verb.function)] if "given" in signature(command).parameters else []
    texts = "".join(f"{getdoc(function)}\n\n" for function in (sys.modules[__name__], *functions, command))
    meanings = {name: (names.split(), " ".join(text.split())) for name, names, text in ITEM.findall(texts)}
    for function in (*functions, command, run):
        for name, parameter in signature(function).parameters.items():
            names, meaning = meanings.get(name, ([], ""))
            if name != "given" and names != ["in", "Python"]:
                types[name] = parameter.annotation, function
                parameters[name], labels[name] = _option(parameter, names, meaning)
    run.__signature__ = Signature([*parameters.values()])  # type: ignore[attr-defined]
    return run


def _option(parameter: Parameter, names: Sequence[str], meaning: str) -> tuple[Parameter, str]:
    """Return a parameter for Typer, with text values, and its name on the command line."""
    default = [] if parameter.default == () else parameter.default
    written = getattr(parameter.annotation, "__name__", str(parameter.annotation))
    is_list = re.search("^(list|Given|Names|Values)|Files", written)
    kind: Any = bool if written == "bool" else list[str] if is_list else str
    flags, metavar = [n for n in names if n[0] == "-"], " ".join(n for n in names if n[0] != "-")
    if not flags and (default is Parameter.empty or metavar.startswith("[")):
        complete = COMPLETIONS.get(metavar.strip("[.]"))
        label, info = parameter.name, typer.Argument(metavar=metavar or None, help=meaning, autocompletion=complete)
    else:
        label = flags[0] if flags else f"--{parameter.name.replace('_', '-')}"
        flags = flags or [f"{label}/--no-{label[2:]}" if default is True else label]
        metavar = metavar or written.partition(" ")[0].upper()
        info = typer.Option(*flags, metavar=None if kind is bool else metavar, help=meaning)
        default = None if default is Parameter.empty else default
    annotation: Any = Annotated[kind | None if default is None else kind, info]
    return Parameter(parameter.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation), label


def _complete_runs(incomplete: str) -> list[tuple[str, str]]:
    """Return names and numbers of results that begin with a text, each with its command and outcome."""
    from cosim.files.run_entries import entries

    found = [(text, f"{e.verb} {e.outcome}") for e in reversed(entries()) for text in (e.name, str(e.number))]
    return [(text, about) for text, about in found if text.startswith(incomplete)]


def _complete_kinds(incomplete: str) -> list[str]:
    """Return the kinds of files with a schema that begin with a text."""
    from cosim.verbs.checks import kinds_with_schema

    return [kind for kind in kinds_with_schema() if kind.startswith(incomplete)]


# completion functions by metavar
COMPLETIONS: dict[str, Callable[[str], Any]] = {"RUN": _complete_runs, "KIND": _complete_kinds}


def _verb_to_complete() -> str:
    """Return the verb on the line that the shell completes; "-h" if the verb itself is incomplete."""
    line = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS") or ""
    words = line.split()
    return words[1] if len(words) > 2 or (len(words) == 2 and line[-1:].isspace()) else "-h"


def _show_version(value: bool) -> None:
    if value:
        say(f"cosim {__version__} (FMU co-simulation; not the command of the Open Simulation Platform)")
        raise typer.Exit


VERSION_OPTION = typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")


@functools.cache
def command_line(chosen: str = "") -> typer.Typer:
    """Return the command line.

    If a verb is chosen, only its options are built, because other verbs need more imports.
    """
    keys = {"help_option_names": ["-h", "--help"]}
    line = typer.Typer(context_settings=keys, no_args_is_help=True, pretty_exceptions_enable=False)

    @line.callback()
    def main(version: Annotated[bool, VERSION_OPTION] = False) -> None:
        """Simulate coupled FMUs, compare them with measured logs, and find missing effects of a model."""

    for name, verb in () if chosen == "--version" else verbs(chosen):
        if verb.command and (command := attempt(name, verb.command)) is not None:
            run = _with_options(command, verb) if chosen in {"", name} else lambda: None
            text = re.sub(r"\nArgs:\n(.*?)\n(?=\w|\Z)", "\n", getdoc(command) or "", flags=re.DOTALL)
            line.command(name, help=text, rich_help_panel=verb.group or "Other packages")(run)
    return line


def entry() -> None:
    """Run the command line; an error of cosim becomes a message and an exit code instead of a traceback."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # a closed stream; a file opened later would get its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a terminal or file without UTF-8 cannot show a true minus sign
            stream.reconfigure(errors="backslashreplace")
    warnings.showwarning = lambda message, category, *place: warn(str(message))
    # of numpy, in trials of cosim that are rejected; warnings in the code of a user stay
    warnings.filterwarnings("ignore", category=RuntimeWarning, module=r"(cosim|numpy|scipy)\.")
    try:
        chosen = _verb_to_complete() if "_COSIM_COMPLETE" in os.environ else (*sys.argv[1:], "-h")[0]
        code = command_line(chosen)(standalone_mode=False) or 0
    except CosimError as error:
        code = say_error(error)
    except (MemoryError, Terminated) as error:
        text = str(error) or "not enough memory; use a shorter duration, longer steps, or record fewer signals"
        code = say_error(CosimError(text), SimulationError.exit_code)
        if isinstance(error, Terminated):
            AT_THE_END.clear()  # no page is served after the end that was asked for
    except OSError as error:  # an unwritable folder, or a full disk
        text = "the disk is full" if is_full(error) else error.strerror or str(error)
        text = f"{error.filename}: {text}" if error.filename else text
        code = say_error(CosimError(text), SimulationError.exit_code if is_full(error) else 2)
    except typer.Abort:
        code = say_error(CosimError("the input ended at a prompt; run the command on a terminal"))
    except Exception as error:
        # Depending on its version, Typer has its own classes or those of click.
        if not hasattr(error, "format_message"):
            raise
        error.show()  # type: ignore[attr-defined]
        if "--json" in sys.argv:
            fault = {"kind": "UsageError", "file": None, "line": 0, "column": 0, "message": error.format_message()}
            say_json({"error": fault["message"], "kind": "UsageError", "exit_code": 2, "faults": [fault]})
        code = 2
    finally:
        with suppress(KeyboardInterrupt, Terminated):
            while AT_THE_END:
                AT_THE_END.pop()()
    sys.exit(code)
