"""The chosen input of an experiment: separation of the rivals, excursions of signals, and sentences on both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosim.core.text import counted, join_names
from cosim.experiment.question import Question
from cosim.experiment.rigs import OpenLoop, Trial
from cosim.experiment.separation import MIN_SEPARATION, Pair

MAX_LISTED_PAIRS = 5  # pairs listed before the rest is counted


@dataclass(frozen=True)
class Excitation:
    """A designed experiment, simulated with the model and with each rival hypothesis.

    Attributes:
        trial, rivals: Simulation with the model, and with each rival, under the same signals.
        apart: Distance of each pair of rivals [standard deviations].
        usual: Distance of each pair under the rig's usual input, for comparison [standard deviations].
        usual_trial: Simulation of the model with the usual input.
    """

    question: Question
    rig: OpenLoop
    trial: Trial
    rivals: Mapping[str, Trial]
    apart: Mapping[Pair, float]
    usual: Mapping[Pair, float]
    usual_trial: Trial

    @property
    def score(self) -> tuple[int, float]:
        """Return the merit (see `merit_of`), reduced if a rival exceeds the limits."""
        return merit_of(self.apart, max([1.0, *(trial.excess(self.question.limits) for trial in self.rivals.values())]))

    @property
    def headline(self) -> str:
        """Return a sentence with the number of separated pairs of rivals and the pair that is hardest to separate."""
        count, _ = merit_of(self.apart)
        a, b = self.hardest_first[0]
        return (
            f"The input separates {count} of {counted(len(self.apart), 'pair')} of rivals; {a} and {b} are "
            f"{self.apart[a, b]:.1f} standard deviations apart, {MIN_SEPARATION:g} are needed."
        )

    @property
    def distances(self) -> list[str]:
        """Return a line per pair, the hardest pair first."""
        return [
            f"{a} from {b}: {self.apart[a, b]:.1f} standard deviations ({self.rig.usual}: {self.usual[a, b]:.1f})"
            for a, b in self.hardest_first
        ]

    @property
    def sentences(self) -> list[str]:
        """Return sentences on the distances of the pairs, hardest first, and on excursions of model and rivals."""
        lines = self.distances
        if len(lines) > MAX_LISTED_PAIRS + 1:
            least = self.apart[self.hardest_first[MAX_LISTED_PAIRS]]
            rest = counted(len(lines) - MAX_LISTED_PAIRS, "more pair")
            lines[MAX_LISTED_PAIRS:] = [f"and {rest}, {least:.1f} standard deviations apart at least"]
        limits = self.question.limits
        beyond = {n: trial for n, trial in self.rivals.items() if trial.excess(limits) > 1.0}
        trials = {"excursion": self.trial, **{f"beyond its limits if {n} is true": t for n, t in beyond.items()}}
        units = {q.name: q.unit for q in self.question.loaded.model.outputs}
        names = [n for n in units if n in limits] or self.question.measured
        for words, trial in trials.items():
            ranges = ", ".join(
                f"{n} {trial.outputs[n].min():.3g} to {trial.outputs[n].max():.3g} {units[n]}" for n in names
            )
            lines.append(f"{words}: {ranges}")
        return lines

    @property
    def warnings(self) -> list[str]:
        """Return warnings about inseparable pairs, and about a usual input that is better but exceeds the limits."""
        warnings = []
        if pairs := [f"{a} from {b}" for a, b in self.hardest_first if self.apart[a, b] < MIN_SEPARATION]:
            warnings.append(
                f"the best input does not tell {join_names(pairs)} (less than {MIN_SEPARATION:g} standard "
                "deviations apart); try a wider --limit, a longer --duration or more outputs --measured"
            )
        excess, (count, least) = self.usual_trial.excess(self.question.limits), merit_of(self.usual)
        if 1.0 < excess < np.inf and (count, least) > merit_of(self.apart):
            warnings.append(
                f"{self.rig.usual} separates better ({count} of {counted(len(self.apart), 'pair')}, the nearest "
                f"{least:.1f} standard deviations apart) but goes {excess:.1f} times as far as --limit allows"
            )
        return warnings

    @property
    def hardest_first(self) -> list[Pair]:
        """Return pairs of rivals, the hardest to separate first."""
        return sorted(self.apart, key=lambda pair: self.apart[pair])


def merit_of(apart: Mapping[Pair, float], excess: float = 1.0) -> tuple[int, float]:
    """Return the number of separated pairs and the smallest of their distances.

    Without separated pairs, the largest distance counts.

    Args:
        apart: Distance of each pair [standard deviations].
        excess: Largest excursion relative to its limit; reduces the distances.
    """
    distances = [distance / excess for distance in apart.values()]
    separated = [distance for distance in distances if distance >= MIN_SEPARATION]
    return len(separated), min(separated, default=max(distances))
