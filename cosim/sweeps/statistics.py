"""What many runs say together: shares with their intervals, bands over time, what an outcome is sensitive to."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from cosim.arrays import Array

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
FEWEST, MOST = 50, 2000  # runs of which a sensitivity is estimated
RESAMPLES = 50


@dataclass(frozen=True)
class Share:
    """How many of how many, and the interval that holds the true share in 95 % of cases (Wilson's)."""

    hits: int
    of: int
    low: float
    high: float


def share(hits: int, of: int) -> Share:
    """The share, and its interval; 0 … 1 of nothing."""
    if not of:
        return Share(0, 0, 0.0, 1.0)
    interval = binomtest(hits, of).proportion_ci(method="wilson")
    return Share(hits, of, float(interval.low), float(interval.high))


def quantiles(values: Array) -> Array:
    """5, 25, 50, 75 and 95 % of runs, shape (5, …) of values of shape (runs, …)."""
    found: Array = np.quantile(values, QUANTILES, axis=0)
    return found


@dataclass(frozen=True)
class Sensitivity:
    """How much an outcome depends on each factor, most important first.

    first:     share of the variance that each makes alone (first-order index), and its half-width at 95 %
    other:     of each the total Sobol index where the sampling allows it, else Borgonovo's delta; and its half-width
    is_total:  which of the two
    """

    outcome: str
    factors: tuple[str, ...]
    first: tuple[tuple[float, float], ...]
    other: tuple[tuple[float, float], ...]
    is_total: bool


def sensitivity(
    outcome: str, values: Array, factors: Mapping[str, Sequence[Any]], *, saltelli: bool, seed: int
) -> Sensitivity | None:
    """By SALib; None where there is nothing to tell: too few runs, or an outcome that does not vary.

    values: of the outcome, shape (runs,), NaN where a run has none
    """
    varied = {n: np.array(v, float) for n, v in factors.items() if _numbers(v) and len(set(v)) > 1}
    good = np.isfinite(values)
    spread = np.ptp(values[good]) if good.any() else 0.0
    if not varied or good.sum() < FEWEST or spread <= 1e-12 * np.max(np.abs(values[good])):
        return None
    X = np.column_stack(list(varied.values()))
    problem = {"num_vars": len(varied), "names": list(varied), "bounds": [[c.min(), c.max()] for c in X.T]}
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if saltelli and good.all():
            from SALib.analyze import sobol

            found = sobol.analyze(problem, values, calc_second_order=False, num_resamples=RESAMPLES, seed=seed)
            first, other, is_total = (found["S1"], found["S1_conf"]), (found["ST"], found["ST_conf"]), True
        else:
            from SALib.analyze import delta

            rows = np.flatnonzero(good)
            if rows.size > MOST:
                rows = np.sort(np.random.default_rng(seed).choice(rows, MOST, replace=False))
            found = delta.analyze(problem, X[rows], values[rows], num_resamples=RESAMPLES, seed=seed)
            first, other, is_total = (found["S1"], found["S1_conf"]), (found["delta"], found["delta_conf"]), False
    order = np.argsort(-np.asarray(other[0]))
    names = list(varied)
    pairs = [tuple((float(p[0][k]), float(p[1][k])) for k in order) for p in (first, other)]
    return Sensitivity(outcome, tuple(names[k] for k in order), pairs[0], pairs[1], is_total)


def _numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
