"""Command line of all verbs; errors become messages and exit codes."""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from inspect import Signature, getdoc
from typing import Annotated, Any

import typer

from cosim.core.drafts import is_full
from cosim.core.errors import CosimError, SimulationError, Terminated
from cosim.core.program import as_program
from cosim.core.registry import ExtensionWarning, Verb, attempt
from cosim.core.version import __version__
from cosim.files.files import check_text
from cosim.verbs import VERBS, verbs
from cosim.verbs.options import ARGS, options_of
from cosim.verbs.terminal import LAST, MANNER, say, say_error, say_usage, warn

VERSION = "--version"  # needs no verb


def _show_version(value: bool) -> None:
    if value:
        say(f"cosim {__version__} (FMU co-simulation; not the command of the Open Simulation Platform)")
        raise typer.Exit


def main(
    version: Annotated[
        bool, typer.Option(VERSION, callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Define the options before the verb."""


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
    """Show a warning; a package that cannot be loaded is reported in one line."""
    if issubclass(category, ExtensionWarning):
        warn(str(message))
    else:
        _python_shows(message, category, *place, **options)


_python_shows = warnings.showwarning
warnings.showwarning = _show_warning


def _command_line(chosen: str = "") -> typer.Typer:
    """Return the command line with all verbs.

    Args:
        chosen: Only verb with options, because those of the others need imports; a verb of cosim is registered alone.
    """
    line = typer.Typer(
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Simulate coupled FMUs, compare them with measured logs, and find missing effects of a model.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )
    line.callback()(main)
    for name, verb in () if chosen == VERSION else verbs(chosen if chosen in VERBS and VERBS[chosen].command else ""):
        if verb.command and (command := attempt(name, verb.command)) is not None:
            run = _with_options(command, verb) if chosen in {"", name} else lambda: None
            text, group = ARGS.sub("\n", getdoc(command) or ""), verb.group or "Other packages"
            line.command(name, help=text, rich_help_panel=group)(run)
    return line


def _with_options(command: Callable[..., Any], verb: Verb) -> Callable[..., None]:
    """Return a command for Typer; it returns nothing, which is exit code 0."""

    def run(*, quiet: bool, verbose: bool, **options: Any) -> None:
        MANNER.quiet, MANNER.verbose = quiet, verbose
        MANNER.as_json, MANNER.has_json = bool(options.get("json")), False
        MANNER.messages.clear()
        command(**options)

    parameters = options_of(command, verb.function)
    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def __getattr__(name: str) -> Any:
    """Return `app`, the command line with all verbs."""
    if name != "app":
        raise AttributeError(name)
    globals()["app"] = app = _command_line()
    return app


def entry() -> None:
    """Run the command line; an error of cosim is a message and an exit code, not a traceback."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed; a file opened later would take its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal or file that is not UTF-8 has no true minus sign
            stream.reconfigure(errors="backslashreplace")
    try:
        sys.exit(_run())
    finally:
        while LAST:
            LAST.pop()()


def _run() -> int:
    """Run the command of this process; return its exit code."""
    try:
        with suppress(FileNotFoundError):  # the current folder may be removed
            check_text([os.getcwd()])
        check_text([*sys.argv[1:], os.environ.get("TMPDIR", "")])
        line = _command_line(sys.argv[1] if len(sys.argv) > 1 else "-h")
        return int(line(standalone_mode=False) or 0)
    except CosimError as error:
        return say_error(error)
    except MemoryError:
        text = "there is not enough memory; run shorter, in longer steps or with less recorded"
        return say_error(CosimError(text), SimulationError.exit_code)
    except OSError as error:  # a folder that cannot be written, a disk that is full
        file = f"{error.filename}: " if error.filename else ""
        text = file + ("the disk is full" if is_full(error) else error.strerror or str(error))
        return say_error(CosimError(text), SimulationError.exit_code if is_full(error) else 2)
    except Terminated as error:
        return say_error(CosimError(str(error)), SimulationError.exit_code)
    except typer.Abort:
        return say_error(CosimError("the input ended at a prompt; run it on a terminal"))
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer has classes of its own or those of click, by its version.
            raise
        return say_usage(error)


if __name__ == "__main__":
    as_program(entry)
