"""`cosim gc`: removal of earlier runs."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from cosim.core.errors import InputError, refuse
from cosim.core.settings import NotNegative, Whole
from cosim.core.text import counted, some
from cosim.files.folders import RESULTS
from cosim.verbs.cli import say, say_json, warn

if TYPE_CHECKING:
    from cosim.files.run_entries import Removal

MOST_NAMES = 10


def command(
    names: list[str] | None = None,
    *,
    keep: Whole = 0,
    older: NotNegative = 0.0,
    results: Path | None = None,
    yes: bool = False,
    json: bool = False,
) -> None:
    """Remove earlier runs; the newest results of each name stay.

    Says how much it would remove, and asks.

    Args:
        names ([RUN]): Numbers, names or patterns such as 'tank/*' (default: all).
        keep (NUMBER): Earlier runs of each name that stay.
        older (DAYS): Remove runs older than this number of days.
        yes (--yes -y): Remove without a question.

    Example: cosim gc --keep 5
    """
    from cosim.files.run_entries import Removal, entries, find_entries, plan_removal, remove

    root = results or RESULTS
    chosen = find_entries(names, root)
    plan = plan_removal(entries(root), keep=keep, older=older, chosen=chosen)
    warn(*(text for entry in chosen for text in entry.warnings))
    planned = [entry.name for entry in plan.entries]
    if planned:
        say(f"to remove: {_amount(plan)}: {some(planned, MOST_NAMES)}")
        if not yes:
            if json or not sys.stdin.isatty():
                raise InputError.at(root, "nothing is removed without an answer; add --yes")
            if not typer.confirm("Remove?"):
                planned = []
    done = remove(plan.entries) if planned else Removal((), 0)
    warn(*done.warnings)
    reason = ""
    if not plan.entries:
        reason = ": no earlier run is among these results"
        if names and chosen and all(entry.is_newest for entry in chosen):
            earlier = " ".join(shlex.quote(f"{entry.of}/*") for entry in chosen)
            reason = f": the newest results of a name stay; name its earlier runs as {earlier}"
    say(f"removed: {_amount(done)}" if done.entries else f"nothing is removed{reason}")
    if json:
        say_json({"removed": [entry.name for entry in done.entries], "bytes": done.size})
    refuse(done.faults)


def _amount(removal: Removal) -> str:
    """Return a number of runs and their size as text."""
    from rich.filesize import decimal

    return f"{counted(len(removal.entries), 'earlier run')}, {decimal(removal.size)}"
