"""Hypotheses and the outcome of their comparison."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from cosim.estimation.fit import Fit
from cosim.estimation.subject.candidates import Candidate

TOGETHER = " + "  # separator between the names of a rival with several candidates
MAX_HALVED_RATIO = 0.5  # ratio of held-out errors from which an effect is never passed over
NOISE = 4.0  # log-likelihood gain from which an equation has an unknown input


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

    @property
    def is_of_parameters(self) -> bool:
        """Return True if no candidate is an effect or a sensor error."""
        return {c.kind for c in self.candidates} <= {"parameter"}

    def extends(self, other: Hypothesis) -> bool:
        """Return True if this hypothesis contains all parts of the other, and more."""
        return set(self.names) > set(other.names)

    def is_apart(self, other: Hypothesis) -> bool:
        """Return True if neither hypothesis contains the other."""
        names, others = set(self.names), set(other.names)
        return not (names <= others or names >= others)

    def is_away(self, c: Candidate, times: float, given: Mapping[str, float] | None = None) -> bool:
        """Return True if a parameter is more than `times` standard deviations from the given value, or from neutral.

        The shape of a term, all its parameters without neutral value, is held: without effect it is undetermined.

        Args:
            given: Values of the model, which may have an effect already; None for neutral ones.
        """
        shape = [f.name for f in c.free if f.neutral is None] if c.kind == "effect" else []
        start = {f.name: f.neutral if given is None else given[f.name] for f in c.free if f.neutral is not None}
        distances = {name: abs(self.fit.values[name] - value) for name, value in start.items()}
        return any(distance > times * self.fit.sigma(name, shape) for name, distance in distances.items())


def are_halved(ratios: Sequence[float]) -> bool:
    """Return True if ratios of errors by log are at most a half in their geometric mean, and all below 1."""
    if not ratios:
        return False
    return math.exp(sum(map(math.log, ratios)) / len(ratios)) <= MAX_HALVED_RATIO and max(ratios) < 1.0


def settled(tried: Iterable[Hypothesis], limit: float) -> list[Hypothesis]:
    """Return the hypotheses that were fitted to the end and have a score below a limit."""
    return [h for h in tried if h.ended and h.score < limit]


def best_hypothesis(hypotheses: Iterable[Hypothesis]) -> Hypothesis:
    """Return the hypothesis with the best score."""
    return min(hypotheses, key=lambda h: h.score)


@dataclass(frozen=True)
class Support:
    """Evidence for a hypothesis compared with a hypothesis without some of its candidates.

    Attributes:
        gain: Log-likelihood gain, priors included.
        steady: Gain divided by its scatter over time blocks.
        held_out: Log-likelihood gain on held-out logs; NaN if not computed.
        predicted: Decrease of squared open-loop errors on held-out logs divided by its scatter; NaN if not computed.
    """

    gain: float
    steady: float
    held_out: float = math.nan
    predicted: float = math.nan


@dataclass(frozen=True)
class Attribution:
    """Outcome of a search: the base fit, all hypotheses (best first), the supported hypothesis and its rivals.

    Attributes:
        unfitted: Given model with the noise of the base fit; only parameters per log are fitted.
    """

    base: Hypothesis
    unfitted: Fit
    tried: tuple[Hypothesis, ...]
    best: Hypothesis
    rivals: tuple[Hypothesis, ...]
    total: Support  # evidence for all parts of the best hypothesis together
    support: Mapping[str, Support]  # evidence for each part
    noise_gain: tuple[float, ...]  # log-likelihood gain of each forced equation's unknown input in the best fit
    reasons: Mapping[tuple[str, ...], str] = field(default_factory=dict)  # reasons against each other hypothesis
    hidden: tuple[str, ...] = ()  # effects that these logs cannot show at their usual size
    effects: int = 0  # number of effects on trial
    fuller: Hypothesis | None = None  # best hypothesis including parts with gains too small to distinguish from chance
    error_ratios: tuple[float, ...] = ()  # held-out open-loop error, best hypothesis over recalibrated model, by log
    alike: Mapping[tuple[str, ...], Hypothesis] = field(
        default_factory=dict
    )  # names → what acts like it, best or rival
    refused: Mapping[str, str] = field(default_factory=dict)  # part that gains plainly → reason against it

    @property
    def halves_error(self) -> bool:
        """Return True if the best hypothesis halves the held-out error and reduces it on every log."""
        return are_halved(self.error_ratios)

    @property
    def has_unknown_input(self) -> tuple[bool, ...]:
        """Return, for each forced equation, whether an unknown input remains."""
        return tuple(gain > NOISE for gain in self.noise_gain)

    @property
    def small_parts(self) -> tuple[str, ...]:
        """Return the candidates of the fuller hypothesis whose likelihood gain may be chance."""
        return tuple(n for n in self.fuller.names if n not in self.best.names) if self.fuller else ()

    @property
    def is_blind(self) -> bool:
        """Return True if the logs could show none of the effects on trial."""
        return 0 < len(self.hidden) == self.effects
