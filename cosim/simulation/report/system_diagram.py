"""Diagram of a system: components in stepping order, signals, units, noise and faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from cosim.base.text import counted, written
from cosim.blocks.coupling import DEFAULT, Algorithm, algorithms
from cosim.report.diagram import Box, DiagramPort, Wire, diagram
from cosim.simulation.report.recorded import Run, mapping, mappings
from cosim.simulation.report.run_rows import disturbances
from cosim.storage.results import Results
from cosim.storage.yaml_file import short

MAX_NAME = 34  # characters of a name in the diagram
FACTS = {  # key of a component → its text in the diagram
    "block": "{}",
    "file": "{}",
    "step": "step {:g} s",
    "rate": "{:g} Hz",
    "latency": "{:g} s late",
    "dropout": "{:.2g} lost",
}


@dataclass(frozen=True)
class DiagramLink:
    """A connection with its ends, units, noise and faults; `held` passes on the value from the step's start."""

    source: str
    target: str
    units: tuple[str, str]
    acting: tuple[str, ...]
    held: bool

    @property
    def ends(self) -> tuple[str, str]:
        """Return the connected components."""
        return self.source.partition(".")[0], self.target.partition(".")[0]


@dataclass(frozen=True)
class Graph:
    """Components in stepping order with their kinds and connections."""

    name: str
    about: Mapping[str, str]
    links: Sequence[DiagramLink]
    algorithm: Algorithm

    def svg(self, *, alone: bool = True) -> str:
        """Return the diagram as SVG.

        Args:
            alone: Whether for a file of its own.
        """
        ports: dict[str, tuple[dict[str, DiagramPort], dict[str, DiagramPort]]] = {
            name: ({}, {}) for name in self.about
        }
        for link in self.links:
            for side, (end, unit) in enumerate(zip((link.target, link.source), link.units[::-1], strict=True)):
                owner, _, variable = end.partition(".")
                notes = tuple((text, "bad" if text.startswith("fault") else "warn") for text in link.acting)
                port = DiagramPort(_cut(variable), written(unit), notes if side == 0 else ())
                ports[owner][side].setdefault(variable, port)
        boxes = [
            Box(f"{k} {name}", self.about[name], tuple(inputs.values()), tuple(outputs.values()))
            for k, (name, (inputs, outputs)) in enumerate(ports.items(), 1)
        ]
        place = {name: k for k, name in enumerate(ports)}
        wires = [self._wire(link, ports, place) for link in self.links]
        title = f"{counted(len(boxes), 'component')} of {self.name} in the order in which they step"
        return diagram(boxes, wires, f"{title}, {counted(len(wires), 'connection')}", self._keys(), alone=alone)

    def _wire(self, link: DiagramLink, ports: Mapping[str, Any], place: Mapping[str, int]) -> Wire:
        ends = []
        for side, end in ((1, link.source), (0, link.target)):
            owner, _, variable = end.partition(".")
            ends.append((place[owner], list(ports[owner][side]).index(variable)))
        return Wire(ends[0], ends[1], link.held, _title(link))

    def _keys(self) -> list[str]:
        held = [link.held for link in self.links]
        if not self.algorithm.sequential:
            return [f"{self.algorithm.title}: every component sees the values of the step's start."] if held else []
        order = "Numbers are the order in which components step."
        if not any(held):
            return [order]
        return [f"{order} A dashed line passes on the value of the step's start, all others that of its end."]

    def mermaid(self) -> str:
        """Return the diagram as Mermaid text for GitHub, GitLab and editors."""
        place = {name: f"n{k}" for k, name in enumerate(self.about, 1)}
        lines = ["flowchart LR"]
        lines += [
            f'  {place[name]}["{k} · {_safe(name)}<br/>{_safe(about)}"]'
            for k, (name, about) in enumerate(self.about.items(), 1)
        ]
        pairs: dict[tuple[str, str, bool], list[str]] = {}
        for link in self.links:
            pairs.setdefault((*link.ends, link.held), []).append(_safe(_label(link)))
        for (source, target, held), labels in pairs.items():
            start, end = ("-. ", " .->") if held else ("-- ", " -->")
            lines.append(f'  {place[source]} {start}"{"<br/>".join(labels)}"{end} {place[target]}')
        return "\n".join(lines) + "\n"


def graph_of_run(run: Run) -> Graph | None:
    """Return a run's diagram, None for an incomplete manifest."""
    order, held = run.manifest.get("order"), run.manifest.get("held")
    components = mapping(run.scenario.get("components"))
    if not isinstance(order, list) or not isinstance(held, list) or set(order) != set(components):
        return None
    return graph_from(run.scenario, [str(name) for name in order], {str(h) for h in held}, run.results.units)


def graph_from(scenario: Mapping[str, Any], order: Sequence[str], held: set[str], units: Mapping[str, str]) -> Graph:
    """Return the diagram of a scenario.

    Args:
        order: Components in stepping order.
        held: Inputs that see the value from the step's start.
    """
    components = mapping(scenario.get("components"))
    about = {name: _about(mapping(components.get(name))) for name in order}
    run = Run(Results(np.empty(0), (), np.empty((0, 0)), units), {"scenario": scenario})
    silent = scenario.get("noise") is False
    arrays = {name.partition("[")[0] for name in held}
    links = []
    for link in mappings(scenario.get("connections")):
        source, target = str(link.get("from")), str(link.get("to"))
        texts = ((text, text.startswith("fault")) for text in disturbances(run, link))
        acting = tuple(text if is_fault else f"noise {text}" for text, is_fault in texts if is_fault or not silent)
        pair = units.get(source, ""), units.get(target, "")
        edge = DiagramLink(source, target, pair, acting, target in held | arrays)
        links += [edge] if about.keys() >= {*edge.ends} else []
    algorithm = algorithms().get(str(scenario.get("algorithm")), DEFAULT)
    return Graph(str(scenario.get("name") or ""), about, links, algorithm)


def _about(component: Mapping[str, Any]) -> str:
    facts = {**component, "file": PurePath(str(component.get("fmu") or component.get("file") or "")).name}
    return ", ".join(_cut(text.format(facts[key])) for key, text in FACTS.items() if facts.get(key))


def _cut(text: str) -> str:
    return text if len(text) <= MAX_NAME else f"{text[: MAX_NAME - 1]}…"


def _title(link: DiagramLink) -> str:
    parts = [f"{link.source} → {link.target}", *link.acting, "the value of the step's start" if link.held else ""]
    return "; ".join(filter(None, parts))


def _label(link: DiagramLink) -> str:
    names = [end.partition(".")[2] for end in (link.source, link.target)]
    name = names[0] if names[0] == names[1] else " → ".join(names)
    units = list(dict.fromkeys(written(u) for u in link.units if u))
    return short(name) + (f" [{' → '.join(units)}]" if units else "") + "".join(f", {text}" for text in link.acting)


def _safe(text: str) -> str:
    """Return text escaped for Mermaid quotes."""
    return text.replace("&", "#amp;").replace('"', "#quot;").replace("<", "#lt;").replace(">", "#gt;")
