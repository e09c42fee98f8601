"""`cosim report`: write the report of a run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.options import Json, Open
from cosim.verbs.terminal import say, say_json, show, warn


def command(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    figures: Annotated[bool, typer.Option("--figures", help="Write figures/*.png too.")] = False,
    open_: Open = False,
    as_json: Json = False,
) -> None:
    """Write the report of a run again from its results.

    Example: cosim report results/one --open
    """
    from cosim.simulation.run_files import report_of

    page = report_of(folder, figures=figures, tell=warn)
    say(f"report:  {page}")
    if as_json:
        say_json({"report": str(page)})
    show(page, open_=open_)
