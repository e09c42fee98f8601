"""Replays of recorded commands through an FMU, as a free run or in windows.

For a model with integrating states, a long free run does not measure its quality. A window is a short replay: it starts
at a row from a state estimated from past data, and lasts one horizon.

The start state is estimated for any FMU with start parameters. The FMU provides fast motion, the measurements the slow
part: over the last PAST_S seconds the difference measured − carrier is fitted by a parabola in time, whose end corrects
the carrier's state. The carrier is the previous window, because even a correct model drifts over a whole log. Angle and
rate share one parabola, weighted by their noise. Unmeasured states come from the carrier, including states without an
output if the FMU is a cosim FMU with readable state.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np

from cosim.core.arrays import Array, NamedArrays, NamedValues, Rows
from cosim.core.errors import SimulationError
from cosim.core.linear_algebra import least_squares
from cosim.fmi.fmi_types import DOUBLE_TYPES
from cosim.fmi.state import MEMORY, STATE, Memory, Own
from cosim.logs.log import Log, least_noise_level, noise_level, stretches
from cosim.model.namespaces import SCALAR
from cosim.model.planar import local_vector, world_velocity
from cosim.model.traits import rate_of
from cosim.residuals.drive import Drive, as_columns, coarse_rounding, rows_of
from cosim.residuals.residual_statistics import FREE_RUN

SKIPPED = 2.0  # [s] at the start of a log, in which a filter settles
HORIZONS = (0.5, 2.0)  # [s], the second one is decisive
PAST_S = 0.5  # [s] before a window
FIRST_S = 1.0  # [s] after the start of the log, without a past
REACHES = (1.0, 0.5, 0.25, 0.12)  # shares of that time; the longest valid one is used
FITS = 2.5  # multiple of the noise variance; exceeded by noise once in 10⁴ for half a second at 50 Hz
MIN_PARABOLA_SAMPLES = 6  # samples of a parabola
MIN_SLOPE_SAMPLES = 4  # samples of a channel; slow sensors use a longer time
PASSES = 4  # passes over the first second
OLDEST = 2.0  # [s] oldest useful sample, even of a slow sensor
Error = tuple[Array, float, bool]  # measured − carrier, its noise, True for the rate


@dataclass(frozen=True, eq=False)
class Replay:
    """Outputs of an FMU at the rows of a log.

    Attributes:
        horizon: Length of each replay [s]; FREE_RUN for one replay of the whole log.
        starts: First row of each replay → start values.
        outputs: Name → (rows,), NaN without a prediction.
        states: Possible first row of a chain of windows → state, for an FMU built by cosim.
        parameters: Output → start parameter of the FMU; only in a free run.
    """

    horizon: float
    starts: Mapping[int, Mapping[str, Any]]
    outputs: NamedArrays
    states: Mapping[int, Own] = field(default_factory=dict)
    parameters: Mapping[str, StartParameter] = field(default_factory=dict)

    def errors(self, log: Log) -> dict[str, Array]:
        """Return channel → measured − model; rows without a measured or model value are NaN."""
        return {name: values - self.outputs[name] for name, values in log.outputs.items()}


def free_run(drive: Drive, parameters: Mapping[str, StartParameter] | None = None) -> Replay:
    """Return a replay of the whole log, started from values that fit its first measurements."""
    parameters = start_parameters(drive) if parameters is None else parameters
    log, chosen = drive.log, first_start(drive, parameters)
    rows = {chain[0] for span in horizons(log) for chain, _ in chains(log, span)} if readable(parameters) else set()
    table, states = drive.run_and_keep(0, log.rows - 1, chosen, rows)
    return Replay(FREE_RUN, {0: chosen}, as_columns(table, drive.outputs), states, parameters)


def windows(
    drive: Drive,
    starts: Mapping[int, Mapping[str, Any]],
    horizon: float,
    memories: Mapping[int, Memory] = MappingProxyType({}),
) -> Replay:
    """Return replays of `horizon` seconds from the given starts.

    A start row is predicted by the previous replay, not by the one that starts there.

    Args:
        starts: First row → start values.
        memories: First row → state of an FMU built by cosim, for states that `starts` does not set.
    """
    table = np.full((drive.log.rows, len(drive.outputs)), np.nan)
    for first in sorted(starts):
        last = rows_of(drive.log, first, horizon)
        if last > first:
            table[first + 1 : last + 1] = drive.run(first, last, starts[first], memories.get(first))[1:]
    return Replay(horizon, dict(starts), as_columns(table, drive.outputs))


def self_started(drive: Drive, free: Replay, horizon: float) -> Replay | None:
    """Return consecutive windows whose starts are estimated from measurements.

    Each chain of windows starts from the free run. An output whose first measurement is later is predicted from then
    on. The result is None if the FMU or the log does not allow windows.
    """
    log, runs, parameters = drive.log, chains(drive.log, horizon), free.parameters
    if not runs or not parameters.keys() & log.outputs.keys():
        return None
    table, starts, sigma = np.full((log.rows, len(drive.outputs)), np.nan), {}, noise_levels(log, free.outputs)
    carried = table.copy()
    for rows, begin in runs:
        own, carrier, since = free.states.get(rows[0]), free.outputs, 0
        for first, last in pairwise(rows):
            # from the carrier, which is valid from row `since`, and from past measurements
            state = {name: float(carrier[name][first]) for name in parameters}
            oldest = int(np.searchsorted(log.time, log.time[first] - OLDEST * log.slowness))
            past = np.arange(max(since, oldest), first + 1)
            corrected = _corrections(drive, carrier, sigma, state, first, past)
            # if the FMU's state can be read, uncorrected states are those of the carrier
            start = _values_for(parameters, corrected if readable(parameters) else state | corrected)
            memory = None
            if own is not None:  # state that the start values do not set
                started = {(STATE, k) for p in parameters.values() if p.name in start for k in p.places}
                whole = {(part, k): value for part in (STATE, MEMORY) for k, value in enumerate(own[part])}
                memory = {place: value for place, value in whole.items() if place not in started}
            carried[first : last + 1] = drive.run(first, last, start, memory)
            own, carrier, since = own and drive.state(), dict(zip(drive.outputs, carried.T, strict=True)), first
            if first >= begin:
                starts[first] = start
                table[first + 1 : last + 1] = carried[first + 1 : last + 1]
    for j, name in enumerate(drive.outputs):
        if name in log.outputs:  # predicted from the first window with enough past measurements
            times = log.time[np.isfinite(log.outputs[name])]
            earliest = times[0] + SKIPPED * log.slowness - coarse_rounding(log) if times.size else np.inf
            table[: min((k for k in starts if log.time[k] >= earliest), default=log.rows) + 1, j] = np.nan
    return Replay(horizon, starts, as_columns(table, drive.outputs))


def replays_over(drive: Drive, free: Replay, spans: Sequence[float]) -> dict[float, Replay]:
    """Return horizon → replay: the free run, and windows of each span [s] that the FMU and the log allow."""
    windowed = (self_started(drive, free, span) for span in spans)
    return {FREE_RUN: free, **{replay.horizon: replay for replay in windowed if replay is not None}}


def horizons(log: Log) -> tuple[float, ...]:
    """Return the horizons of windows [s], the deciding one last; they are longer for rows slower than 50 ms."""
    return tuple(horizon * log.slowness for horizon in HORIZONS)


def chains(log: Log, horizon: float) -> list[tuple[list[int], int]]:
    """Return chains of consecutive windows, each with the first row that counts; after a pause, a new chain begins.

    A chain begins with short windows, in which the state settles and which do not count.
    """
    result, skipped = [], SKIPPED * log.slowness
    for part in stretches(log):
        first = int(np.searchsorted(log.time, part.time[0]))
        if rows := window_rows(part, horizon, skipped):
            settle = [
                k
                for k in window_rows(part, PAST_S * log.slowness, 0.0 if first else FIRST_S * log.slowness)
                if k < rows[0]
            ]
            edges = [*settle, *rows, rows_of(part, rows[-1], horizon)]
            result.append(([first + k for k in edges], first + rows[0]))
    return result


def window_rows(log: Log, horizon: float, skipped: float = SKIPPED) -> list[int]:
    """Return the first rows of consecutive complete windows, after the first `skipped` seconds."""
    rows: list[int] = []
    k = int(np.searchsorted(log.time, log.time[0] + skipped - coarse_rounding(log)))
    while k < log.rows - 1 and log.time[k] + horizon <= log.time[-1] + 0.5 * log.step:
        last = rows_of(log, k, horizon)
        if last > k:
            rows.append(k)
        k = max(last, k + 1)
    return rows


# -- starts ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StartParameter:
    """A start parameter to which an output is proportional after initialization: output = gain·parameter.

    Attributes:
        tried: The two parameter values that were tried.
        places: Indices of the parameter in the state of an FMU built by cosim; empty if the state cannot be read.
    """

    name: str
    gain: float
    low: float
    high: float
    tried: tuple[float, float]
    places: tuple[int, ...] = ()

    def value(self, output: float) -> float:
        """Return the value of the start parameter, within its limits, that gives an output value."""
        return min(max(output / self.gain, self.low), self.high)


def start_parameters(drive: Drive) -> dict[str, StartParameter]:
    """Return output → start parameter, determined by trial initializations.

    For example, `angle_start` may set `angle` and `angle_actual`, or `angle` has a start value of its own, which must
    be exact. Parameters without a proportional output are ignored.
    """
    variables = {}
    for v in drive.description.modelVariables:
        is_state = v.causality == "output" and getattr(v, "initial", None) == "exact" and v.start is not None
        if v.type in DOUBLE_TYPES and not getattr(v, "shape", None) and (v.causality == "parameter" or is_state):
            variables[v.name] = v
    parameters: dict[str, StartParameter] = {}
    for output in drive.outputs:
        names = (f"{output}_start", f"{output.removesuffix('_actual')}_start", output)
        if (variable := next((variables[n] for n in names if n in variables), None)) is None:
            continue
        default = float(variable.start or 0.0)
        low = -math.inf if variable.min is None else float(variable.min)
        high = math.inf if variable.max is None else float(variable.max)
        width = 0.1 * max(1.0, abs(default))
        tries = [v for v in (default + share * width for share in (1, 2, -1, -2)) if low <= v <= high][:2]
        if len(tries) < 2:
            continue
        try:
            one, two = (drive.initial({variable.name: v}, 0)[output] for v in tries)
        except SimulationError:
            continue
        gain = (two - one) / (tries[1] - tries[0])
        if abs(one - gain * tries[0]) <= 1e-6 * max(abs(one), abs(two)) and not abs(gain) <= 1e-9:
            parameters[output] = StartParameter(variable.name, gain, low, high, (tries[0], tries[1]))
    if not parameters or not drive.has_readable_state:
        return parameters
    tried = {p.name: p.tried[0] for p in parameters.values()}
    try:
        before = drive.own(tried)[STATE]
        after = {output: drive.own(tried | {p.name: p.tried[1]})[STATE] for output, p in parameters.items()}
    except (SimulationError, ValueError, KeyError, TypeError):
        return parameters
    # indices of the state that each parameter changes
    places = {n: tuple(k for k, a in enumerate(s) if a != before[k]) for n, s in after.items()}
    return {n: replace(p, places=places[n]) for n, p in parameters.items()} if all(places.values()) else parameters


def first_start(drive: Drive, parameters: Mapping[str, StartParameter]) -> dict[str, float]:
    """Return the start values of the free run that best fit the first second of the log.

    Unmeasured states keep the FMU's start values.
    """
    log = drive.log
    fixed = {p.name: drive.given[p.name] for p in parameters.values() if p.name in drive.given}
    first = {n: float(v[np.isfinite(v)][0]) for n, v in log.outputs.items() if n in parameters}
    start = _values_for(parameters, first) | fixed
    sigma = noise_levels(log)
    last = max(rows_of(log, 0, FIRST_S * log.slowness), min(MIN_PARABOLA_SAMPLES, log.rows - 1))
    for _ in range(PASSES if first else 0):
        carrier = as_columns(drive.run(0, last, start), drive.outputs)
        state = {name: float(carrier[name][0]) for name in parameters}
        corrected = _corrections(drive, carrier, sigma, state, 0, np.arange(last + 1))
        start = start | _values_for(parameters, corrected) | fixed
    return start


def _values_for(parameters: Mapping[str, StartParameter], outputs: NamedValues) -> dict[str, float]:
    """Return the values of start parameters that give these output values."""
    return {parameters[name].name: parameters[name].value(value) for name, value in outputs.items()}


def noise_levels(log: Log, model: NamedArrays | None = None) -> dict[str, float]:
    """Return channel → noise level (standard deviation); outputs of the model make it more accurate."""
    return {name: sigma_of(values, (model or {}).get(name)) for name, values in log.outputs.items()}


def readable(parameters: Mapping[str, StartParameter]) -> bool:
    """Return True if some start parameter has known indices (`places`) in the FMU's state."""
    return any(p.places for p in parameters.values())


def _corrections(
    drive: Drive,
    carrier: NamedArrays,
    sigma: NamedValues,
    state: NamedValues,
    at: int,
    rows: Rows,
) -> dict[str, float]:
    """Return output → value at row `at` for those outputs that measurements in `rows` correct."""
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
    frame = drive.frame
    if frame is None or frame.forward in log.outputs:
        return corrected
    if not ({frame.x, frame.y} <= slopes.keys() and frame.local <= state.keys()):
        return corrected
    # If the position is measured and the velocity is not: local velocity at the corrected heading.
    x, y = world_velocity(SCALAR, state[frame.heading], state[frame.forward], state[frame.right])
    heading = corrected.get(frame.heading, state[frame.heading])
    forward, right = local_vector(SCALAR, heading, x + slopes[frame.x], y + slopes[frame.y])
    return corrected | {frame.forward: forward, frame.right: right}


def _parabola(log: Log, errors: Sequence[Error], at: int, rows: Rows) -> tuple[float | None, float | None]:
    """Return value and slope, at row `at`, of the parabola fitted to measured − carrier.

    The longest time in which the parabola fits within the noise is used, so that a poor model is extrapolated less.
    """
    ahead = bool(rows.size and rows[-1] > at)
    estimate: tuple[float | None, float | None] = None, None
    for share in REACHES:
        reach = share * log.slowness * (FIRST_S if ahead else PAST_S)
        designs, sides = [], []
        for error, sigma, derived in errors:
            good = np.isfinite(error)
            tau = log.time[rows[good]] - log.time[at]
            near = np.flatnonzero(np.abs(tau) <= reach + 1e-9)
            if near.size < MIN_SLOPE_SAMPLES:  # of a slow sensor, the nearest few readings
                nearest = np.argsort(np.abs(tau), kind="stable")[:MIN_SLOPE_SAMPLES]
                near = np.sort(nearest[np.abs(tau[nearest]) <= OLDEST * log.slowness])
            tau, one, zero = tau[near], np.ones(near.size), np.zeros(near.size)
            designs.append(np.column_stack((zero, one, tau) if derived else (one, tau, 0.5 * tau**2)) / sigma)
            sides.append(error[good][near] / sigma)
        side = np.concatenate(sides)
        order = 3 if side.size >= MIN_PARABOLA_SAMPLES else 2 if side.size >= 3 else 1
        if side.size < order:
            break
        design = np.vstack(designs)[:, :order]
        value, *rest = least_squares(design, side)
        estimate = float(value), float(rest[0]) if rest else None
        residual = side - design @ (value, *rest)
        if float(residual @ residual) <= FITS * max(1, side.size - order):
            break
    return estimate


def sigma_of(values: Array, model: Array | None = None) -> float:
    """Return the noise level (standard deviation) of a channel; the output of the model makes it more accurate."""
    level = noise_level(values) if model is None else least_noise_level(values, model)
    floor = 1e-6 * float(np.nanmax(np.abs(values)))
    return max(floor, 1e-12) if math.isnan(level) else max(level, floor, 1e-12)
