"""`cosim list`: the results that are there."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.storage.folders import RESULTS
from cosim.verbs.options import Json, ResultsFolder, Texts
from cosim.verbs.terminal import say, say_json, table, warn

if TYPE_CHECKING:
    from cosim.history.entries import Entry

WIDEST = 60  # characters of an outcome, and of the changes


def command(
    names: Annotated[
        Texts, typer.Argument(metavar="[RUN]", help="Numbers, names or patterns such as 'tank/*' (default: all).")
    ] = None,
    results: ResultsFolder = None,
    as_json: Json = False,
) -> None:
    """List results: when, what, criteria, and the inputs that changed.

    Example: cosim list 'tank*'
    """
    from cosim.history.selection import find_entries

    root = results or RESULTS
    found = find_entries(names, root)
    warn(*(text for entry in found for text in entry.warnings))
    if as_json:
        say_json({"results": [_as_json(entry) for entry in found]})
        return
    if not found:
        say(f"no results in {root}")
        return
    rows = [(str(e.number), _when(e), e.verb, e.name, _cut(e.outcome), _cut(e.changed), e.version) for e in found]
    heads = ("no.", "when", "command", "name", "outcome", "changed", "of cosim")
    say("\n".join(table(heads, rows)))  # a write for all lines


def _when(entry: Entry) -> str:
    return datetime.fromtimestamp(entry.time).strftime("%Y-%m-%d %H:%M")


def _cut(text: str) -> str:
    return text if len(text) <= WIDEST else f"{text[: WIDEST - 1]}…"


def _as_json(entry: Entry) -> dict[str, Any]:
    when = datetime.fromtimestamp(entry.time).astimezone().isoformat(timespec="seconds")
    content = {"number": entry.number, "name": entry.name, "folder": str(entry.folder), "command": entry.verb}
    about = {"outcome": entry.outcome, "changes": dict(entry.changes), "other_version": entry.version or None}
    return {**content, "time": when, **about, "warnings": [*entry.warnings]}
