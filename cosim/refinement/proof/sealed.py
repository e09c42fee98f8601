"""Sealed logs: the error that remains, and errors that rise by more than their scatter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from cosim.refinement.proof.measure import PARTS, ReplayedLogs, rmse
from cosim.residuals.residual_statistics import remaining_excess

CHANCE = 0.01  # probability of a false alarm for a rise on any channel


def find_rises(before: ReplayedLogs, after: ReplayedLogs) -> dict[str, tuple[float, float]]:
    """Return channel → error before and after, if significantly risen.

    Student's t test is for the mean of ln(Σe² after / Σe² before) over the replays, so that every replay has the same
    weight, also with large errors. The channels share the false-alarm probability (Bonferroni).
    """
    old, new = rmse(before), rmse(after)
    rises = {
        name: (old[name], new[name])
        for name in old.keys() & new.keys()
        if new[name] > old[name] and is_significant_rise(_log_ratios(before, after, name), CHANCE / len(old))
    }
    return dict(sorted(rises.items(), key=lambda item: item[1][0] / item[1][1]))  # largest ratio first


def is_significant_rise(rises: Sequence[float], chance: float) -> bool:
    """Return True if the mean rise is significantly positive."""
    from scipy.stats import ttest_1samp  # only here: it takes a second to import

    return len(rises) > 1 and bool(ttest_1samp(rises, 0.0, alternative="greater").pvalue < chance)


def remaining_on_sealed_logs(before: ReplayedLogs, after: ReplayedLogs, floor: Mapping[str, float]) -> dict[str, float]:
    """Return channel with excess error before → share of it that remains after."""
    old, new = rmse(before), rmse(after)
    shares = {n: remaining_excess(old[n], new[n], f) for n, f in floor.items() if n in old and n in new}
    return {n: max(0.0, share) for n, share in shares.items() if math.isfinite(share)}


def _log_ratios(before: ReplayedLogs, after: ReplayedLogs, name: str) -> list[float]:
    """Return ln(Σe² after / Σe² before) of each replay."""
    ratios: list[float] = []
    for (log, first), (corrected, second) in zip(before, after, strict=True):
        if name not in log.outputs:
            continue
        with np.errstate(over="ignore"):  # A diverging model overflows.
            a, b = ((x.outputs[name] - replay.outputs[name]) ** 2 for x, replay in ((log, first), (corrected, second)))
        both = np.isfinite(a) & np.isfinite(b)
        edges = [*(k + 1 for k in sorted(first.starts)), log.rows]  # a start row belongs to the previous replay
        if math.isinf(first.horizon):
            edges = [round(k * log.rows / PARTS) for k in range(PARTS + 1)]
        parts = [slice(x, y) for x, y in pairwise(edges)]
        sums = [(float(a[p][both[p]].sum()), float(b[p][both[p]].sum())) for p in parts]
        ratios += [math.log(y / x) for x, y in sums if 0.0 < x < math.inf and 0.0 < y < math.inf]
    return ratios
