"""`cosim export-ssp`: write a scenario as an SSP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.verbs.options import Json, Nearest, Overrides
from cosim.verbs.terminal import say, say_json, say_note


def command(
    scenario: Annotated[Path, typer.Argument(help="A scenario, or the manifest.json of a run.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="SSP file (default: NAME.ssp in the current folder).")
    ] = None,
    set_: Overrides = None,
    nearest: Nearest = False,
    as_json: Json = False,
) -> None:
    """Write a scenario as an SSP 1.0 for other simulators.

    Noise is off; references become FMUs.

    Example: cosim export-ssp scenario.yaml --out system.ssp
    """
    from cosim.authoring.export import export_ssp

    exported = export_ssp(scenario, out, tuple(set_ or ()), nearest=nearest)
    say_note(*exported.notes)
    say(f"wrote {exported.path}")
    if as_json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})
