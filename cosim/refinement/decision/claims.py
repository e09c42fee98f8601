"""`Claims`: what a study claims, and what its sentence and report are written from."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.estimation.subject.candidates import Candidate
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.posterior import Bundle, Decision, Grade, Names, Verdict
from cosim.refinement.search.hypotheses import TOGETHER, Hypothesis

DEFAULT_EXPERIMENT = "larger and broader commands on all inputs, one at a time and together"
NO_EFFECT = "no_effect"


@dataclass(frozen=True, eq=False)
class Claims:
    """What a study claims.

    Attributes:
        bundle: What the decision depends on.
        decision: Verdict, probabilities and reasons.
        base: The recalibrated model.
        claimed: Hypothesis that is delivered as refined, with intervals; None without a certain part.
        nearest: Hypothesis that is delivered as nearest; None for the given model, or with a complete claim.
        tried: Every fitted hypothesis with its log posterior odds to the recalibrated model, most probable first.
        experiment: Input that separates the rivals.
        equivalent: Groups of names that act alike for every input.
        residual: Deficient equation, its signals and process noise.
        moves: Forced state → size of its unknown input relative to its derivative.
        hidden: Effects that these logs cannot show.
        still: Whether nothing moves in the logs.
        ladder: Models with the log error of their predictions on each log left out, simplest first.
    """

    bundle: Bundle
    decision: Decision
    base: Hypothesis
    claimed: Hypothesis | None
    nearest: Hypothesis | None
    tried: Sequence[tuple[Hypothesis, float]]
    experiment: str
    equivalent: Sequence[Sequence[str]]
    residual: Mapping[str, Any]
    moves: Mapping[str, float]
    hidden: Sequence[str]
    still: bool
    ladder: Sequence[tuple[Hypothesis | None, Any]]

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
    def delivered(self) -> Hypothesis | None:
        """Return the hypothesis that predicts best of what may be delivered; None for the given model."""
        return self.claimed or self.nearest

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
    common = frozenset[str].intersection(*rivals) if rivals else frozenset[str]()
    names = frozenset[str]().union(*rivals) - common
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
