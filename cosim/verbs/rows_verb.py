"""`cosim rows` and `cosim.rows`: count the rows of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.terminal import Force, Json, say, say_json


def command(
    run: Annotated[Path, typer.Argument(help="The folder that a run left, or a CSV with time first.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for rows.json; results/NAME-rows without.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Count the rows of a run."""
    from cosim.comparison.row_count import rows

    count = rows(run, out, force=force)
    say(f"rows: {count.rows}")
    if as_json:
        say_json({"rows": count.rows})
