"""Statistics of many runs: shares with confidence intervals, quantiles over time, sensitivities."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.extras import optional
from cosim.sweeps.sampling import are_numbers

QUANTILE_975 = 1.959963984540054  # of the normal distribution
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MIN_RUNS, MAX_RUNS = 50, 2000  # for estimating a sensitivity
RESAMPLES = 50
SENSITIVITY_USE = "the sensitivity of a sweep"


def share_interval(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % confidence interval (Wilson) of a share of runs, 0 … 1 without runs."""
    if not of:
        return 0.0, 1.0
    share, z = hits / of, QUANTILE_975
    scale = 2 * (of + z**2)
    middle, half = (2 * of * share + z**2) / scale, z / scale * math.sqrt(4 * of * share * (1 - share) + z**2)
    return 0.0 if hits == 0 else middle - half, 1.0 if hits == of else middle + half


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of an outcome to each factor, most important first.

    Attributes:
        first: First-order index (share of the variance due to the factor alone) with its 95 % half-width.
        total: Total index, including interactions; only for saltelli sampling.
        pawn: Shift of the outcome's distribution with the factor (PAWN, median of 10 slices), without total indices.
        chance: PAWN index of an idle factor.
    """

    outcome: str
    factors: tuple[str, ...]
    first: tuple[tuple[float, float], ...]
    total: tuple[tuple[float, float], ...] = ()
    pawn: tuple[float, ...] = ()
    chance: float = 0.0


def sensitivity(
    outcome: str, values: Array, factors: Mapping[str, Sequence[Any]], *, saltelli: bool, seed: int
) -> Sensitivity | None:
    """Estimate the sensitivity by SALib.

    None means too few runs, or a constant outcome.

    Args:
        values: Outcome by run, shape (runs,), NaN if undefined.
    """
    varied = {n: np.array(v, float) for n, v in factors.items() if are_numbers(v) and len(set(v)) > 1}
    good = np.isfinite(values)
    spread = np.ptp(values[good]) if good.any() else 0.0
    if not varied or good.sum() < MIN_RUNS or spread <= 1e-12 * np.max(np.abs(values[good])):
        return None
    names, X = list(varied), np.column_stack(list(varied.values()))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if saltelli and good.all():
            sobol = optional("SALib.analyze.sobol", SENSITIVITY_USE)
            problem = _problem(names, X)
            si = sobol.analyze(problem, values, calc_second_order=False, num_resamples=RESAMPLES, seed=seed)
            order = np.argsort(-np.asarray(si["ST"]))
            first, total = (tuple((float(si[n][k]), float(si[f"{n}_conf"][k])) for k in order) for n in ("S1", "ST"))
            return Sensitivity(outcome, tuple(names[k] for k in order), first, total=total)
        rows = np.flatnonzero(good)
        if rows.size > MAX_RUNS:
            rows = np.sort(np.random.default_rng(seed).choice(rows, MAX_RUNS, replace=False))
        values, X = values[rows], X[rows]
        pawn, rbd_fast = (optional(f"SALib.analyze.{name}", SENSITIVITY_USE) for name in ("pawn", "rbd_fast"))
        si = rbd_fast.analyze(_problem(names, X), X, values, num_resamples=RESAMPLES, seed=seed)
        both = np.hstack((X, np.random.default_rng([seed, 1]).random((len(X), 1))))  # an idle factor shows chance
        moved = np.asarray(pawn.analyze(_problem([*names, ""], both), both, values, seed=seed)["median"], float)
    order = np.argsort(-moved[:-1])
    first = tuple((float(si["S1"][k]), float(si["S1_conf"][k])) for k in order)
    shifts = tuple(float(moved[k]) for k in order)
    return Sensitivity(outcome, tuple(names[k] for k in order), first, pawn=shifts, chance=float(moved[-1]))


def _problem(names: Sequence[str], X: Array) -> dict[str, Any]:
    return {"num_vars": len(names), "names": list(names), "bounds": [[c.min(), c.max()] for c in X.T]}
