"""Is an estimator as good as it believes? Normalised errors and innovations, held against their χ² distribution.

    NEES  ε = (x − x̂)'·P⁻¹·(x − x̂),   n degrees of freedom, n states
    NIS   ε = ν'·S⁻¹·ν,               m degrees of freedom, m measurements

Of N independent runs N·(mean of ε at a time) is χ² with N·n degrees of freedom, where the estimator is consistent
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4). That is asked twice:

    of the mean over all times    a consistent one has n; runs are independent, so their scatter is its uncertainty
    of each time by itself        2.5 % of the times lie above the region of 95 %, 2.5 % below it

Errors of one time and the next are alike, so shares of times scatter as those of fewer, independent times would.
Innovations of a consistent estimator are white: all times count, and the mean of K is χ² with N·K·m. The two questions
share the 5 % in which a verdict on a consistent one is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array

LEVEL = 0.95
SIDE = 0.5 * (1.0 - LEVEL)  # of the times, to either side of their region
HALF = 0.25 * (1.0 - LEVEL)  # to either side, of one of the two questions
CONSISTENT, OPTIMISTIC, PESSIMISTIC = "consistent", "optimistic", "pessimistic"
BOTH = f"{OPTIMISTIC} and {PESSIMISTIC}"
ROWS = 256  # of the matrix of correlations, at once


@dataclass(frozen=True)
class Consistency:
    """Of one kind of normalised squares: what was found, what a consistent estimator has, what follows.

    mean:         over runs and times; region: where that of a consistent one is
    above, below: shares of the times, whose own mean over the runs lies to that side of the region of one time
    most:         the largest such share of a consistent one; 2.5 % is expected
    times:        independent ones that would scatter as much as these
    at_times:     mean over the runs at each time; at_time: the region of 95 % for it
    """

    degrees: int
    runs: int
    mean: float
    region: tuple[float, float]
    above: float
    below: float
    most: float
    times: float
    at_times: Array = field(compare=False)
    at_time: tuple[float, float]

    @property
    def share(self) -> float:
        """Of the times, those within their region; 0.95 is expected."""
        return 1.0 - self.above - self.below

    @property
    def verdict(self) -> str:
        """Optimistic where errors are larger than it believes, in the mean or at too many times; pessimistic; both."""
        low, high = self.region
        optimistic = self.mean > high or self.above > self.most
        pessimistic = self.mean < low or self.below > self.most
        if optimistic and pessimistic:
            return BOTH
        return OPTIMISTIC if optimistic else PESSIMISTIC if pessimistic else CONSISTENT

    @property
    def factor(self) -> float:
        """By how much: mean square error over the variance that it believes in."""
        return self.mean / self.degrees

    @property
    def sentence(self) -> str:
        """The verdict in words, with the numbers that it rests on."""
        low, high = self.region
        verdict = self.verdict
        if verdict == CONSISTENT:
            return verdict
        told = []
        if not low <= self.mean <= high:
            times, which = (self.factor, "larger") if self.mean > high else (1.0 / self.factor, "smaller")
            told.append(f"square errors are {times:.3g} times {which} than it believes")
        chance = f"of the times, where {100 * SIDE:.3g} % are chance and {100 * self.most:.2g} % the most"
        if verdict == BOTH:
            told.append(
                f"{OPTIMISTIC} at {100 * self.above:.3g} % and {PESSIMISTIC} at {100 * self.below:.3g} % {chance}"
            )
        elif not told:
            told.append(f"at {100 * max(self.above, self.below):.3g} % {chance}")
        return f"{verdict}: {'; '.join(told)}"

    def as_json(self) -> Mapping[str, Any]:
        """For a script."""
        kept = {"degrees": self.degrees, "runs": self.runs, "mean": self.mean, "region": list(self.region)}
        shares = {"share": self.share, "above": self.above, "below": self.below, "most": self.most}
        return {**kept, **shares, "times": self.times, "verdict": self.verdict, "factor": self.factor}


def consistency_of(squares: Array, degrees: int, *, white: bool = False) -> Consistency:
    """From normalised squares, shape (runs, times), each with so many degrees of freedom.

    white: those of a run do not depend on each other, as innovations
    Raises ValueError where a square is no number, or there are fewer than two runs.
    """
    from scipy.stats import beta, chi2, t

    if not np.isfinite(squares).all() or squares.size == 0:
        raise ValueError("normalised squares are finite, and there is one at least")
    runs, count = squares.shape
    if runs < 2:
        raise ValueError("one run tells nothing of the scatter between runs; give two at least")

    def of_squares(number: int, tail: float) -> tuple[float, float]:
        low, high = chi2.ppf([tail, 1.0 - tail], number * degrees) / number
        return float(low), float(high)

    low, high = of_squares(runs, SIDE)
    at_times = squares.mean(axis=0)
    if white:
        region, times = of_squares(squares.size, HALF), float(count)
    else:
        off = float(t.ppf(1.0 - HALF, runs - 1) * squares.mean(axis=1).std(ddof=1) / math.sqrt(runs))
        region, times = (degrees - off, degrees + off), independent_times(squares)
    rest = max(times - 1.0, 1e-6)  # the beta distribution with this mean and the variance p·(1 − p)/times
    most = float(beta.ppf(1.0 - HALF, SIDE * rest, (1.0 - SIDE) * rest))
    above, below = float(np.mean(at_times > high)), float(np.mean(at_times < low))
    return Consistency(degrees, runs, float(squares.mean()), region, above, below, most, times, at_times, (low, high))


def independent_times(squares: Array) -> float:
    """So many independent times have shares that scatter as much: p·(1 − p)/K = mean of cov(1(z_j > c), 1(z_k > c)).

    z_j is the mean over the runs at time j, nearly normal, its correlations those between runs; c its 97.5 % quantile.
    """
    off = squares - squares.mean(axis=0)
    size = np.sqrt((off * off).sum(axis=0))
    z = np.divide(off, size, out=np.zeros_like(off), where=size > 0.0)
    grid, covariance = _covariances()
    total = sum(np.interp(z[:, k : k + ROWS].T @ z, grid, covariance).sum() for k in range(0, z.shape[1], ROWS))
    return float(np.clip(SIDE * (1.0 - SIDE) * z.shape[1] ** 2 / max(total, 1e-300), 1.0, z.shape[1]))


def _covariances() -> tuple[Array, Array]:
    """Correlations ρ of two normal numbers and cov(1(z₁ > c), 1(z₂ > c)) = ∫₀^asin ρ exp(−c²/(1 + sin θ)) dθ/2π."""
    from scipy.integrate import cumulative_simpson
    from scipy.stats import norm

    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2001)
    with np.errstate(divide="ignore"):
        density = np.exp(-(norm.ppf(SIDE) ** 2) / (1.0 + np.sin(angle))) / (2.0 * math.pi)
    whole = cumulative_simpson(density, x=angle, initial=0.0)
    return np.sin(angle), whole - whole[1000]


@dataclass(frozen=True)
class Row:
    """A result of one case on one flight.

    case:   estimator and truth
    flight: name of the motion; motion: what happens in it
    of:     which squares; at: their times [s]
    """

    case: str
    flight: str
    motion: str
    of: str
    result: Consistency
    at: Array

    def as_json(self) -> Mapping[str, Any]:
        """For a script."""
        named = {"case": self.case, "flight": self.flight, "motion": self.motion, "of": self.of}
        return {**named, **self.result.as_json()}


@dataclass(frozen=True)
class Judged:
    """All results of one case on one flight."""

    rows: Sequence[Row]

    @property
    def consistent(self) -> bool:
        """Whether every kind of squares is."""
        return all(row.result.verdict == CONSISTENT for row in self.rows)

    @property
    def verdict(self) -> str:
        """Return what its squares are: consistent, optimistic, pessimistic, or both of these."""
        kinds = {kind for row in self.rows for kind in (OPTIMISTIC, PESSIMISTIC) if kind in row.result.verdict}
        return BOTH if len(kinds) == 2 else next(iter(kinds), CONSISTENT)

    @property
    def factor(self) -> float:
        """Return the mean square error of the estimate over the variance that it believes in."""
        return self.rows[0].result.factor


def by_case(rows: Sequence[Row]) -> list[Judged]:
    """Return the rows of each case and flight together, in order."""
    return [
        Judged([row for row in rows if (row.case, row.flight) == key])
        for key in dict.fromkeys((row.case, row.flight) for row in rows)
    ]


def headline(rows: Sequence[Row]) -> str:
    """Return how many cases are consistent, and in a second sentence the case with the largest errors."""
    judged = by_case(rows)
    right, largest = sum(j.consistent for j in judged), worst(judged)
    opening = f"{right} of {len(judged)} cases are consistent: errors match the variance that the estimator claims."
    if largest is None:
        return opening
    case = f"{largest.rows[0].case}, {largest.rows[0].flight}"
    return f"{opening} Largest errors: {case}: mean square error {largest.factor:.3g} times the claimed variance."


def worst(judged: Sequence[Judged]) -> Judged | None:
    """Return the case with the largest errors for the variance that it claims; None where all are consistent."""
    largest = max(judged, key=lambda j: j.factor)
    return None if largest.factor <= 1.0 or largest.consistent else largest
