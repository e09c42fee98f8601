"""`cosim open`: the report of results in a browser."""

from __future__ import annotations

import shlex
from pathlib import Path

from cosim.core.errors import InputError
from cosim.core.text import some
from cosim.files.folders import RESULTS
from cosim.verbs.cli import say, say_json, show, warn

PAGE = "report.html"
MOST_NAMES = 5


def command(run: str | None = None, *, results: Path | None = None, browser: bool = True, json: bool = False) -> None:
    """Open the report of results in a browser.

    Args:
        run ([RUN]): Number, name or pattern of results, or their folder (default: the newest results).
        browser: Open the page, or print its path only.

    Example: cosim open 3
    """
    from cosim.files.folders import has_results, state_of, warnings_on
    from cosim.files.run_entries import Selected, entries, select_groups

    root = results or RESULTS
    found = [Selected(e.folder, e) for e in entries(root)[-1:]] if run is None else select_groups([run], root)[0]
    if not found:
        text = "no results here; run a command without --out first, or name their folder as --results"
        raise InputError.at(root, text)
    if len(found) > 1:
        names = some([f"{s.entry.number} {s.entry.name}" for s in found if s.entry is not None], MOST_NAMES)
        raise InputError.at(Path(run or ""), f"{len(found)} results match: {names}; name one")
    folder, entry = found[0].path, found[0].entry
    page = folder / PAGE
    if not page.is_file():
        if not has_results(folder):
            reason = "holds no results of a command; give a number, a name or a folder in `cosim list`"
            raise InputError.at(folder, reason)
        if state := state_of(folder):
            raise InputError.at(folder, f"has no report.html: its command is {state}; `cosim list` shows the state")
        of_run = entry.verb in {"run", "simulate", ""} if entry is not None else (folder / "manifest.json").is_file()
        report = f"`cosim report {shlex.quote(str(folder))}` writes it"
        cure = report if of_run else "run the command again with a report"
        raise InputError.at(folder, f"has no report.html; {cure}")
    warn(*dict.fromkeys((*warnings_on(folder), *(entry.warnings if entry is not None else ()))))
    say(f"report: {page}")
    if json:
        say_json({"report": str(page)})
    show(page, browser)
