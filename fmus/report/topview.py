"""Picture of the craft from above: world X points up, Y to the left.

Coordinates are whole millimetres: right = −Y, down = −X. Path and craft have one scale. On a long path, the craft is
magnified by a factor stated on the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.text import MINUS
from cosim.core.units import DEGREES
from cosim.report.charts import Charts, round_values
from cosim.report.panels import extent
from cosim.simulation.report.recorded import number
from fmus.report.craft import SIDES, Craft, is_drawn
from plant.hovercraft import Hovercraft

CRAFT = Hovercraft()
ARM, RADIUS = CRAFT.arm, CRAFT.propeller_radius  # [m], defaults of the start values
MARGIN = 0.42  # m around the path: half a craft and a margin
MIN_RATIO, MAX_RATIO = 1.25, 1.9  # width / height of the picture
MIN_SIZE = 0.06  # of the picture's width; a smaller craft is magnified
ARROW = 250  # mm, about the length of the longest arrow
MAX_COORDINATE = 1e9  # m; larger whole millimetres do not fit
ON_TARGET = 0.02  # m; largest initial distance of the craft from a reference path


@dataclass(frozen=True)
class Track:
    """Track of a craft: world position [m] and heading [rad] in each row."""

    x: Array
    y: Array
    psi: Array

    @property
    def right(self) -> Array:
        """Return the horizontal position in the picture [mm]."""
        return -1000 * self.y

    @property
    def down(self) -> Array:
        """Return the vertical position in the picture [mm]."""
        return -1000 * self.x

    @property
    def turn(self) -> Array:
        """Return the clockwise rotation [°] from nose up."""
        return -DEGREES * self.psi


def make_track(x: Array, y: Array, psi: Array) -> Track:
    """Return a track with NaN for poses beyond MAX_COORDINATE."""
    far = ~(np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(psi)) < MAX_COORDINATE)
    return Track(*(np.where(far, np.nan, line) for line in (x, y, psi)))


def true_track(craft: Craft) -> Track:
    """Return the true track of a craft."""
    return make_track(*map(craft.signal, ("x_world", "y_world", "psi")))


def estimated_track(craft: Craft) -> Track | None:
    """Return the estimated track, made of estimated distance and estimated heading; None without one."""
    x_hat, psi_hat = craft.estimate("x_hat"), craft.estimate("psi_hat")
    return _lay_out(craft, x_hat, psi_hat) if is_drawn(x_hat, psi_hat) else None


def reference_track(craft: Craft) -> Track | None:
    """Return the track of the references if the craft begins on it."""
    x_ref, psi_ref = craft.reference("x"), craft.reference("psi")
    begins_there = np.abs(x_ref - craft.signal("x"))[:1] <= ON_TARGET
    return _lay_out(craft, x_ref, psi_ref) if begins_there.any() and is_drawn(psi_ref) else None


def _lay_out(craft: Craft, way: Array, heading: Array) -> Track:
    """Return the track of a distance along a heading, from the craft's start."""
    begin, x = true_track(craft), craft.signal("x")
    steps = np.diff(way, prepend=x[0] if is_drawn(x) else way[0])
    ahead, aside = np.cumsum(steps * np.cos(heading)), np.cumsum(steps * np.sin(heading))
    return make_track(begin.x[0] + ahead, begin.y[0] + aside, heading)


def pose(track: Track, row: int) -> str:
    """Return the SVG transform of a pose."""
    values = (track.right[row], track.down[row], track.turn[row])
    if not all(map(math.isfinite, values)):
        return ""
    return f"translate({values[0]:.0f} {values[1]:.0f}) rotate({values[2]:.2f})"


def path(track: Track | None, rows: Rows) -> str:
    """Return the path of a track, broken at gaps."""
    pieces, letter = [], "M"
    for right, down in [] if track is None else zip(track.right[rows].tolist(), track.down[rows].tolist(), strict=True):
        is_drawn = math.isfinite(right) and math.isfinite(down)
        if is_drawn:
            pieces.append(f"{letter}{right:.0f} {down:.0f}")
        letter = "L" if is_drawn else "M"
    return "".join(pieces)


def arrow(force: float, per_newton: float) -> str:
    """Return an arrow along the craft's axis, "" if too short."""
    reach = force * per_newton
    if not abs(reach) >= 8:
        return ""
    barb = math.copysign(min(34.0, abs(reach)), reach)
    return f"M0 0V{-reach:.0f}M-20 {-reach + barb:.0f}L0 {-reach:.0f}L20 {-reach + barb:.0f}"


def _round_up(step: float) -> float:
    """Return a step rounded up to 1, 2, 2.5 or 5 × 10^n."""
    power = 10.0 ** math.floor(math.log10(step))
    return next((m * power for m in (1, 2, 2.5, 5) if m * power >= step * (1 - 1e-9)), 10 * power)


def _ticks(low: float, high: float, count: int) -> list[dict[str, Any]]:
    """Return about `count` round labels between two ends, each at a share of the picture's size."""
    step = _round_up((high - low) / count)
    decimals = next(d for d in range(20) if abs(step * 10**d - round(step * 10**d)) < 1e-6)
    places = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [
        {"at": (i * step - low) / (high - low), "label": f"{i * step:.{decimals}f}".replace("-", MINUS)} for i in places
    ]


@dataclass(frozen=True)
class Body:
    """A craft in the picture: its tracks, and of each side the tilt [rad] and the arrow's force, if recorded.

    A force is the thrust along the craft's axis, T·sin α [N], or sin α without recorded thrust.
    """

    craft: Craft
    true: Track
    estimate: Track | None
    reference: Track | None
    tilts: Sequence[Array]
    forces: Sequence[Array]
    last: int  # last drawable row

    @classmethod
    def of(cls, craft: Craft) -> Body | None:
        """Return the body of a craft; None without a drawable pose. A track far from the craft's own is left out."""
        true = true_track(craft)
        rows = np.flatnonzero(np.isfinite(true.x + true.y + true.psi))
        if not rows.size:
            return None
        low, high = extent([true.x, true.y]) or (0.0, 0.0)
        reach, near = 2 * (high - low) + 2, list[Track | None]()
        for track in (estimated_track(craft), reference_track(craft)):
            span = extent([track.x, track.y]) if track is not None else None
            near.append(track if span and low - reach < span[0] and span[1] < high + reach else None)
        tilts, thrusts = ([craft.signal(name.format(s)) for s in SIDES] for name in ("tilt_{}_actual", "thrust_{}"))
        forces = [np.sin(a) * (t if is_drawn(t) else 1.0) for a, t in zip(tilts, thrusts, strict=True)]
        return cls(craft, true, near[0], near[1], tilts, forces, int(rows[-1]))

    @property
    def newtons_per_decimetre(self) -> float:
        """Return the scale of the arrows, a round number."""
        reach = extent(self.forces)
        largest = max(map(abs, reach)) if reach else 0.0
        return 1.0 if largest < 1e-9 else _round_up(100 * largest / ARROW)

    def drawn(self, rows: Rows, every: float) -> dict[str, Any]:
        """Return paths, poses without a script, size [mm], and a mark at equal time intervals, for the template."""
        start, scale = self.craft.run.start(self.craft.name), 100 / self.newtons_per_decimetre
        right, left = (
            float(tilt[self.last]) * DEGREES if math.isfinite(tilt[self.last]) else 0.0 for tilt in self.tilts
        )
        sizes = [
            (number(start.get(name), usual), usual) for name, usual in (("arm", ARM), ("propeller_radius", RADIUS))
        ]
        arm, radius = (round(1000 * (size if 0 < size < 100 else usual)) for size, usual in sizes)
        good, time, marks = np.isfinite(self.true.x + self.true.y), self.craft.run.time, []
        if good.sum() >= 2:
            first, last = time[good][[0, -1]]
            at = np.arange(math.ceil(first / every - 1e-9), math.floor(last / every + 1e-9) + 1) * every
            places = (np.interp(at, time[good], line[good]) for line in (self.true.right, self.true.down))
            marks = [(round(u), round(v)) for u, v in np.array([*places]).T.tolist()]
        return {
            "name": self.craft.name,
            "path": path(self.true, rows),
            "estimate": path(self.estimate, rows),
            "reference": path(self.reference, rows),
            "start": pose(self.true, 0),
            "pose": pose(self.true, self.last),
            "ghost": pose(self.estimate, self.last) if self.estimate else "",
            "arm": arm,
            "radius": radius,
            "right": right,
            "left": left,
            "arrows": [arrow(float(force[self.last]), scale) for force in self.forces],
            "limit": (self.craft.tilt_limit or 0.0) * DEGREES,
            "marks": marks,
        }

    def moving(self, rows: Rows, charts: Charts) -> dict[str, Any]:
        """Return craft and ghost [mm, °], forces, tilts [°] over time; the charts have every row of the tilts."""
        entry: dict[str, Any] = {"scale": round(100 / self.newtons_per_decimetre, 6)}
        for prefix, track in (("", self.true), ("g", estimated_track(self.craft))):
            if track is not None:
                for key, line, digits in (("u", track.right, 0), ("v", track.down, 0), ("a", track.turn, 1)):
                    entry[f"{prefix}{key}"] = round_values(line[rows], digits)
        for side, tilt, force in zip(SIDES, self.tilts, self.forces, strict=True):
            if is_drawn(tilt):
                entry[f"force_{side}"] = round_values(force[rows], 4)
                entry[f"tilt_{side}"] = round_values(tilt[rows] * DEGREES, 2)
                entry[f"tilt_{side}_key"] = charts.column(tilt * DEGREES)
        return entry


def make_view(bodies: Sequence[Body], rows: Rows) -> dict[str, Any]:
    """Return the picture of all crafts for the template: box [mm], grid, scale bar and bodies."""
    tracks = [track for body in bodies for track in (body.true, body.estimate, body.reference) if track is not None]
    x, y = (extent([getattr(track, axis) for track in tracks]) or (0.0, 0.0) for axis in "xy")
    tall, wide = x[1] - x[0] + 2 * MARGIN, y[1] - y[0] + 2 * MARGIN
    room = 0.03 * max(wide, tall) if max(wide, tall) > 4 else 0.0
    tall, wide = tall + 2 * room, wide + 2 * room
    wide, tall = max(wide, MIN_RATIO * tall), max(tall, wide / MAX_RATIO)
    left, top = (math.floor(1000 * middle) for middle in (-(y[0] + y[1]) / 2 - wide / 2, -(x[0] + x[1]) / 2 - tall / 2))
    width, height = math.ceil(1000 * wide), math.ceil(1000 * tall)
    bar = _round_up(width / 1000 / 8)
    first, last = extent([bodies[0].craft.run.time]) or (0.0, 1.0)
    every = _round_up(max(last - first, 1e-6) / 24)
    drawn, note = [body.drawn(rows, every) for body in bodies], ""
    if is_drawn(bodies[0].tilts[0]):
        note = f"arrows: horizontal thrust, 10 cm = {bodies[0].newtons_per_decimetre:g} N"
        if not is_drawn(bodies[0].craft.signal("thrust_right")):
            note = "arrows: sine of the tilt"
    return {
        "box": (left, top, width, height),  # of all tracks [mm]
        "across": _ticks(-(left + width) / 1000, -left / 1000, 6),
        "up": _ticks(-(top + height) / 1000, -top / 1000, 4),
        "bar_share": 100 * bar * 1000 / width,
        "bar_label": f"{bar:g} m",
        "magnified": max(1.0, MIN_SIZE * width / (2000 * (ARM + RADIUS))),
        "thrust_note": note,
        "mark_note": f"a dot every {every:g} s" if drawn[0]["marks"] else "",
        "bodies": drawn,
    }
