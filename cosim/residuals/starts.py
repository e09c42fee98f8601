"""Where a replay starts: a simple estimate of the state out of the measurements, for any FMU with start parameters.

The FMU carries what is fast, the measurements what is slow: over the last PAST seconds the difference
measured − carrier is fitted by a parabola in time, and its end corrects the carrier's state there. The carrier
is the window before: over a whole log even a right model drifts. Angle and rate share one parabola, weighted by
their noise. States that are not measured are the carrier's, those that no output shows too, where the FMU is one
of ours: its state can be read and put back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.base.errors import SimulationError
from cosim.base.linear_algebra import least_squares
from cosim.fmi.state import MEMORY, STATE, Memory, Own
from cosim.logs.channel_noise import noise_beside, noise_level
from cosim.logs.log import Log
from cosim.model.namespaces import SCALAR
from cosim.model.planar import local_vector, world_velocity
from cosim.model.traits import rate_of
from cosim.residuals.drive import Drive, as_columns, rows_of

PAST = 0.5  # [s] before a window
FIRST = 1.0  # [s] after the start of the log, where there is no past
REACHES = (1.0, 0.5, 0.25, 0.12)  # parts of that, the longest that fits
FITS = 2.5  # times the noise's variance; noise alone makes more of half a second at 50 Hz once in 10⁴
FEWEST = 6  # samples of a parabola
LEAST = 4  # samples of a channel; slow sensors look further away
PASSES = 4  # over the first second
OLDEST = 2.0  # [s] from which even a slow sensor's samples say nothing
Error = tuple[Array, float, bool]  # measured − carrier, its noise, whether it is the rate's


@dataclass(frozen=True)
class StartParameter:
    """A start parameter that an output shows: output = gain·parameter when initialized, as `tried` with two values.

    places: where it stands in the state of an FMU of ours; empty for another, whose state cannot be read
    """

    name: str
    gain: float
    low: float
    high: float
    tried: tuple[float, float]
    places: tuple[int, ...] = ()

    def value(self, output: float) -> float:
        """The parameter that makes the output this value."""
        return min(max(output / self.gain, self.low), self.high)


def start_parameters(drive: Drive) -> dict[str, StartParameter]:
    """Output → the start parameter it shows, found by trying: `angle_start` of `angle` or of `angle_actual`.

    One that its output does not follow in proportion is of something else and left alone.
    """
    variables = {v.name: v for v in drive.description.modelVariables if v.type == "Real" and v.causality == "parameter"}
    found = {}
    for output in drive.outputs:
        names = (f"{output}_start", f"{output.removesuffix('_actual')}_start")
        variable = next((variables[n] for n in names if n in variables), None)
        if variable is not None and (parameter := _tried(drive, output, variable)) is not None:
            found[output] = parameter
    return _with_places(drive, found)


def _with_places(drive: Drive, found: dict[str, StartParameter]) -> dict[str, StartParameter]:
    """Return start parameters with their places in the state, if it is readable: what moves with each."""
    if not found or not drive.has_readable_state:
        return found
    tried = {p.name: p.tried[0] for p in found.values()}
    try:
        before = drive.own(tried)[STATE]
        after = {output: drive.own(tried | {p.name: p.tried[1]})[STATE] for output, p in found.items()}
    except (SimulationError, ValueError, KeyError, TypeError):
        return found
    moved = {n: tuple(k for k, a in enumerate(s) if a != before[k]) for n, s in after.items()}
    return {n: replace(p, places=moved[n]) for n, p in found.items()} if all(moved.values()) else found


def _tried(drive: Drive, output: str, variable: Any) -> StartParameter | None:
    default, (low, high) = float(variable.start or 0.0), _limits(variable)
    width = 0.1 * max(1.0, abs(default))
    tries = [
        v for v in (default + width, default + 2 * width, default - width, default - 2 * width) if low <= v <= high
    ]
    if len(tries) < 2:
        return None
    try:
        shown = [drive.initial({variable.name: v}, 0)[output] for v in tries[:2]]
    except SimulationError:
        return None
    gain = (shown[1] - shown[0]) / (tries[1] - tries[0])
    proportional = abs(shown[0] - gain * tries[0]) <= 1e-6 * max(map(abs, shown))
    if not proportional or abs(gain) <= 1e-9:
        return None
    return StartParameter(variable.name, gain, low, high, (tries[0], tries[1]))


def _limits(variable: Any) -> tuple[float, float]:
    low, high = (None if v is None else float(v) for v in (variable.min, variable.max))
    return -math.inf if low is None else low, math.inf if high is None else high


def first_start(drive: Drive, parameters: Mapping[str, StartParameter]) -> dict[str, float]:
    """Start of the free run: what fits the first second best; states nobody measured start where the FMU does."""
    log = drive.log
    seen = {name: values[np.isfinite(values)] for name, values in log.outputs.items() if name in parameters}
    given = {p.name: drive.given[p.name] for p in parameters.values() if p.name in drive.given}
    start = {parameters[name].name: parameters[name].value(float(values[0])) for name, values in seen.items()} | given
    sigma = noise_levels(log)
    last = max(rows_of(log, 0, FIRST * log.slowness), min(FEWEST, log.rows - 1))
    for _ in range(PASSES if seen else 0):
        carrier = as_columns(drive.run(0, last, start), drive.outputs)
        state = {name: float(carrier[name][0]) for name in parameters}
        corrected = _corrected(drive, carrier, sigma, state, 0, np.arange(last + 1))
        start = start | {parameters[n].name: parameters[n].value(value) for n, value in corrected.items()} | given
    return start


def window_start(
    drive: Drive,
    parameters: Mapping[str, StartParameter],
    sigma: Mapping[str, float],
    carrier: Mapping[str, Array],
    since: int,
    k: int,
) -> dict[str, float]:
    """Start of a window at row k, from what carries to there from row `since` on and the measurements up to it.

    Of an FMU of ours only what the measurements correct: the rest of its state is kept, see `kept`.
    """
    log = drive.log
    state = {name: float(carrier[name][k]) for name in parameters}
    oldest = int(np.searchsorted(log.time, log.time[k] - OLDEST * log.slowness))
    corrected = _corrected(drive, carrier, sigma, state, k, np.arange(max(since, oldest), k + 1))
    state = corrected if readable(parameters) else state | corrected
    return {parameters[name].name: parameters[name].value(value) for name, value in state.items()}


def noise_levels(log: Log, model: Mapping[str, Array] | None = None) -> dict[str, float]:
    """Channel → its noise, by which it is weighted; estimated better beside a run of the model."""
    return {name: sigma_of(values, (model or {}).get(name)) for name, values in log.outputs.items()}


def readable(parameters: Mapping[str, StartParameter]) -> bool:
    """Whether the FMU's state can be read and put back: it is one of ours."""
    return any(p.places for p in parameters.values())


def kept(own: Own, parameters: Mapping[str, StartParameter], start: Mapping[str, float]) -> Memory:
    """All of an FMU's state but what these start values set."""
    given = {(STATE, k) for p in parameters.values() if p.name in start for k in p.places}
    whole = {(part, k): value for part in (STATE, MEMORY) for k, value in enumerate(own[part])}
    return {place: value for place, value in whole.items() if place not in given}


def _corrected(
    drive: Drive,
    carrier: Mapping[str, Array],
    sigma: Mapping[str, float],
    state: Mapping[str, float],
    at: int,
    rows: Rows,
) -> dict[str, float]:
    """Return what the measurements at `rows` correct of the state at row `at`."""
    log, changes, slopes = drive.log, dict[str, float](), dict[str, float]()
    rates = {rate_of(name, log.outputs) for name in log.outputs}
    for name in log.outputs:
        if name not in carrier or name in rates:
            continue  # a rate is corrected together with its integral
        rate = rate_of(name, carrier)
        channels = [name, rate] if rate is not None and rate in log.outputs else [name]
        errors = [(log.outputs[c][rows] - carrier[c][rows], sigma[c], c == rate) for c in channels]
        value, slope = _parabola(log, errors, at, rows)
        if value is not None:
            changes[name] = value
        if slope is not None:
            slopes[name] = slope
            if rate is not None:
                changes[rate] = slope
    corrected = {name: state[name] + change for name, change in changes.items() if name in state}
    return corrected | _velocity(drive, state, corrected, slopes)


def _velocity(
    drive: Drive, state: Mapping[str, float], corrected: Mapping[str, float], slopes: Mapping[str, float]
) -> dict[str, float]:
    """Return the local velocity at the corrected heading; nothing if it is measured or the position is not."""
    frame = drive.frame
    if frame is None or frame.forward in drive.log.outputs:
        return {}
    if not ({frame.x, frame.y} <= slopes.keys() and frame.local <= state.keys()):
        return {}
    x, y = world_velocity(SCALAR, state[frame.heading], state[frame.forward], state[frame.right])
    heading = corrected.get(frame.heading, state[frame.heading])
    forward, right = local_vector(SCALAR, heading, x + slopes[frame.x], y + slopes[frame.y])
    return {frame.forward: forward, frame.right: right}


def _parabola(log: Log, errors: Sequence[Error], at: int, rows: Rows) -> tuple[float | None, float | None]:
    """Value and slope at row `at` of the parabola through measured − carrier, and its slope through the rate's.

    Over the longest stretch on which it fits to within the noise: a model that lacks much is carried less far.
    """
    ahead = bool(rows.size and rows[-1] > at)
    found: tuple[float | None, float | None] = None, None
    for reach in REACHES:
        design, side = _equations(log, errors, at, rows, reach * log.slowness * (FIRST if ahead else PAST))
        order = 3 if side.size >= FEWEST else 2 if side.size >= 3 else 1
        if side.size < order:
            break
        design = design[:, :order]
        value, *rest = least_squares(design, side)
        found = float(value), float(rest[0]) if rest else None
        left = side - design @ (value, *rest)
        if float(left @ left) <= FITS * max(1, side.size - order):
            break
    return found


def _equations(log: Log, errors: Sequence[Error], at: int, rows: Rows, reach: float) -> tuple[Array, Array]:
    """Weighted equations of (value, slope, curvature) at row `at`, from the errors within `reach` seconds of it."""
    designs, sides = [], []
    for error, sigma, derived in errors:
        good = np.isfinite(error)
        near, values = _near(log, rows[good], at, reach), error[good]
        tau = log.time[rows[good]][near] - log.time[at]
        one, zero = np.ones(tau.size), np.zeros(tau.size)
        designs.append(np.column_stack((zero, one, tau) if derived else (one, tau, 0.5 * tau**2)) / sigma)
        sides.append(values[near] / sigma)
    return np.vstack(designs), np.concatenate(sides)


def _near(log: Log, rows: Rows, at: int, reach: float) -> Rows:
    """Places of the rows within `reach` seconds of row `at`, or of the nearest few."""
    away = np.abs(log.time[rows] - log.time[at])
    near: Rows = np.flatnonzero(away <= reach + 1e-9)
    if near.size < LEAST:
        nearest = np.argsort(away, kind="stable")[:LEAST]
        near = np.sort(nearest[away[nearest] <= OLDEST * log.slowness])
    return near


def sigma_of(values: Array, model: Array | None = None) -> float:
    """Noise of a channel; of one without noise, its rounding."""
    level = noise_level(values) if model is None else noise_beside(values, model)
    floor = 1e-6 * float(np.nanmax(np.abs(values)))
    return max(floor, 1e-12) if math.isnan(level) else max(level, floor, 1e-12)
