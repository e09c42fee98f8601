"""`cosim graph`: draw a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.base.errors import Fault, InputError
from cosim.verbs.options import Json, Open, Overrides
from cosim.verbs.streams import echo
from cosim.verbs.terminal import say, say_json, show


def command(
    scenario: Annotated[Path, typer.Argument(help="A scenario.yaml, an SSP, or the manifest.json of a run.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The SVG to write, or .mmd for mermaid; NAME.svg of the file without."),
    ] = None,
    mermaid: Annotated[
        bool, typer.Option("--mermaid", help="Print mermaid, for a document, and write no file.")
    ] = False,
    set_: Overrides = None,
    open_: Open = False,
    force: Annotated[bool, typer.Option("--force", help="Also over a file that is no picture of it.")] = False,
    as_json: Json = False,
) -> None:
    """Draw a scenario: components in the order in which they step, signals, units, noise and faults."""
    from cosim.authoring.graph import check_picture, graph_of
    from cosim.storage.files import write_text

    found = graph_of(scenario, set_ or ())
    if mermaid:
        say_json({"mermaid": found.mermaid()}) if as_json else echo(found.mermaid(), nl=False)
        return
    path = Path(f"{scenario.stem}.svg") if out is None else out
    if not path.parent.is_dir() or path.suffix.lower() not in (".svg", ".mmd"):
        why = "name an .svg or .mmd file" if path.parent.is_dir() else "its folder is not there; make it first"
        raise InputError([Fault(path, 0, 0, why)])
    if not force:
        check_picture(path, found)
    write_text(path, found.mermaid() if path.suffix.lower() == ".mmd" else found.svg())
    say(f"graph: {path}")
    if as_json:
        say_json({"graph": str(path)})
    show(path, asked=open_)
