"""`cosim export-ssp`: write a scenario as an SSP."""

from __future__ import annotations

from typing import Any

from cosim.core.messages import Note
from cosim.verbs.cli import say, say_json, warn


def command(*, json: bool = False, **given: Any) -> None:
    """Write a scenario as an SSP 1.0 for other simulators.

    Noise is off; references become FMUs.

    Args:
        path (--out -o PATH): SSP file (default: NAME.ssp in the current folder).
        overrides (--set PATH=VALUE): Replace a value of the scenario, for example noise=off.

    Example: cosim export-ssp scenario.yaml --out system.ssp
    """
    from cosim.authoring.export import export_ssp

    exported = export_ssp(**given)
    warn(*map(Note, exported.notes))
    say(f"wrote {exported.path}")
    if json:
        say_json({"ssp": str(exported.path), "notes": list(exported.notes)})
