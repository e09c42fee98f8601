"""By what a hypothesis is judged: significance, limits, process noise that it leaves, and rivals."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cosim.refinement.candidates import Candidate, Free
from cosim.refinement.fit import Fit
from cosim.refinement.hypotheses import NOISE, Hypothesis
from cosim.refinement.problem import Problem

RIVAL = 5.0  # score within which another hypothesis explains as well
SIGNIFICANT = 3.0  # standard deviations from neutral
SIGNIFICANT_IN_NOISE = 15.0  # the same where process noise is left: intervals that take it for white are too narrow


def noise_gain(problem: Problem, f: Fit) -> tuple[float, ...]:
    """Log-likelihood that the process noise of each forced equation gains in a fit."""
    without = np.diag(problem.noise.smallest - f.log_q) + f.log_q
    return tuple(problem.scored(f.values, log_q).nll - f.nll for log_q in without)


def is_noisy(problem: Problem, f: Fit) -> bool:
    """Some forced equation needs its process noise in a fit."""
    return any(gain > NOISE for gain in noise_gain(problem, f))


def strained(f: Fit, claim: float) -> bool:
    """Some base parameter is so far from its data sheet that its prior costs more than a claim must gain."""
    return any(0.5 * ((f.values[x.name] - x.prior[0]) / x.prior[1]) ** 2 > claim for x in f.free if x.prior)


def at_limit(h: Hypothesis, f: Free, neutral: Mapping[str, float]) -> bool:
    """Moved, and as far as it may; to neutral is where an effect that the model has too much of belongs."""
    value = h.fit.values[f.name]
    return value in (f.low, f.high) and value not in (neutral[f.name], f.neutral)


def significant(h: Hypothesis, c: Candidate, neutral: Mapping[str, float], least: float = SIGNIFICANT) -> bool:
    """Away from neutral by Wald's test of all its parameters together, and none of them at a limit."""
    away = np.array([h.fit.values[f.name] - neutral[f.name] for f in c.free])
    pinned = any(at_limit(h, f, neutral) for f in c.free)
    return not pinned and bool(away @ h.fit.marginal(c.parameters) @ away > least**2)


@dataclass(frozen=True)
class Contest:
    """Every hypothesis that was tried, best score first, and the one that stands.

    claim:   score that a candidate must gain
    neutral: values of all parameters in the model as it is
    drowned: names of those that are significant, but not beside the process noise that they leave
    """

    base: Hypothesis
    best: Hypothesis
    tried: Sequence[Hypothesis]
    claim: float
    neutral: Mapping[str, float]
    drowned: Container[tuple[str, ...]]

    def rivals(self) -> tuple[Hypothesis, ...]:
        """Other hypotheses of no more candidates that explain as well."""
        if self.best is self.base:
            return ()
        return tuple(
            h
            for h in self.tried
            if h.names != self.best.names and self._is_as_simple(h) and h.score - self.best.score < RIVAL
        )

    def reasons(self) -> dict[tuple[str, ...], str]:
        """Why each hypothesis but the best is not the answer, in words."""
        return {h.names: self._reason(h) for h in self.tried if h.names != self.best.names}

    def _reason(self, h: Hypothesis) -> str:
        """The first that applies."""
        gained, behind = self.base.score - h.score, h.score - self.best.score
        than = " and ".join(self.best.names) or "the base model"
        if self.best is not self.base and abs(behind) < RIVAL and self._is_as_simple(h):
            return f"a rival: explains as well as {than}, within {RIVAL:.0f}"
        if gained <= 0:
            return "no gain"
        if gained < self.claim:
            return f"gains {gained:.1f}, less than the {self.claim:.0f} that a candidate must"
        if h.fit.iterations == 0:
            return f"explains less than {than} by {behind:.1f}, by its score test"
        if limits := [f.name for c in h.candidates for f in c.free if at_limit(h, f, self.neutral)]:
            return f"{limits[0]} is at its limit"
        if not all(significant(h, c, self.neutral) for c in h.candidates):
            return "not significantly away from neutral"
        if h.names in self.drowned:
            return f"less than {SIGNIFICANT_IN_NOISE:.0f} standard deviations from neutral, and process noise is left"
        if behind < 0.0:
            return f"gains {-behind:.1f} on {than}, less than an added effect must"
        return f"explains less than {than} by {behind:.1f}"

    def _is_as_simple(self, h: Hypothesis) -> bool:
        return len(h.candidates) <= len(self.best.candidates)
