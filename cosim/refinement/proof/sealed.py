"""Whether the error rises on sealed logs, replay by replay, by more than it scatters from one to the next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cosim.base.arrays import Array
from cosim.logs.log import Log
from cosim.refinement.proof.measure import Evidence, rmse
from cosim.residuals.windows import Replay

CHANCE = 0.01  # that so large a rise on any channel comes of nothing
PARTS = 8  # of a free run, each of which counts as a replay

Rise = tuple[float, float]  # root mean square before and after


def risen(before: Evidence, after: Evidence) -> dict[str, Rise]:
    """Return channel → error before and after, where that is larger after; the greatest rise first.

    With d = ln(Σe² after / Σe² before) of each replay, t = d̄·√n / s_d is held against Student's t of n − 1: replays in
    which much moves, and much is missed, count no more than the others. The channels share the chance (Bonferroni).
    """
    errors = rmse(before), rmse(after)
    chance = CHANCE / max(1, len(errors[0]))
    found: dict[str, tuple[Rise, float]] = {}
    for name in errors[0].keys() & errors[1].keys():
        pair = errors[0][name], errors[1][name]
        if pair[1] > pair[0] and plain_rise(_rises(before, after, name), chance):
            found[name] = pair, pair[1] / pair[0] if pair[0] > 0.0 else math.inf
    return {name: pair for name, (pair, times) in sorted(found.items(), key=lambda item: -item[1][1])}


def plain_rise(rises: Sequence[float], chance: float) -> bool:
    """Whether the mean of these is above 0 by more than chance makes of their scatter; one alone tells nothing."""
    from scipy.special import stdtrit

    count = len(rises)
    if count < 2:
        return False
    mean, scatter = float(np.mean(rises)), float(np.std(rises, ddof=1))
    return mean * math.sqrt(count) > float(stdtrit(count - 1, 1.0 - chance)) * scatter


def _rises(before: Evidence, after: Evidence, name: str) -> list[float]:
    """Return logarithm of how many times larger the sum of squares of each replay is."""
    found: list[float] = []
    for (log, first), (corrected, second) in zip(before, after, strict=True):
        if name not in log.outputs:
            continue
        a, b = _squares(log, first, name), _squares(corrected, second, name)
        both = np.isfinite(a) & np.isfinite(b)
        edges = _edges(first)
        parts = [slice(x, y) for x, y in pairwise(edges)]
        sums = [(float(a[p][both[p]].sum()), float(b[p][both[p]].sum())) for p in parts]
        found += [math.log(y / x) for x, y in sums if 0.0 < x < math.inf and 0.0 < y < math.inf]
    return found


def _squares(log: Log, replay: Replay, name: str) -> Array:
    with np.errstate(over="ignore"):  # of a model that runs away
        return np.asarray((log.outputs[name] - replay.outputs[name]) ** 2)


def _edges(replay: Replay) -> list[int]:
    """Return the first row of each replay, and the end; a row that one starts belongs to the one before."""
    rows, starts = replay.time.size, sorted(replay.starts)
    if math.isinf(replay.horizon):
        return [round(k * rows / PARTS) for k in range(PARTS + 1)]
    return [*(k + 1 for k in starts), rows]
