"""`cosim list`: the results that are there."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from cosim.files.folders import RESULTS
from cosim.verbs.cli import say, say_json, table, warn

WIDEST = 60  # characters of an outcome, and of the changes


def command(names: list[str] | None = None, *, results: Path | None = None, json: bool = False) -> None:
    """List results: when, what, criteria, and the inputs that changed.

    Args:
        names ([RUN]): Numbers, names or patterns such as 'tank/*' (default: all).

    Example: cosim list 'tank*'
    """
    from cosim.files.run_entries import find_entries

    root = results or RESULTS
    found = [(entry, datetime.fromtimestamp(entry.time)) for entry in find_entries(names, root)]
    warn(*(text for entry, _ in found for text in entry.warnings))
    if json:
        say_json(
            {
                "results": [
                    {
                        "number": e.number,
                        "name": e.name,
                        "folder": str(e.folder),
                        "command": e.verb,
                        "time": when.astimezone().isoformat(timespec="seconds"),
                        "outcome": e.outcome,
                        "changes": dict(e.changes),
                        "other_version": e.version or None,
                        "warnings": [*e.warnings],
                    }
                    for e, when in found
                ]
            }
        )
    rows = []
    for e, when in found:
        outcome, changes = (t if len(t) <= WIDEST else f"{t[: WIDEST - 1]}…" for t in (e.outcome, e.changed))
        rows.append((str(e.number), f"{when:%Y-%m-%d %H:%M}", e.verb, e.name, outcome, changes, e.version))
    heads = ("no.", "when", "command", "name", "outcome", "changed", "of cosim")
    say("\n".join(table(heads, rows)) if rows else f"no results in {root}")  # a write for all lines
