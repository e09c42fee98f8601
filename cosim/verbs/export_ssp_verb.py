"""`cosim export-ssp`: write a scenario as an SSP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.options import Json, Nearest, Overrides
from cosim.verbs.terminal import say, say_json, say_note


def command(
    scenario: Annotated[Path, typer.Argument(help="A scenario.yaml, or the manifest.json of a run.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The file to write; without, NAME.ssp in this folder.")
    ] = None,
    set_: Overrides = None,
    nearest: Nearest = False,
    as_json: Json = False,
) -> None:
    """Write a scenario as an SSP 1.0 that other simulators run: noise off, references as FMUs."""
    from cosim.authoring.export import export_ssp

    exported = export_ssp(scenario, out, tuple(set_ or ()), nearest=nearest)
    for note in exported.notes:
        say_note(note)
    say(f"wrote {exported.path}")
    if as_json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})
