"""`cosim report`: write the report of a run again."""

from __future__ import annotations

from pathlib import Path

from cosim.verbs.terminal import say, say_json, show, warn


def command(folder: Path, *, figures: bool = False, open: bool = False, json: bool = False) -> None:
    """Write the report of a run again from its results.

    Args:
        folder: Folder of a run.

    Example: cosim report results/one --open
    """
    from cosim.simulation.run_files import report_of

    page = report_of(folder, figures=figures, tell=warn)
    say(f"report:  {page}")
    if json:
        say_json({"report": str(page)})
    show(page, open)
