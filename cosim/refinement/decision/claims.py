"""`Claims`: what a study claims, and what its sentence and report are written from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.posterior import Bundle, Decision, Grade, Names, Verdict
from cosim.refinement.search.fits import TOGETHER, Hypothesis

DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"
NO_EFFECT = "no_effect"


@dataclass(frozen=True, eq=False)
class Claims:
    """What a study claims."""

    bundle: Bundle  # what the decision depends on
    decision: Decision
    base: Hypothesis  # the recalibrated model
    claimed: Hypothesis | None  # delivered as refined, with intervals; None without a certain part
    nearest: Hypothesis | None  # delivered as nearest; None for the given model, or with a complete claim
    tried: Sequence[tuple[Hypothesis, float]]  # with log posterior odds to the recalibrated model, best first
    experiment: str  # input that separates the rivals
    equivalent: Sequence[Sequence[str]]  # groups of names that act alike for every input
    residual: Mapping[str, Any]  # deficient equation, its signals and process noise
    moves: Mapping[str, float]  # forced state → size of its unknown input relative to its derivative
    hidden: Sequence[str]  # effects that these logs cannot show
    still: bool  # whether nothing moves in the logs
    ladder: Sequence[tuple[Hypothesis | None, Any]]  # models with log errors on each log left out, simplest first

    @property
    def name(self) -> Verdict:
        """Return the verdict."""
        return self.decision.verdict

    @property
    def grade(self) -> Grade:
        """Return the completeness of the claim."""
        return self.decision.grade

    @property
    def best(self) -> Hypothesis:
        """Return the hypothesis of the most probable class."""
        return next(h for h, _ in self.tried if frozenset(h.names) == self.decision.nearest)

    @property
    def delivered(self) -> Hypothesis:
        """Return the hypothesis that predicts best of what may be delivered, else the recalibrated model."""
        return self.claimed or self.nearest or self.base

    @property
    def claimed_candidates(self) -> tuple[Candidate, ...]:
        """Return the claimed candidates, first those that are most probable alone."""
        if self.claimed is None:
            return ()
        alone = {h.names: odds for h, odds in self.tried if len(h.names) == 1}
        claimed = [c for c in self.claimed.candidates if c.name in self.decision.claimed]
        return tuple(sorted(claimed, key=lambda c: -alone.get((c.name,), -math.inf)))

    @property
    def rivals(self) -> tuple[str, ...]:
        """Return the rivals of an ambiguous verdict, `a + b` for two parts together."""
        return tuple(text_of(parts) for parts in self.decision.rivals)


def text_of(parts: Names) -> str:
    """Return the name of a set of parts."""
    return TOGETHER.join(sorted(parts)) or NO_EFFECT


def experiment_for(subject: Subject, rivals: Sequence[Names]) -> str:
    """Return the experiment that separates rivals; parts common to all of them need none."""
    names = frozenset[str]().union(*rivals) - frozenset[str].intersection(*rivals)
    experiments = [(len(row & names), text) for row, text in subject.told_apart_by.items()]
    shared, text = max(experiments, default=(0, ""))
    return text if shared > 1 else DEFAULT_EXPERIMENT


def equivalent_groups(pairs: Sequence[tuple[Names, Names]]) -> list[list[str]]:
    """Return groups of names that act alike, without what both sets contain."""
    groups: dict[str, list[str]] = {}
    for one, other in pairs:
        first, second = text_of(one - other), text_of(other - one)
        groups.setdefault(first, [first]).append(second)
    return list(groups.values())
