"""Command line of all verbs; errors become messages and exit codes."""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, get_type_hints

import typer

from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, SimulationError, Terminated
from cosim.base.program import as_program
from cosim.base.registry import ExtensionWarning, attempt
from cosim.base.version import __version__
from cosim.storage.files import check_text
from cosim.verbs import VERBS, verbs
from cosim.verbs.terminal import LAST, MANNER, say, say_error, say_failure, say_usage, warn

VERSION = "--version"  # needs no verb
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only warnings, errors and JSON.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print more, such as the order of steps and timings.")]
_app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Simulate coupled FMUs, compare them with measured logs, and find missing effects of a model.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(value: bool) -> None:
    if value:
        say(f"cosim {__version__} (FMU co-simulation; not the command of the Open Simulation Platform)")
        raise typer.Exit


@_app.callback()
def main(
    version: Annotated[
        bool, typer.Option(VERSION, callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Define the options before the verb."""


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
    """Show a warning; a package that cannot be loaded is reported in one line."""
    if issubclass(category, ExtensionWarning):
        warn(message.args[0] if isinstance(message, Warning) else message)
    else:
        _python_shows(message, category, *place, **options)


_python_shows = warnings.showwarning
warnings.showwarning = _show_warning


def _register(*, only: str = "") -> None:
    """Register the commands of all verbs, or of one verb of cosim, so that the others need not be imported."""
    if only == VERSION:
        return
    for name, verb in verbs(only if only in VERBS and VERBS[only].command else ""):
        if verb.command and (command := attempt(name, verb.command)) is not None:
            _app.command(name, rich_help_panel=verb.group or "Other packages")(_with_manner(command))


def _with_manner(command: Callable[..., Any]) -> Callable[..., None]:
    """Return a command that also has the options -q and -v; it returns nothing, which is exit code 0."""

    @wraps(command)
    def run(*arguments: Any, quiet: bool = False, verbose: bool = False, **options: Any) -> None:
        MANNER.quiet, MANNER.verbose = quiet, verbose
        MANNER.as_json, MANNER.has_json = bool(options.get("as_json")), False
        MANNER.messages.clear()
        command(*arguments, **options)

    hints = get_type_hints(command, include_extras=True)
    own = [p.replace(annotation=hints.get(p.name, p.annotation)) for p in signature(command).parameters.values()]
    manners = {"quiet": Quiet, "verbose": Verbose}
    added = [Parameter(name, Parameter.KEYWORD_ONLY, default=False, annotation=kind) for name, kind in manners.items()]
    run.__signature__ = Signature([*own, *added])  # type: ignore[attr-defined]
    run.__annotations__ = {**hints, **manners}
    return run


def __getattr__(name: str) -> Any:
    """Return `app`, the command line with all verbs."""
    if name != "app":
        raise AttributeError(name)
    _register()
    globals()["app"] = _app
    return _app


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
        _register(only=sys.argv[1] if len(sys.argv) > 1 else "")
        return int(_app(standalone_mode=False) or 0)
    except (CosimError, Terminated, MemoryError, OSError, typer.Abort) as error:
        told = _as_cosim_error(error)
        say_error(told)
        with suppress(OSError):  # stdout may be on the disk that is full
            say_failure(told)
        return told.exit_code
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer has classes of its own or those of click, by its version.
            raise
        return say_usage(error)


def _as_cosim_error(error: BaseException) -> CosimError:
    if isinstance(error, CosimError):
        return error
    exit_code, message = SimulationError.exit_code, str(error)
    if isinstance(error, MemoryError):
        message = "there is not enough memory; run shorter, in longer steps or with less recorded"
    elif isinstance(error, OSError):  # a folder that cannot be written, a disk that is full
        file = f"{error.filename}: " if error.filename else ""
        message = file + ("the disk is full" if is_full(error) else error.strerror or message)
        exit_code = exit_code if is_full(error) else 2
    elif isinstance(error, typer.Abort):
        exit_code, message = CosimError.exit_code, "the input ended at a prompt; run it on a terminal"
    told = CosimError(message)
    told.exit_code = exit_code
    return told


if __name__ == "__main__":
    as_program(entry)
