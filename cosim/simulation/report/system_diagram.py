"""Diagram of a system as SVG: components in stepping order, signals, units, noise and faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import PurePath
from typing import Any

import numpy as np

from cosim.core.text import counted, written
from cosim.files.results import Results
from cosim.report.template import TEMPLATES, inline
from cosim.simulation.report.recorded import Run, disturbances

MAX_NAME = 34  # characters of a name in the diagram
FACTS = {  # key of a component → its text in the diagram
    "block": "{}",
    "file": "{}",
    "step": "step {:g} s",
    "rate": "{:g} Hz",
    "latency": "{:g} s late",
    "dropout": "{:.2g} lost",
}
CHARACTER_PX, BOLD_PX, SMALL_PX = 7.0, 9.2, 6.2  # width of a character of 12.5, 13.5 and 11 px text
HEAD, LINE, NOTE = 46, 22, 15  # [px] height of a box's head, of a port, of a note below a port
SLOT, LANE, MARGIN = 13, 15, 24  # [px] between parallel wires, between lanes above and below, around the diagram
MIN_WIDTH = 150  # [px] of a box
STYLES = ("diagram.css", "diagram_alone.css")
Port = tuple[str, str, tuple[str, ...]]


@dataclass(frozen=True)
class DiagramLink:
    """A connection with its ends, units, noise and faults; `held`: the target gets the value from the step's start."""

    source: str
    target: str
    units: tuple[str, str]
    acting: tuple[str, ...]
    held: bool


@dataclass(frozen=True)
class Graph:
    """Components in stepping order with their kinds and connections."""

    name: str
    about: Mapping[str, str]
    links: Sequence[DiagramLink]

    def svg(self, *, alone: bool = True) -> str:
        """Return the diagram as SVG.

        Boxes are drawn from left to right, in stepping order. Connections to an earlier box run below the boxes,
        connections that pass a box run above.

        Args:
            alone: True for a separate file, which needs its own light and dark colours.
        """
        if not self.about:
            return ""
        place = {name: k for k, name in enumerate(self.about)}
        # inputs and outputs of each box: variable → name, unit, notes on noise and faults
        ports: dict[str, tuple[dict[str, Port], dict[str, Port]]] = {name: ({}, {}) for name in place}
        wires = []  # box numbers of both ends
        for link in self.links:
            for side, (end, unit) in enumerate(zip((link.target, link.source), link.units[::-1], strict=True)):
                owner, _, variable = end.partition(".")
                notes = link.acting if side == 0 else ()
                ports[owner][side].setdefault(variable, (_cut(variable), written(unit), notes))
            wires.append((place[link.source.partition(".")[0]], place[link.target.partition(".")[0]]))
        gaps = [_order(gap, wires) for gap in range(len(place) + 1)]
        # Connections that pass a box run in lanes above; connections to an earlier box in lanes below.
        above = {k: lane for lane, k in enumerate(reversed([k for k, (a, b) in enumerate(wires) if b > a + 1]))}
        below = {k: lane for lane, k in enumerate(reversed([k for k, (a, b) in enumerate(wires) if b <= a]))}
        top, x = MARGIN + LANE * len(above), float(MARGIN + SLOT * (1 + len(gaps[0])))
        parts, bottom = list[str](), 0.0
        places: tuple[dict[str, tuple[float, float]], dict[str, tuple[float, float]]] = {}, {}  # inputs, outputs
        for number, (name, about) in enumerate(self.about.items(), 1):
            title, sides = f"{number} {_cut(name)}", ports[name]
            widths = 0.0  # of the widest input and the widest output with their notes
            for own in sides:
                lines = [CHARACTER_PX * len(f"{port} [{unit}]" if unit else port) for port, unit, _ in own.values()]
                lines += [SMALL_PX * len(note) for *_, notes in own.values() for note in notes]
                widths += max(lines, default=0.0)
            width = max(MIN_WIDTH, widths + 40, BOLD_PX * len(title) + 24, SMALL_PX * len(about) + 24)
            box = HEAD + 12 + max(sum(LINE + NOTE * len(notes) for *_, notes in side.values()) for side in sides)
            bottom = max(bottom, top + box + 12)
            parts += [
                f'<rect class="box" x="{x:.1f}" y="{top:.1f}" width="{width:.1f}" height="{box:.1f}" rx="6"/>',
                f'<path class="head" d="M{x:.1f} {top + HEAD:.1f}h{width:.1f}"/>',
                _text("name", x + 12, top + 20, title),
                _text("about", x + 12, top + 37, about),
            ]
            for side, (edge, at, where) in enumerate(((x, x + 12, ""), (x + width, x + width - 12, " right"))):
                down = top + HEAD + 21
                for variable, (shown, unit, notes) in sides[side].items():
                    places[side][f"{name}.{variable}"] = edge, down - 4
                    parts.append(_text(f"port{where}", at, down, shown, f"[{unit}]" if unit else ""))
                    for k, note in enumerate(notes, 1):
                        look = f"note-{'bad' if note.startswith('fault') else 'warn'}{where}"
                        parts.append(_text(look, at, down + NOTE * k, note))
                    down += LINE + NOTE * len(notes)
            x += width + SLOT * (3 + len(gaps[number]))
        for number, (link, (before, after)) in enumerate(zip(self.links, wires, strict=True)):
            (x2, y2), (x1, y1) = places[0][link.target], places[1][link.source]
            path = f"M{x1:.1f} {y1:.1f}H{x1 + SLOT * (1.5 + gaps[before + 1].index((number, 'out'))):.1f}"
            if after != before + 1:
                lane = top - 10 - LANE * above[number] if number in above else bottom + LANE * below[number]
                into = x2 - SLOT * (len(gaps[after]) - gaps[after].index((number, "in")) + 0.5)
                path += f"V{lane:.1f}H{into:.1f}"
            start_value = "the value of the step's start" if link.held else ""
            title = "; ".join(filter(None, [f"{link.source} → {link.target}", *link.acting, start_value]))
            wire = f'<path class="wire{" held" * link.held}" d="{path}V{y2:.1f}H{x2:.1f}"/>'
            tip = f'<path class="tip" d="M{x2:.1f} {y2:.1f}l-8 -4v8z"/>'
            parts.append(f"<g><title>{escape(title)}</title>{wire}{tip}</g>")
        key = "Numbers are the order in which components step."
        held = [link.held for link in self.links]
        if held and all(held):  # as under Jacobi
            key = "Every component receives the values at the start of the step."
        elif any(held):
            key += " Dashed lines transfer values at the start of the step, other lines values at its end."
        height = bottom + LANE * len(below) + 37
        parts.append(_text("key", MARGIN, height - 15, key))
        width = max(x - SLOT + MARGIN / 2, MARGIN * 2 + SMALL_PX * len(key))
        summary = f"{counted(len(place), 'component')} of {self.name} in the order in which they step"
        summary += f", {counted(len(wires), 'connection')}"
        size = f'width="{width:.0f}" height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}"'
        paper = '<rect class="paper" width="100%" height="100%"/>' if alone else ""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" class="diagram" {size} role="img" aria-label="{escape(summary)}">'
            f"<style>{inline([TEMPLATES / name for name in STYLES[: 2 if alone else 1]])}</style>"
            f"{paper}{''.join(parts)}</svg>"
        )


def graph_of_run(run: Run) -> Graph | None:
    """Return the diagram of a run; None if the manifest is incomplete."""
    order = run.manifest.get("order", ())
    if set(order) != set(run.components):
        return None
    return graph_from(run.scenario, order, set(run.manifest.get("held", ())), run.results.units)


def graph_from(scenario: Mapping[str, Any], order: Sequence[str], held: set[str], units: Mapping[str, str]) -> Graph:
    """Return the diagram of a scenario.

    Args:
        order: Components in stepping order.
        held: Inputs that get the value from the step's start.
    """
    run = Run(Results(np.empty(0), (), np.empty((0, 0)), units), {"scenario": scenario})
    about = {}
    for name in order:
        component = run.components.get(name, {})
        facts = {**component, "file": PurePath(component.get("fmu") or component.get("file") or "").name}
        about[name] = ", ".join(_cut(text.format(facts[key])) for key, text in FACTS.items() if facts.get(key))
    silent, arrays = scenario.get("noise") is False, {name.partition("[")[0] for name in held}
    links = []
    for link in run.connections:
        source, target = link["from"], link["to"]
        texts = ((text, text.startswith("fault")) for text in disturbances(run, link))
        acting = tuple(text if is_fault else f"noise {text}" for text, is_fault in texts if is_fault or not silent)
        if about.keys() >= {source.partition(".")[0], target.partition(".")[0]}:
            pair = units.get(source, ""), units.get(target, "")
            links.append(DiagramLink(source, target, pair, acting, target in held | arrays))
    return Graph(scenario.get("name", ""), about, links)


def _text(look: str, x: float, y: float, text: str, unit: str = "") -> str:
    shown = escape(text) + (f' <tspan class="unit">{escape(unit)}</tspan>' if unit else "")
    return f'<text class="{look}" x="{x:.1f}" y="{y:.1f}">{shown}</text>'


def _cut(text: str) -> str:
    return text if len(text) <= MAX_NAME else f"{text[: MAX_NAME - 1]}…"


def _order(gap: int, wires: Sequence[tuple[int, int]]) -> list[tuple[int, str]]:
    """Return the vertical wires in the gap before a box from left to right, each with its end "out" or "in".

    In this order, wires of neighbouring ports do not cross.
    """
    out: dict[str, list[int]] = {"on": [], "near": [], "back": []}
    into: dict[str, list[int]] = {"from the right": [], "from the left": []}
    for number, (source, target) in enumerate(wires):
        if source + 1 == gap:
            out["back" if target < gap else "near" if target == gap else "on"].append(number)
        elif target == gap:
            into["from the left" if source < gap else "from the right"].append(number)
    left = out["on"] + out["near"] + out["back"][::-1]
    right = into["from the right"] + into["from the left"][::-1]
    return [*((number, "out") for number in left), *((number, "in") for number in right)]
