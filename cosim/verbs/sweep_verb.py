"""`cosim sweep`: many runs of one scenario."""

from __future__ import annotations

import time
from typing import Any

from cosim.core.settings import Port
from cosim.verbs.options import live_page
from cosim.verbs.terminal import progress_bar, say, say_json, say_more, show, warn

LINE_INTERVAL = 10.0  # [s] between lines with -v


def command(
    *, live: bool = False, port: Port | None = None, open: bool = False, json: bool = False, **given: Any
) -> None:
    """Run a scenario many times with varied values.

    Writes sweep.parquet, sweep.json and report.html.

    Args:
        path (SWEEP): A sweep file: a scenario and the values that vary.
        out: Folder for the results (default: a new number in results/NAME of the sweep).
        workers: Number of worker processes (default: one per core).
        dask (ADDRESS): Address of a Dask scheduler, for example tcp://host:8786.
        resume: Go on with the stopped sweep in --out (default: the newest).
        part (K/N): Make the K-th of N parts of the runs, in a folder given by --out.
        join: Make table and report of all parts.

    Example: cosim sweep sweep.yaml --workers 4
    """
    from cosim.sweeps.workflow import sweep

    printed = -LINE_INTERVAL
    title = given["path"].stem
    with progress_bar("sweeping") as bar, live_page("sweep", title, live=live, port=port) as page:

        def advance(done: int, total: int) -> None:
            """Move the progress bar on a terminal; with -v, print lines elsewhere."""
            nonlocal printed
            if bar is not None:
                bar(done, total)
            if time.monotonic() - printed >= LINE_INTERVAL or done == total:
                say_more(f"{done} of {total} runs")
                printed = time.monotonic()

        swept = sweep(**given, progress=advance, observers=() if page is None else (page,))
        report = swept.folder / "report.html"
        if page is not None:
            page.report = report
    warn(*swept.sweep.warnings)
    if json:
        say_json({**{k: v for k, v in swept.record.items() if k != "scenario"}, "made": swept.made})
    say(*swept.sentences)
    if swept.made < swept.record["runs"]:
        say(f"made now: {swept.made}, there before: {swept.record['runs'] - swept.made}")
    if given["part"]:
        say(f"part:   {swept.folder}")
        return
    say(f"runs:   {swept.folder / 'sweep.parquet'}")
    if given["report"]:
        say(f"report: {report}")
    show(report, open)
