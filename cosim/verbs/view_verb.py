"""`cosim view`: a signal browser for any number of runs."""

from __future__ import annotations

from pathlib import Path

from cosim.core.settings import Port
from cosim.core.text import counted, some
from cosim.files.folders import RESULTS
from cosim.verbs.cli import progress_bar, say, say_json, show_page, warn

MOST_NAMES = 5
LAYOUTS = "view.json"
GRACE = 10.0  # [s] without a page until the command ends


def command(
    runs: list[str] | None = None,
    *,
    results: Path | None = None,
    layout: Path | None = None,
    port: Port = 0,
    browser: bool = True,
    prepare: bool = False,
    json: bool = False,
) -> None:
    """Browse the signals of runs in one page of this machine.

    Args:
        runs ([RUN]): Numbers, names or patterns of results, folders, or tables of rows (default: the newest results).
        layout: File of saved layouts (default: view.json in the folder of results).
        port: Port of the page (0: any).
        browser: Open the page, or print its address only.
        prepare: Convert large tables, and end without a page.

    Example: cosim view 'tank*'
    """
    from cosim.pages.layouts import Layouts
    from cosim.pages.runs import find_runs, open_runs
    from cosim.pages.view_page import view_page

    root = results or RESULTS
    layouts = Layouts(layout or root / LAYOUTS)
    places, notes = find_runs(runs or (), root)
    opened, warnings = open_runs(places, progress_bar)
    warn(*notes, *warnings)
    labels = [run.place.label for run in opened]
    signals, rows = sum(len({*r.rows.units, *r.rows.texts}) for r in opened), sum(r.rows.rows for r in opened)
    amounts = counted(len(opened), "run"), counted(signals, "signal"), counted(rows, "row")
    say(f"{', '.join(amounts)}: {some(labels, MOST_NAMES)}")
    about = {"runs": [{"name": r.place.name, "file": str(r.place.file), "rows": r.rows.rows} for r in opened]}
    if prepare:
        if json:
            say_json(about)
        return
    title = labels[0] if len(labels) == 1 else counted(len(labels), "run")
    page = view_page(title, opened, layouts, port, notes=[*notes, *warnings])
    if json:
        say_json({"url": page.url, **about})
    show_page(page, "signals", title, float("inf"), GRACE, opens=browser)
