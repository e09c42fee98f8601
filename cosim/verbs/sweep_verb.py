"""`cosim sweep`: many runs of one scenario."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.options import Force, Json, Live, Open, Port, Report, live_page, out_option
from cosim.verbs.terminal import progress_bar, say, say_json, say_more, show, warn

LINE_INTERVAL = 10.0  # [s] between lines with -v


def command(
    study: Annotated[Path, typer.Argument(metavar="SWEEP", help="A sweep file: a scenario and the values that vary.")],
    *,
    out: Annotated[Path | None, out_option("a new number in results/NAME of the sweep")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of worker processes (default: one per core).")
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option("--dask", metavar="ADDRESS", help="Address of a Dask scheduler, for example tcp://host:8786."),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option("--part", metavar="K/N", help="Make the K-th of N parts of the runs, in a folder given by --out."),
    ] = None,
    join: Annotated[bool, typer.Option("--join", help="Make table and report of all parts.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the stopped sweep in --out (default: the newest).")
    ] = False,
    report: Report = True,
    open_: Open = False,
    force: Force = False,
    as_json: Json = False,
    live: Live = False,
    port: Port = None,
) -> None:
    """Run a scenario many times with varied values.

    Writes sweep.parquet, sweep.json and report.html.

    Example: cosim sweep sweep.yaml --workers 4
    """
    from cosim.sweeps.workflow import sweep as run_sweep

    with _progress() as progress, live_page("sweep", study.stem, live=live, port=port) as page:
        observers = () if page is None else (page,)
        make = partial(run_sweep, workers=workers, dask=dask, progress=progress, observers=observers)
        swept = make(study, out, part=part, join=join, resume=resume, report=report, force=force)
        if page is not None:
            page.report = swept.folder / "report.html"
    warn(*swept.sweep.warnings)
    if as_json:
        say_json({**{k: v for k, v in swept.record.items() if k != "scenario"}, "made": swept.made})
    else:
        say(*swept.sentences)
        if swept.made < swept.record["runs"]:
            say(f"made now: {swept.made}, there before: {swept.record['runs'] - swept.made}")
        if part:
            say(f"part:   {swept.folder}")
            return
        say(f"runs:   {swept.folder / 'sweep.parquet'}")
        if report:
            say(f"report: {swept.folder / 'report.html'}")
    show(swept.folder / "report.html", open_=report and open_ and not part)


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on a terminal; with -v, lines elsewhere."""
    with progress_bar("sweeping") as bar:
        printed = -LINE_INTERVAL

        def advance(done: int, total: int) -> None:
            nonlocal printed
            if bar is not None:
                bar(done, total)
            if time.monotonic() - printed >= LINE_INTERVAL or done == total:
                say_more(f"{done} of {total} runs")
                printed = time.monotonic()

        yield advance
