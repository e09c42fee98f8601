"""Hypotheses: fitted sets of candidates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Candidate

TOGETHER = " + "  # separator between the names of a rival with several candidates


@dataclass(frozen=True)
class Hypothesis:
    """A fitted set of candidates.

    Attributes:
        ended: True if fitted with the model's own substeps and all noise free.
    """

    candidates: tuple[Candidate, ...]
    fit: Fit
    score: float
    ended: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Return the sorted names of the candidates."""
        return tuple(sorted(c.name for c in self.candidates))

    @property
    def is_of_sensors(self) -> bool:
        """Return True if all candidates are sensor errors."""
        return {c.kind for c in self.candidates} == {"sensor"}

    def loss_without(self, c: Candidate, neutral: Mapping[str, float]) -> float:
        """Return the estimated log-likelihood loss without a part."""
        away = np.array([self.fit.values[f.name] - neutral[f.name] for f in c.free])
        return 0.5 * float(away @ self.fit.marginal(c.parameters) @ away)


def best_hypothesis(hypotheses: Iterable[Hypothesis]) -> Hypothesis:
    """Return the hypothesis with the best score."""
    return min(hypotheses, key=lambda h: h.score)
