"""`cosim graph`: draw a scenario."""

from __future__ import annotations

from pathlib import Path

from cosim.base.errors import InputError
from cosim.verbs.terminal import echo, say, say_json, show


def command(
    scenario: Path,
    *,
    out: Path | None = None,
    mermaid: bool = False,
    set: list[str] | None = None,
    open: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Draw the components and connections of a scenario.

    The picture shows the order of steps, signals, units, noise and faults.

    Args:
        scenario: A scenario, an SSP, or the manifest.json of a run.
        out: Picture: FILE.svg, or FILE.mmd for Mermaid (default: NAME.svg).
        mermaid: Print the picture as Mermaid text and write no file.
        set (PATH=VALUE): Replace a value of the scenario, for example noise=off.
        force: Overwrite a file that is not a picture of this scenario.

    Example: cosim graph scenario.yaml
    """
    from cosim.authoring.graph import check_picture, graph_of
    from cosim.storage.files import write_text

    graph = graph_of(scenario, set or ())
    if mermaid:
        say_json({"mermaid": graph.mermaid()}) if json else echo(graph.mermaid(), nl=False)
        return
    path = Path(f"{scenario.stem}.svg") if out is None else out
    if not path.parent.is_dir():
        raise InputError.at(path, "its folder is not there; make it first")
    if path.suffix.lower() not in (".svg", ".mmd"):
        raise InputError.at(path, "name an .svg or .mmd file")
    if not force:
        check_picture(path, graph)
    write_text(path, graph.mermaid() if path.suffix.lower() == ".mmd" else graph.svg())
    say(f"graph: {path}")
    if json:
        say_json({"graph": str(path)})
    show(path, open)
