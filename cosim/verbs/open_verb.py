"""`cosim open`: the report of results in a browser."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from cosim.base.errors import InputError
from cosim.storage.folders import RESULTS
from cosim.verbs.options import Json, ResultsFolder
from cosim.verbs.terminal import say, say_json, show, some, warn

PAGE = "report.html"
MOST_NAMES = 5


def command(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Number, name or pattern of results, or their folder.")],
    results: ResultsFolder = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, or print its path only.")
    ] = True,
    as_json: Json = False,
) -> None:
    """Open the report of results in a browser.

    Example: cosim open 3
    """
    from cosim.history.entries import RUNNING, UNKNOWN, named_entries
    from cosim.storage.artefact import folder_kind
    from cosim.storage.folders import content_of, warnings_on
    from cosim.storage.started import KILLED

    folder, verb, outcome, record = Path(run), "", "", Path(run) / "manifest.json"
    warnings: tuple[str, ...] = ()
    if found := named_entries(run, results or RESULTS):
        if len(found) > 1:
            names = some([f"{e.number} {e.name}" for e in found], MOST_NAMES)
            raise InputError.at(Path(run), f"{len(found)} results match: {names}; name one")
        (entry,) = found
        folder, verb, outcome = entry.folder, entry.verb, entry.outcome
        record, warnings = entry.record, entry.warnings
    page = folder / PAGE
    if not page.is_file():
        if outcome == KILLED:
            raise InputError.at(folder, "has no report.html, because its command was killed; run it again")
        if outcome in {RUNNING, UNKNOWN}:
            raise InputError.at(folder, "has no report.html yet, because its command has not ended")
        if folder_kind(folder) is None:
            raise InputError.at(
                folder, "holds no results of a command; give a number, a name or a folder in `cosim list`"
            )
        if record.suffix == ".json" and record.is_file() and not content_of(record):
            raise InputError.at(folder, "has no report.html, and its record is damaged: run the command again")
        cure = (
            f"`cosim report {shlex.quote(str(folder))}` writes it"
            if verb in {"run", "simulate", ""}
            else "run the command again with a report"
        )
        raise InputError.at(folder, f"has no report.html; {cure}")
    warn(*dict.fromkeys((*warnings_on(folder), *warnings)))
    say(f"report: {page}")
    if as_json:
        say_json({"report": str(page)})
    show(page, open_=browser)
