"""Commands, but for the first of them; `cosim.verbs.cli` takes them all by `register`."""

from __future__ import annotations

import typer

from cosim.base.registry import attempt, extensions
from cosim.verbs import consistency_verb as consistency
from cosim.verbs import fmus, linear, logs, pictures, runs, sweep
from cosim.verbs.manner import with_manner


def register(app: typer.Typer) -> None:
    """Add the commands of this room, and to every command there is -q and -v."""
    for module in (logs, fmus, runs, pictures, linear, consistency, sweep):
        module.register(app)
    for name, extension in extensions():
        if extension.command and (add := attempt(name, extension.command)) is not None:
            add(app)
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = with_manner(command.callback)
