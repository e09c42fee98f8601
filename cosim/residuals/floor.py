"""What noise alone explains of a replay: the model against itself, measured as the log measures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cosim.arrays import Array
from cosim.logs.log import Log
from cosim.logs.noise import noise_beside
from cosim.residuals.drive import Drive
from cosim.residuals.starts import StartParameter
from cosim.residuals.statistics import FREE_RUN, pooled, rmse
from cosim.residuals.windows import Replay, chains, free_run, self_started

WINDOWS, FEWEST_DRAWS, SEED = 40, 2, 1  # windows drawn at least
BY_CHANCE = 1e-4  # of a right model, a channel
AT_LEAST = 1.5  # times the floor, be it ever so sure: the levels of the noise are estimates
ROUNDING = 1e-9  # of a channel's size
EXACT = 1e-4  # of a channel's spread; a log without noise is matched to rounding, not to noise


class Floor(NamedTuple):
    """Of one channel: the RMSE that noise alone explains, and how many times that a right model exceeds by chance.

    astray: RMSE of the model against itself, restarted from its own outputs without noise; 0 if by rounding only
    """

    rmse: float
    limit: float
    astray: float


def draws(log: Log, horizon: float) -> int:
    """How often the log is drawn: few windows scatter."""
    runs = [] if horizon == FREE_RUN else chains(log, horizon)
    count = sum(sum(row >= c.begin for row in c.rows[:-1]) for c in runs)
    return max(FEWEST_DRAWS, math.ceil(WINDOWS / max(1, count)))


def floors(drive: Drive, parameters: Mapping[str, StartParameter], free: Replay, measured: Replay) -> dict[str, Floor]:
    """Channel → floor over the horizon of `measured`, the windows or the free run that are to be judged.

    The model is replayed against its free run, seen through the noise and the holes of the log, and through the
    holes only. What it misses even so is not the noise's: it keeps something that no output shows.
    """
    log, horizon = drive.log, measured.horizon
    alike = {n: np.where(np.isfinite(v), free.outputs[n], np.nan) for n, v in log.outputs.items()}
    levels = {name: noise_beside(values, free.outputs[name]) for name, values in log.outputs.items()}

    def predicted(seen: Mapping[str, Array]) -> Mapping[str, Array]:
        if horizon == FREE_RUN:  # where no start is measured, it is what it was
            shown = parameters.keys() & seen.keys()
            return free_run(drive.on(replace(log, outputs=seen))).outputs if shown else free.outputs
        found = self_started(drive.on(replace(log, outputs=seen)), parameters, free, horizon)
        return {} if found is None else found.outputs

    restarted, errors = predicted(alike), []
    for draw in range(count := draws(log, horizon)):
        rng = np.random.default_rng([SEED, draw])
        noise = {n: (0.0 if math.isnan(s) else s) * rng.standard_normal(log.rows) for n, s in levels.items()}
        noisy = predicted({n: values + noise[n] for n, values in alike.items()})
        errors.append({n: alike[n] + noise[n] - (noisy[n] - (restarted[n] - free.outputs[n])) for n in alike})
    found, starts = pooled(errors), sorted(measured.starts)
    squares = {n: np.concatenate([_mean_squares(e[n], starts) for e in errors]) for n in alike}
    astray = {n: 0.0 if horizon == FREE_RUN else _astray(v, restarted[n]) for n, v in alike.items()}
    return {n: Floor(found[n], _limit(squares[n], count), astray[n]) for n in alike}


def _mean_squares(error: Array, starts: Sequence[int]) -> Array:
    """Mean square of the error in each window where it is known, from the first rows of all."""
    seen = np.isfinite(error)
    window = np.searchsorted(starts, np.flatnonzero(seen), side="left")
    counts = np.bincount(window, minlength=len(starts) + 1)
    sums = np.bincount(window, error[seen] ** 2, minlength=counts.size)
    return np.asarray(sums[counts > 0] / counts[counts > 0])


def _limit(squares: Array, count: int) -> float:
    """How many times the floor a right model misses by, BY_CHANCE: mean squares over windows, drawn `count` times.

    Each sum of squares is as a χ² whose degrees of freedom are 2·mean²/variance a window (Satterthwaite 1946), so
    that their ratio follows Fisher's F.
    """
    from scipy.special import fdtri

    mean, spread = (float(np.mean(squares)), float(np.var(squares))) if squares.size else (0.0, 0.0)
    if not spread > 0.0:
        return AT_LEAST
    freedom = max(1.0, 2.0 * mean**2 / spread) * squares.size / count
    return max(AT_LEAST, math.sqrt(float(fdtri(freedom, freedom * count, 1.0 - BY_CHANCE))))


def _astray(model: Array, restarted: Array) -> float:
    error = model - restarted
    seen = model[np.isfinite(error)]
    least = max(EXACT * float(np.std(seen)), ROUNDING * float(np.max(np.abs(seen)))) if seen.size else math.inf
    return found if (found := rmse(error)) > least else 0.0
