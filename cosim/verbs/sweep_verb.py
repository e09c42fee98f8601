"""`cosim sweep`: many runs of one scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cosim.core.settings import Port
from cosim.verbs.cli import live_page, progress_bar, say, say_json, show, warn


def command(
    *, live: bool = False, port: Port | None = None, open: bool = False, json: bool = False, **given: Any
) -> None:
    """Run a scenario many times with varied values.

    Writes sweep.parquet, sweep.json and report.html.

    Args:
        path (SWEEP): A sweep file: a scenario and the values that vary.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the sweep).
        dask (ADDRESS): Address of a Dask scheduler, for example tcp://host:8786.
        resume: Go on with the stopped sweep in --out (default: the newest).
        part (K/N): Make the K-th of N parts of the runs, in a folder given by --out.

    Example: cosim sweep sweep.yaml --workers 4
    """
    from cosim.sweeps.workflow import sweep

    title = Path(given["path"]).stem
    with progress_bar("sweeping") as progress, live_page("LiveSweep", title, live=live, port=port) as page:
        swept = sweep(**given, progress=progress, observers=() if page is None else (page,))
        report = swept.folder / "report.html"
        if page is not None:
            page.report = report
    warn(*swept.sweep.warnings)
    if json:
        say_json({**{k: v for k, v in swept.record.items() if k != "scenario"}, "made": swept.made})
    say(*swept.sentences)
    if swept.made < swept.record["runs"]:
        say(f"new runs: {swept.made}, from before: {swept.record['runs'] - swept.made}")
    if given["part"]:
        say(f"part:   {swept.folder}")
        return
    say(f"runs:   {swept.folder / 'sweep.parquet'}")
    if given["report"]:
        say(f"report: {report}")
    show(report, open)
