"""Options that every command has: how much it says."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from typer.models import OptionInfo

from cosim.storage.files import NOT_BLANK
from cosim.verbs.terminal import MANNER

Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Say nothing but warnings, errors and JSON that is asked for.")
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more, such as the order of steps and times.")]


def _refuse_blank(hint: Any) -> None:
    """Have the option --out refuse a blank, which as a path would be the current folder."""
    for option in get_args(hint):
        if isinstance(option, OptionInfo):
            option.parser, option.metavar = _out_path, "PATH"


def _out_path(value: Any) -> Path:
    if not str(value).strip():
        raise typer.BadParameter(f"is blank; {NOT_BLANK}")
    return Path(value)


def with_manner(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command with -q and -v beside its own options."""

    @wraps(command)
    def told(*given: Any, quiet: bool = False, verbose: bool = False, **options: Any) -> Any:
        MANNER.quiet, MANNER.verbose = quiet, verbose
        MANNER.as_json, MANNER.told = bool(options.get("as_json")), False
        return command(*given, **options)

    kind = inspect.Parameter.KEYWORD_ONLY
    more = {"quiet": Quiet, "verbose": Verbose}
    added = [inspect.Parameter(name, kind, default=False, annotation=option) for name, option in more.items()]
    hints = {**get_type_hints(command, include_extras=True), **more}
    _refuse_blank(hints.get("out"))
    own = [
        p.replace(annotation=hints.get(p.name, p.annotation)) for p in inspect.signature(command).parameters.values()
    ]
    told.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
    told.__annotations__ = hints
    return told
