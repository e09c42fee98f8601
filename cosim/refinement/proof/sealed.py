"""Test for an error that rises on sealed logs by more than its scatter from replay to replay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cosim.refinement.proof.measure import PARTS, Evidence, rmse
from cosim.residuals.windows import Replay

CHANCE = 0.01  # probability of a false alarm for a rise on any channel


def find_rises(before: Evidence, after: Evidence) -> dict[str, tuple[float, float]]:
    """Return channel → error before and after, if significantly risen.

    With d = ln(Σe² after / Σe² before) of each replay, t = d̄·√n / s_d is compared with Student's t of n − 1 degrees of
    freedom. Every replay has the same weight, also with large errors. The channels share the false-alarm probability
    (Bonferroni).
    """
    errors = rmse(before), rmse(after)
    chance = CHANCE / max(1, len(errors[0]))
    pairs = {name: (errors[0][name], errors[1][name]) for name in errors[0].keys() & errors[1].keys()}
    rises = {
        name: (old, new)
        for name, (old, new) in pairs.items()
        if new > old and is_significant_rise(_log_ratios(before, after, name), chance)
    }
    return dict(sorted(rises.items(), key=lambda item: item[1][0] / item[1][1]))  # largest ratio first


def is_significant_rise(rises: Sequence[float], chance: float) -> bool:
    """Return True if the mean rise is significantly positive."""
    from scipy.special import stdtrit

    count = len(rises)
    if count < 2:
        return False
    mean, scatter = float(np.mean(rises)), float(np.std(rises, ddof=1))
    return mean * math.sqrt(count) > float(stdtrit(count - 1, 1.0 - chance)) * scatter


def _log_ratios(before: Evidence, after: Evidence, name: str) -> list[float]:
    """Return ln(Σe² after / Σe² before) of each replay."""
    ratios: list[float] = []
    for (log, first), (corrected, second) in zip(before, after, strict=True):
        if name not in log.outputs:
            continue
        with np.errstate(over="ignore"):  # A diverging model overflows.
            a, b = ((x.outputs[name] - replay.outputs[name]) ** 2 for x, replay in ((log, first), (corrected, second)))
        both = np.isfinite(a) & np.isfinite(b)
        parts = [slice(x, y) for x, y in pairwise(_edges(first))]
        sums = [(float(a[p][both[p]].sum()), float(b[p][both[p]].sum())) for p in parts]
        ratios += [math.log(y / x) for x, y in sums if 0.0 < x < math.inf and 0.0 < y < math.inf]
    return ratios


def _edges(replay: Replay) -> list[int]:
    """Return the first row of each replay, and the end of the last replay.

    The start row of a replay belongs to the previous replay.
    """
    rows, starts = replay.time.size, sorted(replay.starts)
    if math.isinf(replay.horizon):
        return [round(k * rows / PARTS) for k in range(PARTS + 1)]
    return [*(k + 1 for k in starts), rows]
