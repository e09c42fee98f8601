"""A hypothesis, and the outcome of trying them all."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from cosim.refinement.candidates import Candidate
from cosim.refinement.fit import Fit

NOISE = 4.0  # log-likelihood that the process noise of an equation must gain, to be more than none


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

    @property
    def of_sensors(self) -> bool:
        """It says something of sensors and nothing of the plant."""
        return {c.kind for c in self.candidates} == {"sensor"}


@dataclass(frozen=True)
class Attribution:
    """The outcome: the base fit, every hypothesis tried (best first), the one that stands, and its rivals."""

    base: Hypothesis
    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    rivals: tuple[Hypothesis, ...]
    held_out: float  # log-likelihood the best one gains on each log, its parameters as the others have them
    noise_gain: tuple[float, ...]  # log-likelihood that the process noise of each forced equation gains in the best one
    reasons: Mapping[tuple[str, ...], str] = field(default_factory=dict)  # why each hypothesis but the best lost
    hidden: tuple[str, ...] = ()  # effects that these logs could not show at the size at which they are usually met

    @property
    def noisy(self) -> tuple[bool, ...]:
        """Whether process noise is left in each forced equation: something remains to be explained."""
        return tuple(gain > NOISE for gain in self.noise_gain)

    @property
    def quiet(self) -> bool:
        """No process noise is left: nothing remains to be explained."""
        return not any(self.noisy)
