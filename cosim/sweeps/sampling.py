"""The design of a sweep: a value of each factor for each run.

Distributions are drawn together, a row per run. Each row is combined with all combinations of listed values.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cosim.core.arrays import Array
from cosim.core.extras import optional

MOST_RUNS = 1_000_000
Sampling = Literal["latin-hypercube", "sobol", "random", "saltelli"]


@dataclass(frozen=True)
class Factor:
    """A varied quantity: listed values, or the inverse of a distribution function.

    Attributes:
        name: Name in the file.
        unit: Unit of its values, or "".
        values: Listed values in order.
        drawn: Function from probability 0 … 1 to value.
        first: First of consecutive integers over the runs.
    """

    name: str
    unit: str = ""
    values: Sequence[Any] | None = None
    drawn: Callable[[Array], Array] | None = None
    first: int | None = None


def distribution(way: str, numbers: Sequence[float], within: Sequence[float] | None = None) -> Callable[[Array], Array]:
    """Return the inverse of a distribution function; raise ValueError for invalid numbers."""
    from scipy.stats import norm, triang, truncnorm  # This import is slower than all others.

    if way == "normal" and not numbers[1] > 0:
        raise ValueError(f"a standard deviation of {numbers[1]:g} is not allowed; give one above 0")
    if way == "normal" and not within:
        return lambda u: norm.ppf(u, *numbers)
    low, high = within if within and way == "normal" else (numbers[0], numbers[-1])
    if not low < high:
        text = "write the lower end first, the higher one second"
        raise ValueError(f"between {low:g} and {high:g} there is nothing; {text}")
    if way == "normal":
        mean, deviation = numbers
        a, b = (low - mean) / deviation, (high - mean) / deviation
        if norm.cdf(b) - norm.cdf(a) < 1e-9:
            raise ValueError(f"within {low:g} … {high:g} there is nothing of the distribution; move its ends")
        return lambda u: truncnorm.ppf(u, a, b, mean, deviation)
    if way == "uniform":
        return lambda u: low + (high - low) * u
    if way == "triangular":
        if not low <= numbers[1] <= high:
            text = f"the most likely value, {numbers[1]:g}, is not between {low:g} and {high:g}"
            raise ValueError(f"{text}; write low, most likely, high")
        return lambda u: triang.ppf(u, (numbers[1] - low) / (high - low), low, high - low)
    if low <= 0:
        raise ValueError(f"{low:g} has no logarithm; give ends above 0")
    return lambda u: np.exp(math.log(low) + (math.log(high) - math.log(low)) * u)


def drawn_rows(sampled: int, counted: bool, runs: int, sampling: Sampling) -> int:
    """Return the number of drawn rows. It is `runs`, for saltelli at most `runs`, and 1 without distributions."""
    if not sampled:
        return runs if counted else 1
    return runs if sampling != "saltelli" else saltelli_base(runs, sampled) * (sampled + 2)


def saltelli_base(runs: int, count: int) -> int:
    """Return the largest power of 2, N, with N·(count + 2) ≤ runs, or 0."""
    return 2 ** int(math.log2(runs / (count + 2))) if runs >= count + 2 else 0


def columns_of(factors: Sequence[Factor], runs: int, sampling: Sampling, seed: int) -> dict[str, list[Any]]:
    """Return the values of each factor by run."""
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
    """Return points in the unit cube, shape (rows, count)."""
    rng = np.random.default_rng([seed, 0x5EED])
    if not count:
        return np.empty((rows, 0))
    if sampling == "random":
        return rng.random((rows, count))
    points: Array
    if sampling == "saltelli":
        sobol = optional("SALib.sample.sobol", "a sweep sampled by saltelli")
        problem = {"num_vars": count, "names": [str(k) for k in range(count)], "bounds": [[0.0, 1.0]] * count}
        points = sobol.sample(problem, saltelli_base(rows, count), calc_second_order=False, seed=seed)
    else:
        from scipy.stats import qmc

        kind: Any = qmc.LatinHypercube if sampling == "latin-hypercube" else qmc.Sobol
        with warnings.catch_warnings():  # The user may choose a number of points that is no power of 2.
            warnings.simplefilter("ignore", UserWarning)
            points = kind(count, seed=rng).random(rows)
    return np.clip(points, 1e-12, 1.0 - 1e-12)


def are_numbers(values: Sequence[Any]) -> bool:
    """Return whether all values are numbers."""
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
