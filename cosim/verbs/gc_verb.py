"""`cosim gc`: removal of earlier runs."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from cosim.base.errors import InputError, refuse
from cosim.base.text import counted
from cosim.storage.folders import RESULTS
from cosim.verbs.options import Json, ResultsFolder, Texts
from cosim.verbs.terminal import say, say_json, some, warn

if TYPE_CHECKING:
    from cosim.history.entries import Entry
    from cosim.history.selection import Removal

MOST_NAMES = 10
UNITS = ("B", "kB", "MB", "GB", "TB")


def command(
    names: Annotated[
        Texts, typer.Argument(metavar="[RUN]", help="Numbers, names or patterns such as 'tank/*' (default: all).")
    ] = None,
    keep: Annotated[int, typer.Option("--keep", min=0, help="Earlier runs of each name that stay.")] = 0,
    older: Annotated[float, typer.Option("--older", min=0.0, help="Remove runs older than this number of days.")] = 0.0,
    results: ResultsFolder = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Remove without a question.")] = False,
    as_json: Json = False,
) -> None:
    """Remove earlier runs; the newest results of each name stay.

    Says how much it would remove, and asks.

    Example: cosim gc --keep 5
    """
    from cosim.history.entries import entries
    from cosim.history.selection import Removal, find_entries, plan_removal, remove

    root = results or RESULTS
    chosen = find_entries(names, root)
    plan = plan_removal(entries(root), keep=keep, older=older, chosen=chosen)
    warn(*(text for entry in chosen for text in entry.warnings))
    planned = [entry.name for entry in plan.entries]
    if planned:
        say(f"to remove: {_amount(plan)}: {some(planned, MOST_NAMES)}")
        if not yes:
            if as_json or not sys.stdin.isatty():
                raise InputError.at(root, "nothing is removed without an answer; add --yes")
            if not typer.confirm("Remove?"):
                planned = []
    done = remove(plan.entries) if planned else Removal((), 0)
    warn(*done.warnings)
    nothing = "nothing is removed" if plan.entries else f"nothing is removed: {_reason(chosen, named=bool(names))}"
    say(f"removed: {_amount(done)}" if done.entries else nothing)
    if as_json:
        say_json({"removed": [entry.name for entry in done.entries], "bytes": done.size})
    refuse(done.faults)


def _amount(removal: Removal) -> str:
    return f"{counted(len(removal.entries), 'earlier run')}, {_size(removal.size)}"


def _reason(chosen: Sequence[Entry], *, named: bool) -> str:
    """Return why no run is removed."""
    if not named or not chosen or not all(entry.is_newest for entry in chosen):
        return "no earlier run is among these results"
    names = " ".join(shlex.quote(f"{entry.of}/*") for entry in chosen)
    return f"the newest results of a name stay; name its earlier runs as {names}"


def _size(count: float) -> str:
    """Return a number of bytes as text."""
    for unit in UNITS[:-1]:
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} {UNITS[-1]}"
