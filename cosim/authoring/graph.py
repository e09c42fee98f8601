"""Diagram of a scenario before a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from cosim.base.errors import InputError
from cosim.base.scratch import temporary_folder
from cosim.scenario.scenario import resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.packaged import is_ssp, lay_out
from cosim.simulation.report.system_diagram import Graph, graph_from
from cosim.system.system import build_system

HEAD = 4096  # characters that contain the subject of a diagram
MERMAID = "flowchart LR\n  n1["
DIAGRAM = re.compile(
    r'\A<svg [^>]*class="diagram"[^>]* aria-label="\d+ components? of (.*?) in the order in which they step'
)


def graph_of(path: Path, overrides: Sequence[str] = ()) -> Graph:
    """Return the block diagram of a scenario, a manifest or an SSP.

    Raises:
        InputError: The input is faulty.
        FmuError: An FMU is invalid.
    """
    with temporary_folder("graph") as folder:
        file = lay_out(path, folder, overrides)[0] if is_ssp(path) else ScenarioFile(path, overrides)
        system = build_system(file)
        units = {name: signal.unit for name, signal in system.signals.items()}
        arrays = {f"{n.partition('.')[0]}.{s.array}": s.unit for n, s in system.signals.items() if s.array}
        held = {transfer.name for transfer in system.held if not transfer.of}
        return graph_from(resolve_defaults(file.scenario), system.names, held, {**arrays, **units})


def check_picture(path: Path, graph: Graph) -> None:
    """Raise InputError for an existing file that is no diagram."""
    if not path.exists():
        return
    with path.open(encoding="utf-8", errors="replace") as stream:
        head = stream.read(HEAD)
    if path.suffix.lower() == ".mmd":
        is_earlier = head.startswith(MERMAID)
    else:
        titles = [DIAGRAM.findall(text) for text in (head, graph.svg())]
        is_earlier = titles[0] != [] and titles[0] == titles[1]
    if not is_earlier:
        raise InputError.at(
            path, f"is there, and no picture of {graph.name}; name another file as --out, or write over it by --force"
        )
