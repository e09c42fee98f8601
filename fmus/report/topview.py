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
from cosim.core.text import DEGREES, MINUS
from cosim.report.charts import Charts, round_values
from cosim.report.panels import extent
from cosim.simulation.report.recorded import number
from fmus.report.craft import SIDES, Craft
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
    results = craft.run.results
    return make_track(*(results[f"{craft.name}.{name}"] for name in ("x_world", "y_world", "psi")))


def estimated_track(craft: Craft) -> Track | None:
    """Return the estimated track, made of estimated distance and estimated heading; None without one."""
    x_hat, psi_hat = craft.estimate("x_hat"), craft.estimate("psi_hat")
    return None if x_hat is None or psi_hat is None else _lay_out(craft, x_hat, psi_hat)


def reference_track(craft: Craft) -> Track | None:
    """Return the track of the references if the craft begins on it."""
    x, x_ref, psi_ref = craft.signal("x"), craft.reference("x"), craft.reference("psi")
    if x is None or x_ref is None or psi_ref is None or not x.size or not abs(x_ref[0] - x[0]) <= ON_TARGET:
        return None
    return _lay_out(craft, x_ref, psi_ref)


def _lay_out(craft: Craft, way: Array, heading: Array) -> Track:
    """Return the track of a distance along a heading, from the craft's start."""
    begin, x = true_track(craft), craft.signal("x")
    steps = np.diff(way, prepend=way[0] if x is None else x[0])
    ahead, aside = np.cumsum(steps * np.cos(heading)), np.cumsum(steps * np.sin(heading))
    return make_track(begin.x[0] + ahead, begin.y[0] + aside, heading)


def horizontal_thrust(craft: Craft, side: str) -> Array | None:
    """Return the thrust along the craft's axis.

    T·sin α [N], or sin α without recorded thrust.
    """
    tilt, thrust = craft.signal(f"tilt_{side}_actual"), craft.signal(f"thrust_{side}")
    if tilt is None:
        return None
    return np.sin(tilt) if thrust is None else thrust * np.sin(tilt)


def pose(track: Track, row: int) -> str:
    """Return the SVG transform of a pose."""
    values = (track.right[row], track.down[row], track.turn[row])
    if not all(map(math.isfinite, values)):
        return ""
    return f"translate({values[0]:.0f} {values[1]:.0f}) rotate({values[2]:.2f})"


def last_row(track: Track) -> int | None:
    """Return the last drawable row."""
    rows = np.flatnonzero(np.isfinite(track.x) & np.isfinite(track.y) & np.isfinite(track.psi))
    return int(rows[-1]) if rows.size else None


def path(track: Track | None, rows: Rows) -> str:
    """Return the path of a track, broken at gaps."""
    if track is None:
        return ""
    pieces, is_open = [], False
    for right, down in zip(track.right[rows].tolist(), track.down[rows].tolist(), strict=True):
        is_drawn = math.isfinite(right) and math.isfinite(down)
        if is_drawn:
            pieces.append(f"{'L' if is_open else 'M'}{right:.0f} {down:.0f}")
        is_open = is_drawn
    return "".join(pieces)


def arrow(force: float, per_newton: float) -> str:
    """Return an arrow along the craft's axis, "" if too short."""
    reach = force * per_newton
    if not abs(reach) >= 8:
        return ""
    barb = math.copysign(min(34.0, abs(reach)), reach)
    return f"M0 0V{-reach:.0f}M-20 {-reach + barb:.0f}L0 {-reach:.0f}L20 {-reach + barb:.0f}"


def newtons_per_decimetre(craft: Craft) -> float:
    """Return the scale of the arrows, a round number."""
    reach = extent([force for side in SIDES if (force := horizontal_thrust(craft, side)) is not None])
    largest = max(map(abs, reach)) if reach else 0.0
    return 1.0 if largest < 1e-9 else _round_up(100 * largest / ARROW)


def _round_up(step: float) -> float:
    """Return a step rounded up to 1, 2, 2.5 or 5 × 10^n."""
    power = 10.0 ** math.floor(math.log10(step))
    return next((m * power for m in (1, 2, 2.5, 5) if m * power >= step * (1 - 1e-9)), 10 * power)


def _ticks(low: float, high: float, count: int) -> tuple[dict[str, Any], ...]:
    """Return about `count` round labels between two ends, each at a share of the picture's size."""
    step = _round_up((high - low) / count)
    decimals = next(d for d in range(20) if abs(step * 10**d - round(step * 10**d)) < 1e-6)
    places = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return tuple(
        {"at": (i * step - low) / (high - low), "label": f"{i * step:.{decimals}f}".replace("-", MINUS)} for i in places
    )


def make_view(crafts: Sequence[Craft], rows: Rows) -> dict[str, Any] | None:
    """Return the picture of all crafts with drawable poses for the template: box [mm], grid, scale bar and bodies."""
    crafts = [craft for craft in crafts if last_row(true_track(craft)) is not None]
    if not crafts:
        return None
    tracks = [track for craft in crafts for track in (true_track(craft), *_companions(craft)) if track is not None]
    nowhere = (0.0, 0.0)
    x, y = extent([track.x for track in tracks]) or nowhere, extent([track.y for track in tracks]) or nowhere
    tall, wide = x[1] - x[0] + 2 * MARGIN, y[1] - y[0] + 2 * MARGIN
    room = 0.03 * max(wide, tall) if max(wide, tall) > 4 else 0.0
    tall, wide = tall + 2 * room, wide + 2 * room
    wide, tall = max(wide, MIN_RATIO * tall), max(tall, wide / MAX_RATIO)
    left, top = (math.floor(1000 * middle) for middle in (-(y[0] + y[1]) / 2 - wide / 2, -(x[0] + x[1]) / 2 - tall / 2))
    width, height = math.ceil(1000 * wide), math.ceil(1000 * tall)
    box = left, top, width, height  # of all tracks [mm]
    across = _ticks(-(left + width) / 1000, -left / 1000, 6)
    up = _ticks(-(top + height) / 1000, -top / 1000, 4)
    bar = _round_up(width / 1000 / 8)
    magnified = max(1.0, MIN_SIZE * width / (2000 * (ARM + RADIUS)))
    first, last = extent([crafts[0].run.time]) or (0.0, 1.0)
    every = _round_up(max(last - first, 1e-6) / 24)
    bodies = [_body(craft, rows, every) for craft in crafts]
    note, marks = "", f"a dot every {every:g} s" if bodies[0]["marks"] else ""
    if horizontal_thrust(crafts[0], "right") is not None:
        recorded = crafts[0].signal("thrust_right") is not None
        scale = f"10 cm = {newtons_per_decimetre(crafts[0]):g} N"
        note = f"arrows: horizontal thrust, {scale}" if recorded else "arrows: sine of the tilt"
    return {
        "box": box,
        "across": across,
        "up": up,
        "bar_share": 100 * bar * 1000 / width,
        "bar_label": f"{bar:g} m",
        "magnified": magnified,
        "thrust_note": note,
        "mark_note": marks,
        "bodies": bodies,
    }


def _companions(craft: Craft) -> list[Track | None]:
    """Return the estimated and the reference track; None for a track far from the craft's own."""
    true = true_track(craft)
    own = extent([true.x, true.y]) or (0.0, 0.0)
    reach = 2 * (own[1] - own[0]) + 2
    tracks = []
    for track in (estimated_track(craft), reference_track(craft)):
        span = extent([track.x, track.y]) if track is not None else None
        near = span is not None and span[0] > own[0] - reach and span[1] < own[1] + reach
        tracks.append(track if near else None)
    return tracks


def _body(craft: Craft, rows: Rows, every: float) -> dict[str, Any]:
    """Return a craft in the picture: paths, poses without a script, and size [mm]."""
    true, (estimate, reference) = true_track(craft), _companions(craft)
    last, start = last_row(true) or 0, craft.run.start(craft.name)
    forces = [horizontal_thrust(craft, side) for side in SIDES]
    tilts = [craft.signal(f"tilt_{side}_actual") for side in SIDES]
    scale = 100 / newtons_per_decimetre(craft)
    right, left = (0.0 if tilt is None else number(tilt[last], 0.0) * DEGREES for tilt in tilts)
    sizes = [(number(start.get(name), usual), usual) for name, usual in (("arm", ARM), ("propeller_radius", RADIUS))]
    arm, radius = (round(1000 * (size if 0 < size < 100 else usual)) for size, usual in sizes)
    arrows = tuple("" if force is None else arrow(float(force[last]), scale) for force in forces)
    return {
        "name": craft.name,
        "path": path(true, rows),
        "estimate": path(estimate, rows),
        "reference": path(reference, rows),
        "start": pose(true, 0),
        "pose": pose(true, last),
        "ghost": pose(estimate, last) if estimate else "",
        "arm": arm,
        "radius": radius,
        "right": right if math.isfinite(right) else 0.0,
        "left": left if math.isfinite(left) else 0.0,
        "arrows": arrows,
        "limit": (craft.tilt_limit or 0.0) * DEGREES,
        "marks": _marks(true, craft.run.time, every),
    }


def _marks(track: Track, time: Array, every: float) -> tuple[tuple[int, int], ...]:
    """Return the craft's positions at equal time intervals."""
    good = np.isfinite(track.x) & np.isfinite(track.y)
    if good.sum() < 2:
        return ()
    first, last = time[good][0], time[good][-1]
    at = np.arange(math.ceil(first / every - 1e-9), math.floor(last / every + 1e-9) + 1) * every
    u, v = (np.interp(at, time[good], line[good]) for line in (track.right, track.down))
    return tuple((round(a), round(b)) for a, b in zip(u.tolist(), v.tolist(), strict=True))


def poses(craft: Craft, rows: Rows, charts: Charts) -> dict[str, Any]:
    """Return the moving parts of the picture.

    These are craft and ghost [mm, °], forces and tilts [°]; the charts have every row of the tilts.
    """
    entry: dict[str, Any] = {"scale": round(100 / newtons_per_decimetre(craft), 6)}
    for prefix, track in (("", true_track(craft)), ("g", estimated_track(craft))):
        if track is not None:
            for key, line, digits in (("u", track.right, 0), ("v", track.down, 0), ("a", track.turn, 1)):
                entry[f"{prefix}{key}"] = round_values(line[rows], digits)
    for side in SIDES:
        force, tilt = horizontal_thrust(craft, side), craft.signal(f"tilt_{side}_actual")
        if force is not None and tilt is not None:
            entry[f"force_{side}"] = round_values(force[rows], 4)
            entry[f"tilt_{side}"] = round_values(tilt[rows] * DEGREES, 2)
            entry[f"tilt_{side}_key"] = charts.column(tilt * DEGREES)
    return entry
