"""Block diagrams as SVG, without a script or font of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from cosim.report.template import TEMPLATES, inline

CHARACTER, BOLD, SMALL = 7.0, 9.2, 6.2  # [px] width of a character of 12.5, 13.5 and 11 px text
HEAD, LINE, NOTE = 46, 22, 15  # [px] height of a box's head, of a port, of a note below a port
SLOT, LANE, MARGIN = 13, 15, 24  # [px] between parallel wires, between lanes above and below, around the diagram
MIN_WIDTH, RADIUS = 150, 6  # [px] of a box; of a corner
STYLES = ("diagram.css", "diagram_alone.css")


@dataclass(frozen=True)
class DiagramPort:
    """An input or output of a box, with notes below the port; each note has a text and a tone, warn or bad."""

    name: str
    unit: str = ""
    notes: tuple[tuple[str, str], ...] = ()

    @property
    def height(self) -> int:
        """Return the height [px]."""
        return LINE + NOTE * len(self.notes)

    @property
    def width(self) -> float:
        """Return the width [px]."""
        characters = len(self.name) + (len(self.unit) + 3 if self.unit else 0)
        return max([CHARACTER * characters, *(SMALL * len(text) for text, _ in self.notes)])


@dataclass(frozen=True)
class Box:
    """A box of the diagram: its name, a line of description, inputs on the left and outputs on the right."""

    name: str
    about: str
    inputs: tuple[DiagramPort, ...]
    outputs: tuple[DiagramPort, ...]

    @property
    def width(self) -> float:
        """Return the width [px]."""
        sides = [max((p.width for p in side), default=0.0) for side in (self.inputs, self.outputs)]
        return max(MIN_WIDTH, sum(sides) + 40, BOLD * len(self.name) + 24, SMALL * len(self.about) + 24)

    @property
    def height(self) -> float:
        """Return the height [px]."""
        return HEAD + 12 + max(sum(p.height for p in side) for side in (self.inputs, self.outputs))


@dataclass(frozen=True)
class Wire:
    """A line from an output to an input, each (box, port) by number; `held` is dashed, `title` is its tooltip."""

    source: tuple[int, int]
    target: tuple[int, int]
    held: bool
    title: str


@dataclass(frozen=True)
class DiagramLayout:
    """Places of a diagram's boxes [px], and the order of the wires in gaps and lanes."""

    boxes: Sequence[Box]
    lefts: Sequence[float]
    top: float
    bottom: float
    gaps: Sequence[Sequence[tuple[int, str]]]
    above: Mapping[int, int]
    below: Mapping[int, int]


def diagram(
    boxes: Sequence[Box], wires: Sequence[Wire], summary: str, keys: Sequence[str] = (), *, alone: bool = True
) -> str:
    """Return a block diagram as SVG.

    Boxes stand from left to right. Wires back run below the boxes, wires past a box above.

    Args:
        alone: True for a separate file, with light and dark colours.
    """
    if not boxes:
        return ""
    gaps = [_order(gap, wires) for gap in range(len(boxes) + 1)]
    above, below = _lanes(wires)
    top: float = MARGIN + LANE * len(above)
    lefts: list[float] = []
    x: float = MARGIN + SLOT * (1 + len(gaps[0]))
    for number, box in enumerate(boxes):
        lefts.append(x)
        x += box.width + SLOT * (3 + len(gaps[number + 1]))
    bottom = top + max(box.height for box in boxes) + 12
    layout = DiagramLayout(boxes, lefts, top, bottom, gaps, above, below)
    parts = [_box(box, lefts[k], top) for k, box in enumerate(boxes)]
    parts += [_path(number, wire, layout) for number, wire in enumerate(wires)]
    key_top = bottom + LANE * len(below) + 22
    parts += [
        f'<text class="key" x="{MARGIN}" y="{key_top + 15 * k:.0f}">{escape(key)}</text>' for k, key in enumerate(keys)
    ]
    width, height = x - SLOT + MARGIN / 2, key_top + 15 * len(keys)
    drawn_width = max([width, *(MARGIN * 2 + SMALL * len(key) for key in keys)])
    style = f"<style>{inline([TEMPLATES / name for name in STYLES[: 2 if alone else 1]])}</style>"
    paper = '<rect class="paper" width="100%" height="100%"/>' if alone else ""
    size = f'width="{drawn_width:.0f}" height="{height:.0f}" viewBox="0 0 {drawn_width:.0f} {height:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="diagram" {size} role="img" aria-label="{escape(summary)}">'
        f"{style}{paper}{''.join(parts)}</svg>"
    )


def _role(wire: Wire, gap: int) -> str:
    """Return the role of a wire in the gap before a box: from or to a neighbour, and its direction."""
    source, target = wire.source[0], wire.target[0]
    if source + 1 == gap:
        return "out back" if target < gap else "out near" if target == gap else "out on"
    if target == gap:
        return "in from the left" if source < gap else "in from the right"
    return ""


def _order(gap: int, wires: Sequence[Wire]) -> list[tuple[int, str]]:
    """Return the wires in a gap from left to right, each with its end "out" or "in".

    In this order, wires of neighbouring ports do not cross.
    """
    roles: dict[str, list[int]] = {}
    for number, wire in enumerate(wires):
        roles.setdefault(_role(wire, gap), []).append(number)
    out = roles.get("out on", []) + roles.get("out near", []) + roles.get("out back", [])[::-1]
    into = roles.get("in from the right", []) + roles.get("in from the left", [])[::-1]
    return [*((number, "out") for number in out), *((number, "in") for number in into)]


def _lanes(wires: Sequence[Wire]) -> tuple[Mapping[int, int], Mapping[int, int]]:
    """Return wire → lane, above and below the boxes.

    Wires past a box run above, wires back below.
    """
    above = [k for k, w in enumerate(wires) if w.target[0] > w.source[0] + 1]
    below = [k for k, w in enumerate(wires) if w.target[0] <= w.source[0]]
    return {k: lane for lane, k in enumerate(reversed(above))}, {k: lane for lane, k in enumerate(reversed(below))}


def _box(box: Box, x: float, y: float) -> str:
    w, h = box.width, box.height
    parts = [
        f'<rect class="box" x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}" rx="{RADIUS}"/>',
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


def _port_y(ports: Sequence[DiagramPort], number: int, top: float) -> float:
    return top + HEAD + 6 + sum(p.height for p in ports[:number]) + 11


def _path(number: int, wire: Wire, layout: DiagramLayout) -> str:
    source, target = wire.source[0], wire.target[0]
    x1, x2 = layout.lefts[source] + layout.boxes[source].width, layout.lefts[target]
    y1 = _port_y(layout.boxes[source].outputs, wire.source[1], layout.top)
    y2 = _port_y(layout.boxes[target].inputs, wire.target[1], layout.top)
    out = x1 + SLOT * (1.5 + layout.gaps[source + 1].index((number, "out")))
    if target == source + 1:
        points = [(x1, y1), (out, y1), (out, y2), (x2, y2)]
    else:
        over, gap = number in layout.above, layout.gaps[target]
        lane = layout.top - 10 - LANE * layout.above[number] if over else layout.bottom + LANE * layout.below[number]
        into = x2 - SLOT * (len(gap) - gap.index((number, "in")) + 0.5)
        points = [(x1, y1), (out, y1), (out, lane), (into, lane), (into, y2), (x2, y2)]
    tip = f'<path class="tip" d="M{x2:.1f} {y2:.1f}l-8 -4v8z"/>'
    style = "wire held" if wire.held else "wire"
    return f'<g><title>{escape(wire.title)}</title><path class="{style}" d="{_rounded_path(points)}"/>{tip}</g>'


def _rounded_path(points: Sequence[tuple[float, float]]) -> str:
    """Return a path along right-angled points with rounded corners."""
    path = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    for (ax, ay), (bx, by), (cx, cy) in zip(points, points[1:], points[2:], strict=False):
        before, after = abs(bx - ax) + abs(by - ay), abs(cx - bx) + abs(cy - by)
        r = min(RADIUS, before / 2, after / 2)
        if r < 0.5:
            path.append(f"L{bx:.1f} {by:.1f}")
            continue
        from_x, from_y = bx - r * (bx - ax) / before, by - r * (by - ay) / before
        to_x, to_y = bx + r * (cx - bx) / after, by + r * (cy - by) / after
        path.append(f"L{from_x:.1f} {from_y:.1f}Q{bx:.1f} {by:.1f} {to_x:.1f} {to_y:.1f}")
    return "".join([*path, f"L{points[-1][0]:.1f} {points[-1][1]:.1f}"])
