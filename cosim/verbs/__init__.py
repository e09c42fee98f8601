"""Commands for own FMUs and for what runs leave; `cosim.cli` takes them all by `register`."""

from __future__ import annotations

import typer

from cosim.verbs import files, fmus, runs


def register(app: typer.Typer) -> None:
    """Add the commands of this room to the command line."""
    for module in (fmus, runs, files):
        module.register(app)
