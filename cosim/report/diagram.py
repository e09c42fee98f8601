"""Boxes with ports and lines between them, as SVG that needs no script and no font of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

CHARACTER, BOLD, SMALL = 7.0, 9.2, 6.2  # [px] wide, of 12.5, 13.5 and 11 px text
HEAD, LINE, NOTE = 46, 22, 15  # [px] high: a box's head, a port, a line of notes below it
SLOT, LANE, MARGIN = 13, 15, 24  # [px] between lines side by side, between lanes above and below, around all
LEAST, ROUND = 150, 6  # [px] width of a box, radius of corners
STYLE = """
.diagram text { font: 12.5px var(--sans, system-ui, sans-serif); fill: var(--ink, #1b1f24); }
.diagram .name { font-weight: 600; font-size: 13.5px; } .diagram .right { text-anchor: end; }
.diagram .unit { fill: var(--soft, #58616b); }
.diagram .about, .diagram .key { fill: var(--soft, #58616b); font-size: 11px; }
.diagram .note-warn { fill: var(--warn, #755400); font-size: 11px; }
.diagram .note-bad { fill: var(--bad, #a83200); font-size: 11px; }
.diagram .box { fill: var(--card, #fff); stroke: var(--soft, #58616b); }
.diagram .head { stroke: var(--rule, #e3e5e8); }
.diagram .wire { fill: none; stroke: var(--accent, #0067a5); stroke-width: 1.6; }
.diagram .held { stroke-dasharray: 6 4; }
@media print { .diagram { max-width: 100%; height: auto; } }
.diagram .tip { fill: var(--accent, #0067a5); } .diagram .paper { fill: var(--paper, #fcfcfb); }
"""
DARK = """
@media (prefers-color-scheme: dark) {
  .diagram { --paper: #14171a; --card: #1a1e22; --ink: #e8eaed; --soft: #a6afb8; --rule: #2c3238;
    --accent: #62b5ea; --warn: #e6c35c; --bad: #ff9d6e; }
}
"""


@dataclass(frozen=True)
class Port:
    """An input or output of a box; notes stand below it, each a text and its tone, warn or bad."""

    name: str
    unit: str = ""
    notes: tuple[tuple[str, str], ...] = ()

    @property
    def height(self) -> int:
        """[px]"""
        return LINE + NOTE * len(self.notes)

    @property
    def width(self) -> float:
        """[px]"""
        shown = len(self.name) + (len(self.unit) + 3 if self.unit else 0)
        return max([CHARACTER * shown, *(SMALL * len(text) for text, _ in self.notes)])


@dataclass(frozen=True)
class Box:
    """What is drawn as a box: its name, lines about it, inputs at its left, outputs at its right."""

    name: str
    about: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]

    @property
    def width(self) -> float:
        """[px]"""
        sides = [max((p.width for p in side), default=0.0) for side in (self.inputs, self.outputs)]
        return max(LEAST, sum(sides) + 40, BOLD * len(self.name) + 24, SMALL * len(self.about) + 24)

    @property
    def height(self) -> float:
        """[px]"""
        return HEAD + 12 + max(sum(p.height for p in side) for side in (self.inputs, self.outputs))


@dataclass(frozen=True)
class Wire:
    """A line from an output to an input, each (box, port) by number; `held` is dashed, `title` tells what it is."""

    source: tuple[int, int]
    target: tuple[int, int]
    held: bool
    title: str


def diagram(
    boxes: Sequence[Box], wires: Sequence[Wire], summary: str, keys: Sequence[str] = (), *, alone: bool = True
) -> str:
    """SVG of boxes from left to right and wires between them; lines that go back run below, over others above.

    alone: it stands in a file of its own, with colours for light and dark
    """
    if not boxes:
        return ""
    gaps = _gaps(len(boxes), wires)
    above, below = _lanes(wires)
    top = MARGIN + LANE * len(above)
    left: list[float] = []
    x: float = MARGIN + SLOT * (1 + len(gaps[0]))
    for number, box in enumerate(boxes):
        left.append(x)
        x += box.width + SLOT * (3 + len(gaps[number + 1]))
    bottom = top + max(box.height for box in boxes) + 12
    parts = [_box(box, left[k], top) for k, box in enumerate(boxes)]
    for number, wire in enumerate(wires):
        path = _path(number, wire, boxes, left, top, bottom, gaps, above, below)
        parts.append(path)
    key_top = bottom + LANE * len(below) + 22
    parts += [
        f'<text class="key" x="{MARGIN}" y="{key_top + 15 * k:.0f}">{escape(key)}</text>' for k, key in enumerate(keys)
    ]
    width, height = x - SLOT + MARGIN / 2, key_top + 15 * len(keys)
    shown = max([width, *(MARGIN * 2 + SMALL * len(key) for key in keys)])
    style = f"<style>{STYLE}{DARK if alone else ''}</style>"
    paper = '<rect class="paper" width="100%" height="100%"/>' if alone else ""
    size = f'width="{shown:.0f}" height="{height:.0f}" viewBox="0 0 {shown:.0f} {height:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="diagram" {size} role="img" aria-label="{escape(summary)}">'
        f"{style}{paper}{''.join(parts)}</svg>"
    )


def _gaps(count: int, wires: Sequence[Wire]) -> list[list[tuple[int, str]]]:
    """Of each gap, before the first box to behind the last, the wires that run up or down in it, and at which end.

    In an order, from the left, in which wires from neighbouring ports do not cross.
    """
    gaps: list[list[tuple[int, str]]] = [[] for _ in range(count + 1)]
    for gap in range(count + 1):
        out = [k for k, w in enumerate(wires) if w.source[0] + 1 == gap]
        back, on = [k for k in out if wires[k].target[0] < gap], [k for k in out if wires[k].target[0] > gap]
        near = [k for k in out if wires[k].target[0] == gap]
        into = [k for k, w in enumerate(wires) if w.target[0] == gap and w.source[0] + 1 != gap]
        from_above, from_below = ([k for k in into if (wires[k].source[0] < gap) is side] for side in (True, False))
        gaps[gap] = [(k, "out") for k in (*on, *near, *reversed(back))]
        gaps[gap] += [(k, "in") for k in (*from_below, *reversed(from_above))]
    return gaps


def _lanes(wires: Sequence[Wire]) -> tuple[Mapping[int, int], Mapping[int, int]]:
    """Wire → lane above the boxes, for those that go on over others, and below, for those that go back."""
    above = [k for k, w in enumerate(wires) if w.target[0] > w.source[0] + 1]
    below = [k for k, w in enumerate(wires) if w.target[0] <= w.source[0]]
    return {k: lane for lane, k in enumerate(reversed(above))}, {k: lane for lane, k in enumerate(reversed(below))}


def _box(box: Box, x: float, y: float) -> str:
    w, h = box.width, box.height
    parts = [
        f'<rect class="box" x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}" rx="{ROUND}"/>',
        f'<path class="head" d="M{x:.1f} {y + HEAD:.1f}h{w:.1f}"/>',
        f'<text class="name" x="{x + 12:.1f}" y="{y + 20:.1f}">{escape(box.name)}</text>',
        f'<text class="about" x="{x + 12:.1f}" y="{y + 37:.1f}">{escape(box.about)}</text>',
    ]
    for ports, at, side in ((box.inputs, x + 12, ""), (box.outputs, x + w - 12, " right")):
        down = y + HEAD + 6
        for port in ports:
            unit = f' <tspan class="unit">[{escape(port.unit)}]</tspan>' if port.unit else ""
            parts.append(f'<text class="port{side}" x="{at:.1f}" y="{down + 15:.1f}">{escape(port.name)}{unit}</text>')
            for k, (text, tone) in enumerate(port.notes, 1):
                parts.append(
                    f'<text class="note-{tone}{side}" x="{at:.1f}" y="{down + 15 + NOTE * k:.1f}">{escape(text)}</text>'
                )
            down += port.height
    return "".join(parts)


def _port_y(ports: Sequence[Port], number: int, top: float) -> float:
    return top + HEAD + 6 + sum(p.height for p in ports[:number]) + 11


def _path(
    number: int, wire: Wire, boxes: Sequence[Box], left: Sequence[float], top: float, bottom: float,
    gaps: Sequence[Sequence[tuple[int, str]]], above: Mapping[int, int], below: Mapping[int, int],
) -> str:  # fmt: skip
    source, target = wire.source[0], wire.target[0]
    x1, x2 = left[source] + boxes[source].width, left[target]
    y1 = _port_y(boxes[source].outputs, wire.source[1], top)
    y2 = _port_y(boxes[target].inputs, wire.target[1], top)
    out = x1 + SLOT * (1.5 + gaps[source + 1].index((number, "out")))
    if target == source + 1:
        points = [(x1, y1), (out, y1), (out, y2), (x2, y2)]
    else:
        lane = top - 10 - LANE * above[number] if number in above else bottom + LANE * below[number]
        into = x2 - SLOT * (len(gaps[target]) - gaps[target].index((number, "in")) + 0.5)
        points = [(x1, y1), (out, y1), (out, lane), (into, lane), (into, y2), (x2, y2)]
    tip = f'<path class="tip" d="M{x2:.1f} {y2:.1f}l-8 -4v8z"/>'
    held = " held" if wire.held else ""
    return f'<g><title>{escape(wire.title)}</title><path class="wire{held}" d="{_rounded(points)}"/>{tip}</g>'


def _rounded(points: Sequence[tuple[float, float]]) -> str:
    """A path along points at right angles, its corners rounded."""
    path = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    for (ax, ay), (bx, by), (cx, cy) in zip(points, points[1:], points[2:], strict=False):
        before, after = abs(bx - ax) + abs(by - ay), abs(cx - bx) + abs(cy - by)
        r = min(ROUND, before / 2, after / 2)
        if r < 0.5:
            path.append(f"L{bx:.1f} {by:.1f}")
            continue
        from_x, from_y = bx - r * (bx - ax) / before, by - r * (by - ay) / before
        to_x, to_y = bx + r * (cx - bx) / after, by + r * (cy - by) / after
        path.append(f"L{from_x:.1f} {from_y:.1f}Q{bx:.1f} {by:.1f} {to_x:.1f} {to_y:.1f}")
    return "".join([*path, f"L{points[-1][0]:.1f} {points[-1][1]:.1f}"])
