"""What inputs do between two rows, held or straight to the next: how likely the logs are the other way.

Only the model recalibrated is asked. Neither way holds the other, so the difference is held against its own scatter
from block to block of time (Vuong 1989).
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
LIKELIER, STEADILY = 5.0, 3.0  # log-likelihood ("very strong", Kass and Raftery 1995), and times its scatter, to warn


@dataclass(frozen=True)
class Between:
    """How each input was taken, and the log-likelihood that the other way of all of them gains.

    steady: how many times its own scatter over blocks of time that is
    """

    taken: Mapping[str, Way]
    gain: float
    steady: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Where the other way is plainly likelier: what the study would say then."""
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
    """The model recalibrated, fitted again with every input taken the other way."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    # from unknown inputs that are plain enough to move: those that made up for the wrong way find back slowly
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
