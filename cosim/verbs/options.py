"""Options that several commands share, and the live page that --live asks for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.base.errors import Terminated
from cosim.base.messages import Note
from cosim.storage.files import NOT_BLANK
from cosim.verbs.terminal import LAST, say_finding, say_note


def out_option(default: str) -> Any:
    """Return the option --out for an output folder."""
    help_ = f"Folder for the results (default: {default})."
    return typer.Option("--out", "-o", help=help_, parser=_out_path, metavar="PATH")


def _out_path(value: Any) -> Path:
    """Refuse a blank name, which as a path would be the current folder."""
    if not str(value).strip():
        raise typer.BadParameter(f"is blank; {NOT_BLANK}")
    return Path(value)


def seconds(text: str) -> float:
    """Return the time of an option in seconds, from a number or a time with unit like 4min."""
    try:
        return float(text)  # whether nan or inf will do is for the command to say
    except ValueError:
        pass
    from cosim.base.units import read_quantity

    try:
        return read_quantity(text, "s")
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: {error}") from None


def time_option(help_: str) -> Any:
    """Return an option for seconds or time with unit."""
    return typer.Option(help=help_, parser=seconds, metavar="TIME")


Texts = list[str] | None
ResultsFolder = Annotated[Path | None, typer.Option("--results", help="Folder of results (default: results).")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Open = Annotated[bool, typer.Option("--open", help="Open the report in a browser.")]
Report = Annotated[bool, typer.Option("--report/--no-report", help="Write report.html, or do not.")]
Force = Annotated[
    bool, typer.Option("--force", help="Write even if the folder is not empty; results in it are replaced.")
]
InProcess = Annotated[
    bool,
    typer.Option(
        "--in-process", help="Load FMUs into the process of the command, for a debugger; limits do not apply."
    ),
]
Compile = Annotated[
    bool,
    typer.Option("--compile", help="Compile and execute the sources of FMUs that have no library for this machine."),
]
LimitsText = Annotated[
    str,
    typer.Option("--limits", help="Limits of time and memory, for example 'step: 10 s, total: 1 h, memory: 2 GB'."),
]
Format = Annotated[
    str,
    typer.Option(
        "--format", help="File format of the rows: csv, parquet, mat, hdf5, or a format of an installed package."
    ),
]
Nearest = Annotated[
    bool,
    typer.Option(
        "--nearest", help="Use nearest.yaml instead of model.yaml of every refine folder that the scenario names."
    ),
]
Overrides = Annotated[
    Texts, typer.Option("--set", metavar="PATH=VALUE", help="Replace a value of the scenario, for example noise=off.")
]
Live = Annotated[bool, typer.Option("--live", help="Open a page that shows the work while it goes on.")]
Port = Annotated[
    int | None,
    typer.Option("--port", min=0, max=65535, help="Port of the live page (default: any free port); implies --live."),
]


PAGES = {"run": "LiveRun", "sweep": "LiveSweep", "refine": "LiveRefine"}  # verb → class of its page


@contextmanager
def live_page(verb: str, title: str, *, live: bool, port: int | None, **settings: Any) -> Iterator[Any]:
    """Yield the live page of a verb, None without --live; keep it open until the user closes it."""
    if not live and port is None:
        yield None
        return
    from cosim.pages import work_pages
    from cosim.pages.server import open_page

    page = getattr(work_pages, PAGES[verb])(title, port or 0, **settings)
    LAST.append(lambda: _wait(page))
    is_open = open_page(page.url, title)
    (say_note if is_open else say_finding)(Note(f"live page: {page.url}"))
    with page:
        yield page


def _wait(page: Any) -> None:
    with suppress(KeyboardInterrupt, Terminated):  # The exit code is that of the work.
        page.wait_for_close(say_note)
