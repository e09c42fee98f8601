"""Analysis of the crafts in a run: estimators, references, responses, effort, saturation, errors; their picture.

Component names are chosen by the user, so variables define the roles: a craft has `x_world`, `y_world` and `psi`, an
estimator has `x_hat` and `x_sigma`. Connections assign the estimators to crafts. Figures use every row and SI units.

In the picture from above, world X points up, Y to the left; coordinates are whole millimetres: right = −Y, down = −X.
Path and craft have one scale. On a long path, the craft is magnified by a factor stated on the page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from controller.settings import SIDES, Settings
from cosim.core.arrays import Array, Rows
from cosim.core.units import DEGREES, read_quantity
from cosim.report.charts import Charts, round_values
from cosim.report.panels import extent
from cosim.simulation import criteria
from cosim.simulation.report.recorded import Run, number
from plant.hovercraft import Hovercraft

SIDE_COLOURS = {"right": "warm", "left": "cool"}
SETTLING_BAND = 0.02  # m and rad: 2 % of the unit steps in the thesis
MERGED_RAMP_S = 0.1  # s; changes of a reference closer than this are one ramp
TILT_MAX = Settings().tilt_max  # [rad], default of the controller FMUs


@dataclass(frozen=True)
class Craft:
    """A craft with its estimator and controller; a signal that is not recorded is NaN."""

    run: Run
    name: str
    estimator: str | None

    def recorded(self, column: str | None) -> Array:
        """Return a column of the results."""
        line = self.run.signal(column or "")
        return np.full(self.run.time.size, math.nan) if line is None else line

    def signal(self, variable: str) -> Array:
        """Return a variable of the craft."""
        return self.recorded(f"{self.name}.{variable}")

    def estimate(self, variable: str) -> Array:
        """Return a variable of the estimator."""
        return self.recorded(self.estimator and f"{self.estimator}.{variable}")

    def reference_column(self, variable: str) -> str | None:
        """Return the reference column of `x` or `psi`.

        The column is the source of the controller's input, else the input.
        """
        own = f"{self.estimator}.{variable}_ref"
        columns = (self.run.source(own), own) if self.estimator else ()
        return next((column for column in columns if column is not None and column in self.run.results), None)

    def reference(self, variable: str) -> Array:
        """Return the reference of `x` or `psi`, recorded or constant."""
        if column := self.reference_column(variable):
            return self.run.results[column]
        return np.full(self.run.time.size, number(self.run.start(self.estimator).get(f"{variable}_ref")))

    def command(self, variable: str) -> Array:
        """Return a tilt command of the craft or controller."""
        here = self.signal(variable)
        return here if is_drawn(here) else self.estimate(variable)

    @property
    def tilt_limit(self) -> float | None:
        """Return the limit of the tilt commands [rad].

        Without a start value, the default applies if no command exceeds it.
        """
        given = self.run.start(self.estimator).get("tilt_max")
        try:
            limit = read_quantity(given, "rad") if isinstance(given, str) else number(given)  # such as `12 deg`
        except ValueError:
            limit = math.nan
        if np.isfinite(limit) and limit > 0:
            return limit
        spans = [extent([self.command(f"tilt_{side}")]) for side in SIDES]
        if self.estimator is None or None in spans:
            return None
        return TILT_MAX if max(abs(end) for span in spans for end in span or ()) <= TILT_MAX * 1.001 else None


def is_drawn(*lines: Array) -> bool:
    """Return True if each line has a finite value."""
    return all(np.isfinite(line).any() for line in lines)


def find_crafts(run: Run) -> list[Craft]:
    """Return every craft with the estimator downstream of it."""
    names = [name for name, has in run.variables.items() if {"x_world", "y_world", "psi"} <= has]
    estimators = [name for name, has in run.variables.items() if {"x_hat", "x_sigma"} <= has]
    # A single craft and a single estimator belong together, even without connections in the manifest.
    alone = len(names) == len(estimators) == 1
    return [Craft(run, name, estimators[0] if alone else _downstream(run, name, estimators, names)) for name in names]


def _downstream(run: Run, start: str, names: Iterable[str], blocked: Iterable[str]) -> str | None:
    """Return the first of `names` downstream of `start`, without passing through `blocked` components."""
    edges = [(source.partition(".")[0], target.partition(".")[0]) for source, target in run.links]
    visited, front = {start, *blocked}, [start]
    while front:
        front = list(dict.fromkeys(target for source, target in edges if source in front and target not in visited))
        visited.update(front)
        for component in front:
            if component in names:
                return component
    return None


class Response(NamedTuple):
    """Response of a signal to one change of its reference, in SI units."""

    variable: str
    time: float
    start: float
    target: float
    ramp: float
    settling: float
    believed: float
    overshoot: float
    rms: float
    final: float


def reference_steps(time: Array, reference: Array) -> list[tuple[int, int, int]]:
    """Return the rows of begin, arrival and end of each change of a reference.

    Row 0 counts as a change. Changes within MERGED_RAMP_S form one ramp; a change ends at the next one.
    """
    rows = np.flatnonzero(np.abs(np.diff(reference)) > 1e-12) + 1
    apart = (np.diff(rows) > 1) & (np.diff(time[rows]) > MERGED_RAMP_S)
    ramps = [ramp.tolist() for ramp in np.split(rows, np.flatnonzero(apart) + 1) if ramp.size]
    begins = [0, *(ramp[0] for ramp in ramps)]
    return list(zip(begins, [0, *(ramp[-1] for ramp in ramps)], [*begins[1:], reference.size], strict=True))


def responses(craft: Craft, variable: str) -> list[Response]:
    """Return the responses to each change of a reference."""
    good, signal, target = finite(craft.signal(variable), craft.reference(variable))
    if not good.any():
        return []
    time, estimate = craft.run.time[good], craft.estimate(f"{variable}_hat")[good]
    steps = reference_steps(time, target)
    # A start on target is a response only if the reference never changes.
    if len(steps) > 1 and abs(signal[0] - target[0]) <= SETTLING_BAND:
        steps = steps[1:]
    found = []
    for begin, arrived, end in steps:
        final, after = float(target[end - 1]), slice(arrived, end)
        moving = end - arrived < 2  # an unfinished ramp, or a change in the last row
        settling, believed = (
            criteria.settling_time(time[after], line[after], final, SETTLING_BAND)
            if is_drawn(line) and not moving
            else math.nan
            for line in (signal, estimate)
        )
        whole, wanted = signal[begin:end], target[begin:end]
        found.append(
            Response(
                variable,
                float(time[begin]),
                float(target[begin - 1] if begin else signal[0]),
                final,
                float(time[arrived] - time[begin]),
                settling,
                believed,
                criteria.overshoot(whole, final),
                criteria.rms_error(whole, wanted),
                criteria.final_error(whole, wanted),
            )
        )
    return found


def finite(*lines: Array) -> list[Array]:
    """Return the rows in which every line is finite, and the lines in these rows."""
    good = np.all(np.isfinite(lines), axis=0)
    return [good, *(line[good] for line in lines)]


def error_rms(signal: Array, target: Array) -> float:
    """Return the RMS error over finite rows, else NaN."""
    good, *lines = finite(signal, target)
    return criteria.rms_error(*lines) if good.any() else math.nan


def saturation(craft: Craft, side: str) -> float:
    """Return the share of time at the tilt limit; commands are constant between rows."""
    command, limit, time = craft.command(f"tilt_{side}"), craft.tilt_limit, craft.run.time
    if limit is None or time.size < 2 or not is_drawn(command):
        return math.nan
    steps = np.diff(time)
    at_limit = np.abs(command[:-1]) >= limit * (1 - 1e-6)
    return float(steps[at_limit].sum() / steps.sum())


def inside_band(craft: Craft, variable: str) -> float:
    """Return the share of rows in which the truth is within the estimator's ±2σ band."""
    names = (f"{variable}_hat", f"{variable}_sigma")
    good, true, estimate, sigma = finite(craft.signal(variable), *map(craft.estimate, names))
    # At the start P = 0 and the estimate is exact, so rounding must not count as outside.
    return float(np.mean(np.abs(estimate - true) <= 2 * sigma + 1e-9)) if good.any() else math.nan


DEFAULT_CRAFT = Hovercraft()
ARM, RADIUS = DEFAULT_CRAFT.arm, DEFAULT_CRAFT.propeller_radius  # [m], defaults of the start values
PATH_MARGIN_M = 0.42  # m around the path: half a craft and a margin
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

    def drawn(self, rows: Rows) -> list[list[float | None]]:
        """Return the positions to the right and down [mm], and the clockwise rotation [°] from nose up."""
        lines = (-1000 * self.y, 0), (-1000 * self.x, 0), (-DEGREES * self.psi, 1)
        return [round_values(line[rows], digits) for line, digits in lines]


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


def make_view(crafts: Sequence[Craft], rows: Rows, charts: Charts) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the picture of crafts with a drawable pose: box [mm] and sizes for the template, and data of the script.

    Data of a craft are poses of true, estimated and reference track, tilts [°], horizontal forces [N] (or the sine of
    the tilt without recorded thrust) with their scale; the charts have every row of the tilts.
    """
    bodies, tracks = list[dict[str, Any]](), list[Track]()
    for craft in crafts:
        true = true_track(craft)
        if not is_drawn(true.x + true.y + true.psi):
            continue
        low, high = extent([true.x, true.y]) or (0.0, 0.0)
        reach, near = 2 * (high - low) + 2, {"true": true}
        for name, track in (("estimate", estimated_track(craft)), ("reference", reference_track(craft))):
            span = extent([track.x, track.y]) if track is not None else None
            if track and span and low - reach < span[0] and span[1] < high + reach:  # not far from the craft's own
                near[name] = track
        tracks += near.values()
        bodies.append(_body(craft, rows, charts) | {name: track.drawn(rows) for name, track in near.items()})
    x, y = (extent([getattr(track, axis) for track in tracks]) or (0.0, 0.0) for axis in "xy")
    tall, wide = x[1] - x[0] + 2 * PATH_MARGIN_M, y[1] - y[0] + 2 * PATH_MARGIN_M
    room = 0.03 * max(wide, tall) if max(wide, tall) > 4 else 0.0
    tall, wide = tall + 2 * room, wide + 2 * room
    wide, tall = max(wide, MIN_RATIO * tall), max(tall, wide / MAX_RATIO)
    left, top = (math.floor(1000 * middle) for middle in (-(y[0] + y[1]) / 2 - wide / 2, -(x[0] + x[1]) / 2 - tall / 2))
    box = left, top, math.ceil(1000 * wide), math.ceil(1000 * tall)
    return {"box": box, "magnified": max(1.0, MIN_SIZE * box[2] / (2000 * (ARM + RADIUS))), "bodies": bodies}, bodies


def _body(craft: Craft, rows: Rows, charts: Charts) -> dict[str, Any]:
    start: Mapping[str, Any] = craft.run.start(craft.name)
    body: dict[str, Any] = {"estimate": None, "reference": None, "unit": "N"}
    body["limit"] = (craft.tilt_limit or 0.0) * DEGREES
    for key, name, usual in (("arm", "arm", ARM), ("radius", "propeller_radius", RADIUS)):
        size = number(start.get(name), usual)
        body[key] = round(1000 * (size if 0 < size < 100 else usual))
    forces = []
    for side in SIDES:
        tilt, thrust = craft.signal(f"tilt_{side}_actual"), craft.signal(f"thrust_{side}")
        if not is_drawn(thrust):
            thrust, body["unit"] = np.ones(tilt.size), ""
        forces.append(np.sin(tilt) * thrust)
        if is_drawn(tilt):
            body[f"force_{side}"] = round_values(forces[-1][rows], 4)
            body[f"tilt_{side}"] = round_values(tilt[rows] * DEGREES, 2)
            body[f"tilt_{side}_key"] = charts.column(tilt * DEGREES)
    largest = max(map(abs, extent(forces) or (0.0,)))
    return body | {"force": 100 * largest / ARROW if largest > 1e-9 else 1.0}  # of an arrow of 10 cm, to be rounded up
