"""Test for an error that rises on sealed logs by more than its scatter from replay to replay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cosim.base.arrays import Array
from cosim.logs.log import Log
from cosim.refinement.proof.measure import Evidence, rmse
from cosim.residuals.windows import Replay

CHANCE = 0.01  # probability of a false alarm for a rise on any channel
PARTS = 8  # parts of a free run, each counted as one replay

Rise = tuple[float, float]  # root mean square before and after


def risen(before: Evidence, after: Evidence) -> dict[str, Rise]:
    """Return channel → error before and after of rises.

    With d = ln(Σe² after / Σe² before) of each replay, t = d̄·√n / s_d is compared with Student's t of n − 1 degrees of
    freedom. Replays with large errors therefore weigh as much as the others. The channels share the false-alarm
    probability (Bonferroni).
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
    """Return True for a significantly positive mean."""
    from scipy.special import stdtrit

    count = len(rises)
    if count < 2:
        return False
    mean, scatter = float(np.mean(rises)), float(np.std(rises, ddof=1))
    return mean * math.sqrt(count) > float(stdtrit(count - 1, 1.0 - chance)) * scatter


def _rises(before: Evidence, after: Evidence, name: str) -> list[float]:
    """Return the log error ratio of each replay."""
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
    with np.errstate(over="ignore"):  # A diverging model overflows.
        return np.asarray((log.outputs[name] - replay.outputs[name]) ** 2)


def _edges(replay: Replay) -> list[int]:
    """Return the first row of each replay and the end.

    The start row of a replay belongs to the previous replay.
    """
    rows, starts = replay.time.size, sorted(replay.starts)
    if math.isinf(replay.horizon):
        return [round(k * rows / PARTS) for k in range(PARTS + 1)]
    return [*(k + 1 for k in starts), rows]
