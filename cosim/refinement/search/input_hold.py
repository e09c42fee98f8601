"""Comparison of held and interpolated inputs between rows by their likelihood.

Only the recalibrated base model is compared. The two alternatives are not nested, so their difference is compared with
its scatter over blocks of time (Vuong 1989).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from cosim.base.text import plain
from cosim.estimation.fit import fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.evidence import blocks_of, by_block
from cosim.refinement.search.hypotheses import Hypothesis

Way = Literal["held", "interpolated"]
LIKELIER, STEADILY = 5.0, 3.0  # gain ("very strong", Kass and Raftery 1995) and gain per scatter to warn


@dataclass(frozen=True)
class Between:
    """Interpolation of each input, and the log-likelihood gain of the opposite choice for all inputs.

    Attributes:
        steady: Gain divided by its scatter over blocks of time.
    """

    taken: Mapping[str, Way]
    gain: float
    steady: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the opposite choice is clearly likelier."""
        if not (self.gain > LIKELIER and self.steady > STEADILY):
            return ()
        other = {name: _other(way) for name, way in self.taken.items()}
        ways = set(other.values())
        said = ", ".join(f"{name}: {way}" for name, way in other.items())
        line = f"`inputs: {ways.pop()}`" if len(ways) == 1 else f"`inputs: {{{said}}}`"
        taken = " and ".join(f"{_those(self.taken, way)} {way}" for way in dict.fromkeys(self.taken.values()))
        return (
            f"between rows {taken}; the other way the logs are likelier by {plain(self.gain)} in log-likelihood, "
            f"{plain(self.steady, 2)} times its scatter: if the rig commands so, say {line} in the study",
        )


def between_rows(problem: Problem, base: Hypothesis) -> Between:
    """Refit the recalibrated model with the opposite interpolation of every input."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    # Unknown inputs start large enough to move, because inputs that compensated the wrong choice converge slowly.
    again = fit(other, base.fit.free, base.fit.values, other.plain)
    taken: dict[str, Way] = {name: "interpolated" if name in ramped else "held" for name in names}
    now, then = problem.scored(base.fit.values, base.fit.noise), other.scored(again.values, again.noise)
    block = blocks_of(problem, now, math.exp(base.fit.noise.memory))
    steady = by_block(block, now, then, base.fit.penalty - again.penalty)
    return Between(taken, base.fit.objective - again.objective, steady)


def _those(taken: Mapping[str, Way], way: Way) -> str:
    names = [name for name, taken_so in taken.items() if taken_so == way]
    return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} taken as"


def _other(way: Way) -> Way:
    return "held" if way == "interpolated" else "interpolated"
