"""A hypothesis, and the outcome of trying them all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from cosim.estimation.fit import Fit
from cosim.subject.candidates import Candidate

TOGETHER = " + "  # between the names of one of several rivals
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

    def is_away(self, c: Candidate, times: float) -> bool:
        """Whether a parameter of a candidate is more than so many standard deviations from neutral."""
        away = {f.name: abs(self.fit.values[f.name] - f.neutral) for f in c.free if f.neutral is not None}
        return any(distance > times * self.fit.sigma(name) for name, distance in away.items())


def leading(hypotheses: Iterable[Hypothesis]) -> Hypothesis:
    """Return the hypothesis with the best score, of equal ones the first."""
    return min(hypotheses, key=lambda h: h.score)


@dataclass(frozen=True)
class Support:
    """What speaks for a hypothesis against one that lacks something of it.

    gain:      log-likelihood, priors included
    steady:    how many times its own scatter over blocks of time the gain is
    held_out:  log-likelihood gained on each log, as the others have it; NaN: not asked for
    predicted: by how many times its scatter the square error of open-loop predictions of logs left out is less; NaN:
               as before
    """

    gain: float
    steady: float
    held_out: float = math.nan
    predicted: float = math.nan


@dataclass(frozen=True)
class Attribution:
    """The outcome: the base fit, every hypothesis tried (best first), the one that stands, and its rivals.

    given: the model as it was given, with the noise of the base fit; of it only parameters per log are fitted
    """

    base: Hypothesis
    given: Fit
    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    rivals: tuple[Hypothesis, ...]
    total: Support  # of all of the best one together
    support: Mapping[str, Support]  # of each of its parts
    noise_gain: tuple[float, ...]  # log-likelihood that the unknown input of each forced equation gains in the best one
    reasons: Mapping[tuple[str, ...], str] = field(default_factory=dict)  # why each hypothesis but the best lost
    hidden: tuple[str, ...] = ()  # effects that these logs could not show at the size at which they are usually met
    effects: int = 0  # how many were on trial
    fuller: Hypothesis | None = None  # the best one with parts that gain too little to be told from chance

    @property
    def noisy(self) -> tuple[bool, ...]:
        """Whether an unknown input is left in each forced equation."""
        return tuple(gain > NOISE for gain in self.noise_gain)

    @property
    def small(self) -> tuple[str, ...]:
        """Names of the parts that gain too little to be told from chance."""
        return tuple(n for n in self.fuller.names if n not in self.best.names) if self.fuller else ()

    @property
    def blind(self) -> bool:
        """Whether the logs could show none of the effects on trial."""
        return 0 < len(self.hidden) == self.effects
