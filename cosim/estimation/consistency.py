"""Is an estimator as good as it believes? Normalised errors and innovations, held against their χ² distribution.

    NEES  ε = (x − x̂)'·P⁻¹·(x − x̂),   n degrees of freedom, n states
    NIS   ε = ν'·S⁻¹·ν,               m degrees of freedom, m measurements

Of N independent runs N·(mean of ε at a time) is χ² with N·n degrees of freedom, where the estimator is consistent.
Errors of one time and the next are alike, so the mean over all times is held against that region, which it leaves more
seldom. Innovations are white: the mean of K times is χ² with N·K·m, and its region is as much narrower.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.arrays import Array
from cosim.registry import BASE_NAME, MODELS, resolve

LEVEL = 0.95
SHORTEST = 50  # steps
CONSISTENT, OPTIMISTIC, PESSIMISTIC = "consistent", "optimistic", "pessimistic"


@dataclass(frozen=True)
class Consistency:
    """Of one kind of normalised squares: their mean, the region of 95 % for it, what follows.

    share: of the times, whose own mean over the runs lies in the region of one time; 0.95 is expected
    """

    degrees: int
    runs: int
    mean: float
    region: tuple[float, float]
    share: float

    @property
    def verdict(self) -> str:
        """Consistent within the region; optimistic where errors are larger than it believes, else pessimistic."""
        low, high = self.region
        return CONSISTENT if low <= self.mean <= high else OPTIMISTIC if self.mean > high else PESSIMISTIC

    @property
    def factor(self) -> float:
        """By how much: mean square error over the variance that it believes in."""
        return self.mean / self.degrees

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.verdict == CONSISTENT:
            return CONSISTENT
        times = self.factor if self.verdict == OPTIMISTIC else 1.0 / self.factor
        which = "larger" if self.verdict == OPTIMISTIC else "smaller"
        return f"{self.verdict}: square errors are {times:.3g} times {which} than it believes"

    def as_json(self) -> Mapping[str, Any]:
        """For a script."""
        kept = {"degrees": self.degrees, "runs": self.runs, "mean": self.mean, "region": list(self.region)}
        return {**kept, "share": self.share, "verdict": self.verdict, "factor": self.factor}


def consistency_of(squares: Array, degrees: int, *, white: bool = False) -> Consistency:
    """From normalised squares, shape (runs, times), each with so many degrees of freedom; ValueError where one is none.

    white: those of a run do not depend on each other, as innovations
    """
    from scipy.stats import chi2

    runs = len(squares)
    if not np.isfinite(squares).all() or squares.size == 0:
        raise ValueError("normalised squares are finite, and there is one at least")

    def region(count: int) -> tuple[float, float]:
        low, high = chi2.ppf([0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL)], count * degrees) / count
        return float(low), float(high)

    low, high = region(runs)
    at_times = squares.mean(axis=0)
    share = float(np.mean((low <= at_times) & (at_times <= high)))
    return Consistency(degrees, runs, float(squares.mean()), region(squares.size) if white else (low, high), share)


@dataclass(frozen=True)
class Row:
    """What an estimator and a truth came to: title of the case, of which squares, the result."""

    case: str
    of: str
    result: Consistency

    def as_json(self) -> Mapping[str, Any]:
        """For a script."""
        return {"case": self.case, "of": self.of, **self.result.as_json()}


def consistency(
    runs: int = 50, steps: int = 500, seed: int = 1, progress: Callable[[int, int], None] | None = None
) -> Sequence[Row]:
    """The estimators of the base model over Monte Carlo runs; ValueError for fewer than two runs or two seconds."""
    if runs < 2 or steps < 2 * SHORTEST or seed < 0:
        raise ValueError(f"takes at least 2 runs, {2 * SHORTEST} steps and a seed from 0 on: {runs}, {steps}, {seed}")
    squares_of = resolve(MODELS[BASE_NAME].estimators)
    cases = resolve(MODELS[BASE_NAME].cases)
    found = []
    for k, case in enumerate(cases):
        for name, (squares, degrees) in squares_of(case, runs, steps, np.random.default_rng([seed, k])).items():
            found.append(Row(case.title, name, consistency_of(squares, degrees, white=name != "NEES")))
        if progress is not None:
            progress(k + 1, len(cases))
    return found
