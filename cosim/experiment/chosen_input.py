"""The input that was chosen: the expected separation of the rivals, the excursions, and both in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosim.base.text import counted
from cosim.experiment.question import Question
from cosim.experiment.rigs import Rig, Trial
from cosim.experiment.separation import Pair

SEPARATED = 3.0  # standard deviations between rivals, from which a log decides
CURE = "try a wider --limit, a longer --duration or more outputs --measured"
LISTED = 5  # pairs named in a line, or a line each, before the rest is counted


@dataclass(frozen=True)
class Excitation:
    """An experiment, played by the model and by its rivals.

    apart, usual: how far it, and what is usually played, drive each pair apart [standard deviations]
    usually:      what is usually played
    """

    question: Question
    rig: Rig
    trial: Trial
    rivals: Mapping[str, Trial]
    apart: Mapping[Pair, float]
    usual: Mapping[Pair, float]
    usually: Trial

    @property
    def score(self) -> tuple[int, float]:
        """Merit of its distances, divided by how far beyond its limits a rival takes the model."""
        return merit_of(self.apart, max([1.0, *(f.beyond(self.question.limits) for f in self.rivals.values())]))

    @property
    def headline(self) -> str:
        """Return how many pairs the input separates, and the distance of the hardest."""
        count, pairs = sum(distance >= SEPARATED for distance in self.apart.values()), counted(len(self.apart), "pair")
        hardest = self.hardest_first[0]
        least = f"{self.apart[hardest]:.1f} standard deviations apart, {SEPARATED:g} are needed"
        return f"The input separates {count} of {pairs} of rivals; {hardest[0]} and {hardest[1]} are {least}."

    @property
    def distances(self) -> list[str]:
        """A line for each pair, hardest first."""
        return [
            f"{a} from {b}: {self.apart[a, b]:.1f} standard deviations ({self.rig.usual}: {self.usual[a, b]:.1f})"
            for a, b in self.hardest_first
        ]

    @property
    def sentences(self) -> list[str]:
        """What it separates, hardest first, and how far it goes, also if a rival is true and takes it farther."""
        lines = self.distances
        if len(lines) > LISTED + 1:
            least = self.apart[self.hardest_first[LISTED]]
            rest = counted(len(lines) - LISTED, "more pair")
            lines[LISTED:] = [f"and {rest}, {least:.1f} standard deviations apart at least"]
        lines.append(f"excursion: {self._ranges(self.trial)}")
        for name, trial in self.rivals.items():
            if trial.beyond(self.question.limits) > 1.0:
                lines.append(f"beyond its limits if {name} is true: {self._ranges(trial)}")
        return lines

    @property
    def warning(self) -> str:
        """The pairs it does not separate, and what separates more but leaves the limits; empty without either."""
        return "; ".join(filter(None, (self._inseparable, self._surpassed)))

    @property
    def _surpassed(self) -> str:
        """What is usually played, where it separates better: it then goes beyond the limits."""
        beyond = self.usually.beyond(self.question.limits)
        if not 1.0 < beyond < np.inf or merit_of(self.usual) <= merit_of(self.apart):
            return ""
        (count, least), pairs = merit_of(self.usual), counted(len(self.apart), "pair")
        what = f"{count} of {pairs}, the nearest {least:.1f} standard deviations apart"
        return f"{self.rig.usual} separates better ({what}) but goes {beyond:.1f} times as far as --limit allows"

    @property
    def _inseparable(self) -> str:
        if not (left := [pair for pair in self.hardest_first if self.apart[pair] < SEPARATED]):
            return ""
        named = [f"{a} from {b}" for a, b in left[:LISTED]] + ([f"{len(left) - LISTED} more"] if left[LISTED:] else [])
        what = f"the best input found does not tell {', '.join(named)}"
        return f"{what} (less than {SEPARATED:g} standard deviations apart); {CURE}"

    @property
    def hardest_first(self) -> list[Pair]:
        """Pairs of rivals, the nearest first."""
        return sorted(self.apart, key=lambda pair: self.apart[pair])

    def _ranges(self, trial: Trial) -> str:
        model = self.question.loaded.model
        units = {q.name: q.unit for q in model.outputs}
        shown = [n for n in units if n in self.question.limits] or list(self.question.measured)
        ranges = ((n, *trial.excursion(n)) for n in shown)
        return ", ".join(f"{n} {low:.3g} to {high:.3g} {units[n]}" for n, low, high in ranges)


def merit_of(apart: Mapping[Pair, float], beyond: float = 1.0) -> tuple[int, float]:
    """How many pairs are separated, and the distance of the nearest of them; of the farthest where none is."""
    distances = [distance / beyond for distance in apart.values()]
    separated = [distance for distance in distances if distance >= SEPARATED]
    return len(separated), min(separated, default=max(distances))
