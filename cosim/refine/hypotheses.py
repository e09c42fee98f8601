"""A hypothesis, and the outcome of trying them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from cosim.refine.candidates import Candidate
from cosim.refine.fit import Fit


@dataclass(frozen=True)
class Hypothesis:
    """Some candidates together, fitted."""

    candidates: tuple[Candidate, ...]
    fit: Fit
    score: float

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, sorted."""
        return tuple(sorted(c.name for c in self.candidates))


@dataclass(frozen=True)
class Attribution:
    """The outcome: the base fit, every hypothesis tried (best first), the one that stands, and its rivals."""

    base: Hypothesis
    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    rivals: tuple[Hypothesis, ...]
    held_out: float  # log-likelihood the best one gains on logs it was not fitted on
    noisy: tuple[bool, ...]  # whether process noise is left in each forced equation: something remains to be explained
    reasons: Mapping[str, str] = field(default_factory=dict)  # why each single candidate lost
    hidden: tuple[str, ...] = ()  # effects that these logs could not show at the size at which they are usually met

    @property
    def quiet(self) -> bool:
        """No process noise is left: nothing remains to be explained."""
        return not any(self.noisy)
