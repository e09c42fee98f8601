"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from cosim.base.units import read_quantity


def out_option(default: str) -> Any:
    """Return the option --out of a command that leaves files in a folder."""
    return typer.Option("--out", "-o", help=f"Folder for what it leaves; {default} without.")


def seconds(text: str) -> float:
    """Return the time of an option in seconds: a number, or one with its unit, 4min."""
    try:
        return float(text)  # whether nan or inf will do is for the command to say
    except ValueError:
        pass
    try:
        return read_quantity(text, "s")
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: {error}") from None


def time_option(help_: str) -> Any:
    """Return an option that takes seconds, or a time with its unit."""
    return typer.Option(help=help_, parser=seconds, metavar="TIME")


Texts = list[str] | None
Json = Annotated[bool, typer.Option("--json", help="Print JSON, for a script.")]
Open = Annotated[bool, typer.Option("--open", help="Open the report in the browser.")]
Report = Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")]
Force = Annotated[bool, typer.Option("--force", help="Also into a folder that another run or command left.")]
InProcess = Annotated[
    bool, typer.Option("--in-process", help="Load the FMUs into this process, for a debugger; without limits.")
]
Compile = Annotated[
    bool, typer.Option("--compile", help="Compile and run the sources of FMUs that have no library for this machine.")
]
Format = Annotated[
    str, typer.Option("--format", help="Of the rows: csv, or parquet (extra parquet), or one of a package.")
]
Nearest = Annotated[
    bool, typer.Option("--nearest", help="Of each refine that the scenario names, what came nearest in it.")
]
Overrides = Annotated[Texts, typer.Option("--set", help="path=value, over the scenario's own; e.g. noise=off.")]
