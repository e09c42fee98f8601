"""The design of a sweep, which has a value of each factor for each run, and statistics of the runs.

All distributions are drawn together, in rows. Each row is combined with every combination of listed values.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.core.extras import optional

MAX_SWEEP_RUNS = 1_000_000
Sampling = Literal["latin-hypercube", "sobol", "random", "saltelli"]
QUANTILE_975 = 1.959963984540054  # quantile 0.975 of the normal distribution
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MIN_SENSITIVITY_RUNS, MAX_SENSITIVITY_RUNS = 50, 2000  # for estimating a sensitivity
RESAMPLES = 50
SLICES, SHUFFLES, CHANCE = 5, 199, 0.95  # of a factor; random orders of outcomes; share below chance
SENSITIVITY_USE = "the sensitivity of a sweep"


@dataclass(frozen=True)
class Factor:
    """A varied quantity: listed values, or the inverse of a distribution function.

    Attributes:
        name: Name in the sweep file.
        unit: Unit of the values, "" without unit.
        values: Listed values in order.
        drawn: Function of a probability (0 … 1) that returns a value.
        first: First of consecutive integers, one per run.
    """

    name: str
    unit: str = ""
    values: Sequence[Any] | None = None
    drawn: Callable[[Array], Array] | None = None
    first: int | None = None


def distribution(way: str, numbers: Sequence[float], within: Sequence[float] | None = None) -> Callable[[Array], Array]:
    """Return the inverse of a distribution function; raise ValueError for invalid numbers."""
    if way in {"normal", "triangular"}:
        from scipy.stats import norm, triang, truncnorm  # This import is slower than all others.
    if way == "normal" and not numbers[1] > 0:
        raise ValueError(f"a standard deviation of {numbers[1]:g} is not allowed; give one above 0")
    if way == "normal" and not within:
        return lambda u: norm.ppf(u, *numbers)
    low, high = within if within and way == "normal" else (numbers[0], numbers[-1])
    if not low < high:
        text = "write the lower limit first"
        raise ValueError(f"the range from {low:g} to {high:g} is empty; {text}")
    if way == "normal":
        mean, deviation = numbers
        a, b = (low - mean) / deviation, (high - mean) / deviation
        if norm.cdf(b) - norm.cdf(a) < 1e-9:
            raise ValueError(f"within {low:g} … {high:g} the distribution has no values; change these limits")
        return lambda u: truncnorm.ppf(u, a, b, mean, deviation)
    if way == "uniform":
        return lambda u: low + (high - low) * u
    if way == "triangular":
        if not low <= numbers[1] <= high:
            text = f"the most likely value, {numbers[1]:g}, is not between {low:g} and {high:g}"
            raise ValueError(f"{text}; write low, most likely, high")
        return lambda u: triang.ppf(u, (numbers[1] - low) / (high - low), low, high - low)
    if low <= 0:
        raise ValueError(f"{low:g} has no logarithm; give limits above 0")
    return lambda u: np.exp(math.log(low) + (math.log(high) - math.log(low)) * u)


def drawn_rows(sampled: int, counted: bool, runs: int, sampling: Sampling) -> int:
    """Return the number of drawn rows: `runs`, at most `runs` for saltelli, 1 if nothing is drawn or counted."""
    if not sampled:
        return runs if counted else 1
    return runs if sampling != "saltelli" else saltelli_base(runs, sampled) * (sampled + 2)


def saltelli_base(runs: int, count: int) -> int:
    """Return the largest power of 2, N, with N·(count + 2) ≤ runs, or 0 if there is none."""
    return 2 ** int(math.log2(runs / (count + 2))) if runs >= count + 2 else 0


def columns_of(factors: Sequence[Factor], runs: int, sampling: Sampling, seed: int) -> dict[str, list[Any]]:
    """Return factor → values in all runs."""
    combinations = list(itertools.product(*(f.values for f in factors if f.values is not None)))
    sampled = sum(f.drawn is not None for f in factors)
    rows = drawn_rows(sampled, any(f.first is not None for f in factors), runs, sampling)
    listed, shares = zip(*combinations, strict=True), iter(_shares(sampled, rows, sampling, seed).T)
    columns: dict[str, list[Any]] = {}
    for factor in factors:
        if factor.first is not None:
            columns[factor.name] = list(range(factor.first, factor.first + rows * len(combinations)))
        elif factor.drawn is not None:
            columns[factor.name] = np.repeat(factor.drawn(next(shares)), len(combinations)).tolist()
        else:
            columns[factor.name] = [*next(listed)] * rows
    return columns


def _shares(count: int, rows: int, sampling: Sampling, seed: int) -> Array:
    """Return sampled points in the unit cube, shape (rows, count)."""
    rng = np.random.default_rng([seed, 0x5EED])
    if not count or not rows:
        return np.empty((rows, count))
    if sampling == "random":
        return rng.random((rows, count))
    points: Array
    if sampling == "latin-hypercube":  # the points of scipy.stats, whose import is slower than all others
        rng, strata = rng.spawn(1)[0], np.tile(np.arange(1, rows + 1), (count, 1))
        within = rng.random((rows, count))
        for stratum in strata:
            rng.shuffle(stratum)
        points = (strata.T - within) / rows
    elif sampling == "saltelli":
        sobol = optional("SALib.sample.sobol", "a sweep sampled by saltelli")
        problem = {"num_vars": count, "names": [str(k) for k in range(count)], "bounds": [[0.0, 1.0]] * count}
        points = sobol.sample(problem, saltelli_base(rows, count), calc_second_order=False, seed=seed)
    else:
        from scipy.stats import qmc

        with warnings.catch_warnings():  # The user may choose a number of points that is no power of 2.
            warnings.simplefilter("ignore", UserWarning)
            points = qmc.Sobol(count, seed=rng).random(rows)
    return np.clip(points, 1e-12, 1.0 - 1e-12)


def are_numbers(values: Sequence[Any]) -> bool:
    """Return True if all values are numbers."""
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)


def share_interval(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % confidence interval (Wilson) of a share of runs; (0, 1) if there are no runs."""
    if not of:
        return 0.0, 1.0
    share, z = hits / of, QUANTILE_975
    scale = 2 * (of + z**2)
    middle, half = (2 * of * share + z**2) / scale, z / scale * math.sqrt(4 * of * share * (1 - share) + z**2)
    return 0.0 if hits == 0 else middle - half, 1.0 if hits == of else middle + half


@dataclass(frozen=True)
class Sensitivity:
    """Sensitivity of an outcome to each factor; the most important factor is first.

    Attributes:
        first: First-order index (share of the variance due to the factor alone) with its 95 % half-width.
        total: Total index, including interactions; only for saltelli sampling.
        pawn: PAWN index: how much the distribution of the outcome changes with the factor (mean of 5 slices); used
            without total indices.
        chance: Chance level: in one of 20 sweeps, the largest PAWN index among factors without influence exceeds it.
    """

    outcome: str
    factors: tuple[str, ...]
    first: tuple[tuple[float, float], ...]
    total: tuple[tuple[float, float], ...] = ()
    pawn: tuple[float, ...] = ()
    chance: float = 0.0

    @property
    def ranked(self) -> tuple[str, ...]:
        """Return the factors whose influence is significant, the most important first."""
        if self.total:
            return tuple(name for name, (size, half) in zip(self.factors, self.total, strict=True) if size > half)
        return tuple(name for name, size in zip(self.factors, self.pawn, strict=True) if size > self.chance)


def sensitivity(
    outcome: str, values: Array, factors: Mapping[str, Sequence[Any]], *, saltelli: bool, seed: int
) -> Sensitivity | None:
    """Estimate the sensitivity of an outcome to all factors with SALib.

    The result is None for too few runs or a constant outcome.

    Args:
        values: Outcome in each run, shape (runs,); NaN if undefined.
    """
    varied = {n: np.array(v, float) for n, v in factors.items() if are_numbers(v) and len(set(v)) > 1}
    good = np.isfinite(values)
    spread = np.ptp(values[good]) if good.any() else 0.0
    if not varied or good.sum() < MIN_SENSITIVITY_RUNS or spread <= 1e-12 * np.max(np.abs(values[good])):
        return None
    names, X = list(varied), np.column_stack(list(varied.values()))
    problem = {"num_vars": len(names), "names": names, "bounds": [[c.min(), c.max()] for c in X.T]}
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if saltelli and good.all():
            sobol = optional("SALib.analyze.sobol", SENSITIVITY_USE)
            si = sobol.analyze(problem, values, calc_second_order=False, num_resamples=RESAMPLES, seed=seed)
            order = np.argsort(-np.asarray(si["ST"]))
            first, total = (tuple((float(si[n][k]), float(si[f"{n}_conf"][k])) for k in order) for n in ("S1", "ST"))
            return Sensitivity(outcome, tuple(names[k] for k in order), first, total=total)
        rows = np.flatnonzero(good)
        if rows.size > MAX_SENSITIVITY_RUNS:
            rows = np.sort(np.random.default_rng(seed).choice(rows, MAX_SENSITIVITY_RUNS, replace=False))
        values, X = values[rows], X[rows]
        rbd_fast = optional("SALib.analyze.rbd_fast", SENSITIVITY_USE)
        si = rbd_fast.analyze(problem, X, values, num_resamples=RESAMPLES, seed=seed)
    moved, chance = _shifts(X, values, np.random.default_rng([seed, 1]))
    order = np.argsort(-moved)
    first = tuple((float(si["S1"][k]), float(si["S1_conf"][k])) for k in order)
    return Sensitivity(outcome, tuple(names[k] for k in order), first, pawn=tuple(moved[order].tolist()), chance=chance)


def _shifts(X: Array, values: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """Return the PAWN index of each factor, and the chance level that the largest exceeds in one of 20 sweeps.

    The index (F. Pianosi and T. Wagener, Environmental Modelling & Software 108, 2018) is the mean over slices of a
    factor of the Kolmogorov-Smirnov distance between the outcomes in the slice and all outcomes. The chance level is
    computed with outcomes in random order, for all factors together.
    """
    order, count = np.argsort(values, kind="stable"), values.size
    last = np.append(np.diff(values[order]) > 0.0, True)  # distances are evaluated after the last of equal outcomes
    whole = np.arange(1, count + 1) / count
    slices = []  # for each factor, the slice of each run, in the order of increasing outcome
    for x in X[order].T:
        edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, SLICES + 1)))
        label = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(0, len(edges) - 2))
        slices.append((label[:, None] == np.unique(label)).astype(np.float64))

    def indices(orders: Rows) -> Array:
        """Return the index of each factor, for each order of the outcomes: shape (orders, factors)."""
        found = []
        for inside in slices:
            share = np.cumsum(inside[orders], axis=1) / inside.sum(axis=0)
            found.append(np.abs(share - whole[:, None])[:, last].max(axis=1).mean(axis=1))
        return np.column_stack(found)

    drawn = indices(rng.permuted(np.tile(np.arange(count), (SHUFFLES, 1)), axis=1)).max(axis=1)
    return indices(np.arange(count)[None])[0], float(np.quantile(drawn, CHANCE))
