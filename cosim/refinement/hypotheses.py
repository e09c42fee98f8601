"""A hypothesis, and the outcome of trying them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cosim.refinement.candidates import Candidate
from cosim.refinement.fit import Fit

if TYPE_CHECKING:
    from cosim.refinement.evidence import Support
    from cosim.refinement.search import Search

NOISE = 4.0  # log-likelihood that the unknown input of an equation must gain, to be more than none


@dataclass(frozen=True)
class Hypothesis:
    """Some candidates together, fitted; `ended`: at the model's own substeps, with all noise free."""

    candidates: tuple[Candidate, ...]
    fit: Fit
    score: float
    ended: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, sorted."""
        return tuple(sorted(c.name for c in self.candidates))

    @property
    def of_sensors(self) -> bool:
        """It says something of sensors and nothing of the plant."""
        return {c.kind for c in self.candidates} == {"sensor"}


@dataclass(frozen=True)
class Found:
    """What a search came to: the best hypothesis, and effects that these logs could not show at their usual size."""

    search: Search
    best: Hypothesis
    hidden: tuple[str, ...]


@dataclass(frozen=True)
class Attribution:
    """The outcome: the base fit, every hypothesis tried (best first), the one that stands, and its rivals."""

    base: Hypothesis
    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    rivals: tuple[Hypothesis, ...]
    total: Support  # of all of the best one together
    support: Mapping[str, Support]  # of each of its parts
    noise_gain: tuple[float, ...]  # log-likelihood that the unknown input of each forced equation gains in the best one
    reasons: Mapping[tuple[str, ...], str] = field(default_factory=dict)  # why each hypothesis but the best lost
    hidden: tuple[str, ...] = ()  # effects that these logs could not show at the size at which they are usually met

    @property
    def noisy(self) -> tuple[bool, ...]:
        """Whether an unknown input is left in each forced equation."""
        return tuple(gain > NOISE for gain in self.noise_gain)
