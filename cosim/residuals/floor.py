"""Noise floor of a replay: the model against itself, sampled and disturbed like the log."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.logs.channel_noise import least_noise_level
from cosim.logs.log import Log
from cosim.residuals.drive import Drive, as_columns
from cosim.residuals.residual_statistics import FREE_RUN, pool_errors, rmse
from cosim.residuals.starts import StartParameter, first_start
from cosim.residuals.windows import Replay, chains, self_started

WINDOWS, FEWEST_DRAWS, SEED = 40, 2, 1  # least number of windows drawn
BY_CHANCE = 1e-4  # false alarm probability of a correct model for each channel
AT_LEAST = 1.5  # least limit relative to the floor, since noise levels are estimates
ROUNDING = 1e-9  # share of a channel's size
STEP = 1e-6  # change of a start value without known noise
EXACT = 1e-4  # share of a channel's spread; a log without noise is matched to rounding


class ChannelFloor(NamedTuple):
    """RMSE of one channel explained by noise, and the limit of a correct model relative to the RMSE.

    Attributes:
        astray: RMSE of the model restarted from its own noise-free outputs; 0 at rounding level.
    """

    rmse: float
    limit: float
    astray: float


def draws(log: Log, horizon: float) -> int:
    """Return the number of random draws that estimate the noise floor of a log; few windows need more draws."""
    runs = [] if horizon == FREE_RUN else chains(log, horizon)
    count = sum(sum(row >= begin for row in rows[:-1]) for rows, begin in runs)
    return max(FEWEST_DRAWS, math.ceil(WINDOWS / max(1, count)))


def floors(
    drive: Drive, parameters: Mapping[str, StartParameter], free: Replay, measured: Replay
) -> dict[str, ChannelFloor]:
    """Return channel → noise floor over the horizon of `measured`.

    The model is replayed against its free run, with the noise and gaps of the log, and with gaps only. An error without
    noise comes from a state that no output shows.
    """
    log, horizon = drive.log, measured.horizon
    sampled = {n: np.where(np.isfinite(v), free.outputs[n], np.nan) for n, v in log.outputs.items()}
    levels = {name: least_noise_level(values, free.outputs[name]) for name, values in log.outputs.items()}

    linear = _linear_run(drive, parameters, free, levels) if horizon == FREE_RUN else None

    def predict(readings: Mapping[str, Array]) -> Mapping[str, Array]:
        other = drive.on(replace(log, outputs=readings))
        if horizon != FREE_RUN:
            replayed = self_started(other, parameters, free, horizon)
            return {} if replayed is None else replayed.outputs
        if not parameters.keys() & readings.keys():  # a start without measurement is unchanged
            return free.outputs
        if linear is not None:
            other.run = linear  # type: ignore[method-assign, assignment]
        return as_columns(other.run(0, log.rows - 1, first_start(other, parameters)), drive.outputs)

    restarted, errors = predict(sampled), []
    for draw in range(count := draws(log, horizon)):
        rng = np.random.default_rng([SEED, draw])
        noise = {n: (0.0 if math.isnan(s) else s) * rng.standard_normal(log.rows) for n, s in levels.items()}
        noisy = predict({n: values + noise[n] for n, values in sampled.items()})
        errors.append({n: sampled[n] + noise[n] - (noisy[n] - (restarted[n] - free.outputs[n])) for n in sampled})
    totals, starts = pool_errors(errors), sorted(measured.starts)
    found = {}
    for name, model in sampled.items():
        squares = []
        for error in (e[name] for e in errors):  # the mean squared error of each window
            finite = np.isfinite(error)
            window = np.searchsorted(starts, np.flatnonzero(finite), side="left")
            counts = np.bincount(window, minlength=len(starts) + 1)
            sums = np.bincount(window, error[finite] ** 2, minlength=counts.size)
            squares.append(sums[counts > 0] / counts[counts > 0])
        astray = 0.0
        if horizon != FREE_RUN:
            error = model - restarted[name]
            values = model[np.isfinite(error)]
            if values.size:
                size = max(EXACT * float(np.std(values)), ROUNDING * float(np.max(np.abs(values))))
                astray = rest if (rest := rmse(error)) > size else 0.0
        found[name] = ChannelFloor(totals[name], _limit(np.concatenate(squares), count), astray)
    return found


def _linear_run(
    drive: Drive, parameters: Mapping[str, StartParameter], free: Replay, levels: Mapping[str, float]
) -> Callable[[int, int, Mapping[str, Any]], Array] | None:
    """Return a run of the FMU's linearization about the free run, with respect to the start values, to save FMU runs.

    Each start value needs one FMU run, instead of five runs per draw. The result is None if a run fails.
    """
    table = np.column_stack([free.outputs[name] for name in drive.outputs])
    start = free.starts[0]
    about = {p.name: float(start.get(p.name, p.value(free.outputs[name][0]))) for name, p in parameters.items()}
    slopes = {}
    try:
        for name, p in parameters.items():
            level = levels.get(name, math.nan)
            step = level / abs(p.gain) if level > 0.0 else STEP * max(1.0, abs(about[p.name]))
            step = step if about[p.name] + step <= p.high else -step
            outputs = drive.run(0, drive.log.rows - 1, {**start, **about, p.name: about[p.name] + step})
            slopes[p.name] = (outputs - table) / step
    except SimulationError:
        return None

    def run(first: int, last: int, start: Mapping[str, Any]) -> Array:
        changes = {name: start[name] - value for name, value in about.items() if name in start}
        moved = table + sum(change * slopes[name] for name, change in changes.items())
        return np.asarray(moved[: last + 1])

    return run


def _limit(squares: Array, count: int) -> float:
    """Return the largest error of a correct model relative to the floor, at probability BY_CHANCE.

    A sum of squares follows χ² with 2·mean²/variance degrees of freedom per window (Satterthwaite 1946), and the ratio
    follows Fisher's F. `count` is the number of draws.
    """
    from scipy.special import fdtri

    mean, spread = (float(np.mean(squares)), float(np.var(squares))) if squares.size else (0.0, 0.0)
    if not spread > 0.0:
        return AT_LEAST
    freedom = max(1.0, 2.0 * mean**2 / spread) * squares.size / count
    return max(AT_LEAST, math.sqrt(float(fdtri(freedom, freedom * count, 1.0 - BY_CHANCE))))
