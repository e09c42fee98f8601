"""The design of a sweep: a value of everything that varies, for each run.

Distributions are drawn together, a row a run; each row goes with every combination of what is listed.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cosim.base.arrays import Array
from cosim.base.extras import optional

MOST_RUNS = 1_000_000
Sampling = Literal["latin-hypercube", "sobol", "random", "saltelli"]


@dataclass(frozen=True)
class Factor:
    """One thing that varies: a list of values, or the inverse of a distribution function.

    name:   as in the file
    unit:   of its values, "" where there is none
    values: in order, of a list
    drawn:  share 0 … 1 → value, of a distribution
    first:  of whole numbers that are counted on from run to run
    """

    name: str
    unit: str = ""
    values: Sequence[Any] | None = None
    drawn: Callable[[Array], Array] | None = None
    first: int | None = None


def distribution(way: str, numbers: Sequence[float], within: Sequence[float] | None = None) -> Callable[[Array], Array]:
    """Inverse distribution function; ValueError says what is wrong with its numbers."""
    from scipy.stats import norm, triang, truncnorm  # takes longer than all else that is imported

    if way == "normal":
        mean, deviation = numbers
        if not deviation > 0:
            raise ValueError(f"a standard deviation of {deviation:g} is none; give one above 0")
        if not within:
            return lambda u: norm.ppf(u, mean, deviation)
        low, high = within
        if not low < high:
            raise ValueError(f"within {low:g} … {high:g} there is nothing; write the lower end first")
        a, b = (low - mean) / deviation, (high - mean) / deviation
        if norm.cdf(b) - norm.cdf(a) < 1e-9:
            raise ValueError(f"within {low:g} … {high:g} there is nothing of the distribution; move its ends")
        return lambda u: truncnorm.ppf(u, a, b, mean, deviation)
    low, high = numbers[0], numbers[-1]
    if not low < high:
        raise ValueError(f"between {low:g} and {high:g} there is nothing; write the lower end first")
    if way == "uniform":
        return lambda u: low + (high - low) * u
    if way == "triangular":
        if not low <= numbers[1] <= high:
            raise ValueError(f"the most likely, {numbers[1]:g}, is not between {low:g} and {high:g}")
        return lambda u: triang.ppf(u, (numbers[1] - low) / (high - low), low, high - low)
    if low <= 0:
        raise ValueError(f"the logarithm of {low:g} is none; give ends above 0")
    return lambda u: np.exp(math.log(low) + (math.log(high) - math.log(low)) * u)


def drawn_rows(sampled: int, counted: bool, runs: int, sampling: Sampling) -> int:
    """How many rows are drawn of so many distributions: `runs`, of saltelli the most that fit; 1 where nothing is."""
    if not sampled:
        return runs if counted else 1
    return runs if sampling != "saltelli" else saltelli_base(runs, sampled) * (sampled + 2)


def saltelli_base(runs: int, count: int) -> int:
    """The power of 2 for which N·(count + 2) is `runs` at most; 0 where there is none."""
    return 2 ** int(math.log2(runs / (count + 2))) if runs >= count + 2 else 0


def columns_of(factors: Sequence[Factor], runs: int, sampling: Sampling, seed: int) -> dict[str, list[Any]]:
    """Factor → its value in each run."""
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
    """Points in the unit cube, shape (rows, count)."""
    rng = np.random.default_rng([seed, 0x5EED])
    if not count:
        return np.empty((rows, 0))
    if sampling == "random":
        return rng.random((rows, count))
    if sampling == "saltelli":
        sobol = optional("SALib.sample.sobol", "a sweep sampled by saltelli")
        problem = {"num_vars": count, "names": [str(k) for k in range(count)], "bounds": [[0.0, 1.0]] * count}
        found: Array = sobol.sample(problem, saltelli_base(rows, count), calc_second_order=False, seed=seed)
        return np.clip(found, 1e-12, 1.0 - 1e-12)
    from scipy.stats import qmc

    kind: Any = qmc.LatinHypercube if sampling == "latin-hypercube" else qmc.Sobol
    with warnings.catch_warnings():  # of a number of points that is no power of 2, for which the user has asked
        warnings.simplefilter("ignore", UserWarning)
        points: Array = kind(count, seed=rng).random(rows)
    return np.clip(points, 1e-12, 1.0 - 1e-12)
