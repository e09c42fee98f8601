"""Options that every command has, and placeholders of option values by their type."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from typer.models import OptionInfo

from cosim.storage.files import NOT_BLANK
from cosim.verbs.terminal import MANNER

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only warnings, errors and JSON.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print more, such as the order of steps and timings.")]
PLACEHOLDERS = {int: "INTEGER", float: "NUMBER", Path: "PATH", str: "TEXT", list[str]: "TEXT"}


def _refuse_blank(hint: Any) -> None:
    """Let the option --out refuse a blank, which as a path would be the current folder."""
    for option in get_args(hint):
        if isinstance(option, OptionInfo):
            option.parser, option.metavar = _out_path, "PATH"


def _set_placeholders(hints: Iterable[Any]) -> None:
    """Set missing placeholders of options by value type."""
    for hint in hints:
        for option in get_args(hint):
            if isinstance(option, OptionInfo) and option.metavar is None:
                types = {get_args(hint)[0], *get_args(get_args(hint)[0])}
                option.metavar = next((word for kind, word in PLACEHOLDERS.items() if kind in types), None)


def _out_path(value: Any) -> Path:
    if not str(value).strip():
        raise typer.BadParameter(f"is blank; {NOT_BLANK}")
    return Path(value)


def with_manner(command: Callable[..., Any]) -> Callable[..., None]:
    """Return a command that also has the options -q and -v; it returns nothing, which is exit code 0."""

    @wraps(command)
    def run(*arguments: Any, quiet: bool = False, verbose: bool = False, **options: Any) -> None:
        MANNER.quiet, MANNER.verbose = quiet, verbose
        MANNER.as_json, MANNER.has_json = bool(options.get("as_json")), False
        MANNER.messages.clear()
        command(*arguments, **options)

    kind = inspect.Parameter.KEYWORD_ONLY
    more = {"quiet": Quiet, "verbose": Verbose}
    added = [inspect.Parameter(name, kind, default=False, annotation=option) for name, option in more.items()]
    hints = {**get_type_hints(command, include_extras=True), **more}
    _refuse_blank(hints.get("out"))
    _set_placeholders(hints.values())
    own = [
        p.replace(annotation=hints.get(p.name, p.annotation)) for p in inspect.signature(command).parameters.values()
    ]
    run.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
    run.__annotations__ = hints
    return run
