"""`cosim graph`: draw a scenario."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.errors import InputError
from cosim.files.files import FilePath
from cosim.verbs.cli import echo, say, say_json, show

if TYPE_CHECKING:
    from cosim.simulation.report.system_diagram import Graph

HEAD = 4096  # characters that contain the subject of a diagram
MERMAID = "flowchart LR\n  n1["
DIAGRAM = re.compile(
    r'\A<svg [^>]*class="diagram"[^>]* aria-label="\d+ components? of (.*?) in the order in which they step'
)


def command(
    scenario: Path,
    *,
    out: FilePath | None = None,
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
        out (--out -o PATH): Picture: FILE.svg, or FILE.mmd for Mermaid (default: NAME.svg).
        mermaid: Print the picture as Mermaid text and write no file.
        set (PATH=VALUE): Replace a value of the scenario, for example noise=off.
        force: Overwrite a file that is not a picture of this scenario.

    Example: cosim graph scenario.yaml
    """
    from cosim.files.files import write_text

    graph = graph_of(scenario, set or ())
    if mermaid:
        say_json({"mermaid": graph.mermaid()}) if json else echo(graph.mermaid().rstrip("\n"))
        return
    path = Path(f"{scenario.stem}.svg" if out is None else out)
    if not path.parent.is_dir():
        raise InputError.at(path, "its folder is not there; make it first")
    if path.suffix.lower() not in (".svg", ".mmd"):
        raise InputError.at(path, "name an .svg or .mmd file")
    if path.exists() and not force:
        with path.open(encoding="utf-8", errors="replace") as stream:
            head = stream.read(HEAD)
        if path.suffix.lower() == ".mmd":
            is_earlier = head.startswith(MERMAID)
        else:
            titles = [DIAGRAM.findall(text) for text in (head, graph.svg())]
            is_earlier = titles[0] != [] and titles[0] == titles[1]
        if not is_earlier:
            reason = (
                f"is there, and no picture of {graph.name}; name another file as --out, or write over it by --force"
            )
            raise InputError.at(path, reason)
    write_text(path, graph.mermaid() if path.suffix.lower() == ".mmd" else graph.svg())
    say(f"graph: {path}")
    if json:
        say_json({"graph": str(path)})
    show(path, open)


def graph_of(path: Path, overrides: Sequence[str] = ()) -> Graph:
    """Return the block diagram of a scenario, a manifest or an SSP.

    Raises:
        InputError: The input is faulty.
        FmuError: An FMU is invalid.
    """
    from cosim.core.scratch import temporary_folder
    from cosim.scenario.scenario import resolve_defaults
    from cosim.scenario.scenario_file import ScenarioFile
    from cosim.simulation.packaged import is_ssp, lay_out
    from cosim.simulation.report.system_diagram import graph_from
    from cosim.system.system import build_system

    with ExitStack() as stack:
        if is_ssp(path):
            file, _ = lay_out(path, stack.enter_context(temporary_folder("graph")), overrides)
        else:
            file = ScenarioFile(path, overrides)
        system = build_system(file)
    units = {name: signal.unit for name, signal in system.signals.items()}
    arrays = {f"{n.partition('.')[0]}.{s.array}": s.unit for n, s in system.signals.items() if s.array}
    held = {transfer.name for transfer in system.held if not transfer.of}
    return graph_from(resolve_defaults(file.scenario), system.names, held, {**arrays, **units})
