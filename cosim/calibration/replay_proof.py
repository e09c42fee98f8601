"""Errors before and after a fit, by the replays of `cosim replay`: free runs, and windows where they are possible."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cosim.logs.log import Log
from cosim.residuals.drive import Drive
from cosim.residuals.floor import floors
from cosim.residuals.residual_statistics import FREE_RUN, pool_errors
from cosim.residuals.starts import start_parameters
from cosim.residuals.windows import Replay, free_run, horizons, self_started


class Replayed(NamedTuple):
    """Replays of one log with one set of values, by horizon, and the noise floor by channel."""

    log: Log
    replays: Mapping[float, Replay]
    floor: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Part:
    """A set of logs before and after the fit.

    Attributes:
        sealed: True for logs that were opened after the fit.
        horizon: Decisive horizon [s], FREE_RUN for free runs.
    """

    sealed: bool
    horizon: float
    before: Sequence[Replayed]
    after: Sequence[Replayed]

    def errors(self, horizon: float) -> dict[str, tuple[float, float]]:
        """Return channel → root mean square error before and after, pooled over the logs."""
        old, new = (pool_errors(r.replays[horizon].errors(r.log) for r in side) for side in (self.before, self.after))
        return {name: (old[name], new[name]) for name in old}

    @cached_property
    def floor(self) -> dict[str, float]:
        """Return channel → noise floor over the decisive horizon, root mean square over the logs."""
        names = dict.fromkeys(n for r in self.after for n in r.floor)
        squares = {n: [r.floor[n] ** 2 for r in self.after if math.isfinite(r.floor.get(n, math.nan))] for n in names}
        return {n: math.sqrt(float(np.mean(s))) for n, s in squares.items() if s}

    @property
    def ratio(self) -> float:
        """Return the geometric mean over the channels of the error after relative to that before."""
        pairs = [(a, b) for a, b in self.errors(self.horizon).values() if a > 0.0 and b > 0.0 and math.isfinite(a * b)]
        return math.exp(float(np.mean([math.log(b / a) for a, b in pairs]))) if pairs else math.nan


def prove(
    drives: Sequence[Drive],
    before: Sequence[Mapping[str, float]],
    after: Sequence[Mapping[str, float]],
    horizon: float,
    *,
    sealed: bool,
) -> Part:
    """Return the errors of a set of logs with the values before and after, with the noise floor after.

    Args:
        horizon: Horizon of the noise floor; FREE_RUN for free runs.
    """
    sides: tuple[list[Replayed], list[Replayed]] = [], []
    for side, every in zip(sides, (before, after), strict=True):
        for drive, values in zip(drives, every, strict=True):
            moved = drive.with_values(values)
            log, parameters, free = moved.log, start_parameters(moved), free_run(moved)
            replays, floor = {FREE_RUN: free}, dict[str, float]()
            if (windowed := self_started(moved, parameters, free, horizons(log)[-1])) is not None:
                replays[windowed.horizon] = windowed
            if side is sides[1]:
                decisive = replays.get(horizon, free)
                floor = {n: f.rmse for n, f in floors(moved, parameters, free, decisive).items()}
            side.append(Replayed(log, replays, floor))
    if not all(horizon in r.replays for side in sides for r in side):
        horizon = FREE_RUN
    return Part(sealed, horizon, *sides)
