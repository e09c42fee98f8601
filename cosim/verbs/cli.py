"""Command line of all verbs; errors become messages and exit codes."""

from __future__ import annotations

import gc
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, NoReturn, get_type_hints

import typer

from cosim.base.drafts import is_full
from cosim.base.errors import CosimError, SimulationError, Terminated
from cosim.base.garbage import collect_seldom
from cosim.base.program import as_program
from cosim.base.registry import ExtensionWarning, attempt
from cosim.base.version import __version__
from cosim.storage.files import check_text
from cosim.verbs import VERBS, verbs
from cosim.verbs.outcome import say_partial
from cosim.verbs.streams import open_streams
from cosim.verbs.terminal import LAST, MANNER, say, say_error, say_failure, say_usage, warn

VERSION = "--version"  # needs no verb
MANNERS = ("quiet", "verbose")
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

    hints = {**get_type_hints(command, include_extras=True), "quiet": Quiet, "verbose": Verbose}
    own = [p.replace(annotation=hints.get(p.name, p.annotation)) for p in signature(command).parameters.values()]
    added = [Parameter(name, Parameter.KEYWORD_ONLY, default=False, annotation=hints[name]) for name in MANNERS]
    run.__signature__ = Signature([*own, *added])  # type: ignore[attr-defined]
    run.__annotations__ = hints
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
    open_streams()
    collecting = collect_seldom()
    try:
        with _terminable():
            try:
                _run()
            finally:
                while LAST:
                    LAST.pop()()
    finally:
        gc.set_threshold(*collecting)


def _run() -> None:
    """Run the command of this process; exit with its code."""
    try:
        check_text([*sys.argv[1:], *_current_folder(), os.environ.get("TMPDIR", "")])
        _register(only=sys.argv[1] if len(sys.argv) > 1 else "")
        sys.exit(_app(standalone_mode=False) or 0)
    except CosimError as error:
        say_error(error)
        say_failure(error)
        if isinstance(error, SimulationError) and error.left is not None:
            say_partial(error.left)
        sys.exit(error.exit_code)
    except Terminated as end:
        _fail(str(end), end.exit_code)
    except MemoryError:
        _fail(
            "there is not enough memory; run shorter, in longer steps or with less recorded", SimulationError.exit_code
        )
    except OSError as error:  # a folder that cannot be written, a disk that is full
        _fail_on_file(error)
    except typer.Abort:
        _fail("the input ended at a prompt; run it on a terminal", CosimError.exit_code)
    except Exception as error:
        if not hasattr(error, "format_message"):  # Typer has classes of its own or those of click, by its version.
            raise
        sys.exit(say_usage(error))


def _fail_on_file(error: OSError) -> NoReturn:
    """Print which file cannot be read or written and why, and exit."""
    file = f"{error.filename}: " if error.filename else ""
    if is_full(error):
        _fail(f"{file}the disk is full", SimulationError.exit_code)
    _fail(f"{file}{error.strerror or error}", 2)


def _fail(message: str, exit_code: int) -> NoReturn:
    """Print an error, with --json also as JSON, and exit."""
    error = CosimError(message)
    error.exit_code = exit_code
    say_error(error)
    with suppress(OSError):  # stdout may be on the disk that is full
        say_failure(error)
    sys.exit(exit_code)


@contextmanager
def _terminable() -> Iterator[None]:
    """Raise Terminated at the first signal to end the process, so that unfinished files are removed."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    received: list[int] = []

    def terminate(number: int, frame: object) -> None:
        received.append(number)
        if len(received) == 1:
            raise Terminated(signal.Signals(number).name)

    for number, handler in before.items():
        if handler != signal.SIG_IGN:  # nohup
            signal.signal(number, terminate)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def _current_folder() -> list[str]:
    """Return the current folder as a list, empty if the folder was removed."""
    try:
        return [os.getcwd()]
    except OSError:
        return []


if __name__ == "__main__":
    as_program(entry)
