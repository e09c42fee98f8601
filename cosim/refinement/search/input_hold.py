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
from cosim.refinement import messages
from cosim.refinement.decision.evidence import blocks_of, gain_per_scatter
from cosim.refinement.search.hypotheses import Hypothesis

Way = Literal["held", "interpolated"]
LIKELIER, STEADILY = 5.0, 3.0  # gain ("very strong", Kass and Raftery 1995) and gain per scatter to warn


@dataclass(frozen=True)
class Between:
    """Interpolation of each input, and the log-likelihood gain of the opposite choice for all inputs.

    Attributes:
        steady: Gain divided by its scatter over blocks of time.
    """

    ways: Mapping[str, Way]
    gain: float
    steady: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the opposite choice is clearly likelier."""
        if not (self.gain > LIKELIER and self.steady > STEADILY):
            return ()
        opposite = {name: "held" if way == "interpolated" else "interpolated" for name, way in self.ways.items()}
        setting = opposite[next(iter(opposite))]
        if len(set(opposite.values())) > 1:
            setting = f"{{{', '.join(f'{name}: {way}' for name, way in opposite.items())}}}"
        inputs = []
        for way in dict.fromkeys(self.ways.values()):
            names = [name for name in self.ways if self.ways[name] == way]
            inputs.append(f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} taken as {way}")
        texts = {"gain": plain(self.gain), "steadiness": plain(self.steady, 2), "line": f"`inputs: {setting}`"}
        return (messages.LIKELIER_INTERPOLATION(inputs=" and ".join(inputs), **texts),)


def between_rows(problem: Problem, base: Hypothesis) -> Between:
    """Refit the recalibrated model with every input held instead of interpolated between rows, or vice versa."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    # Unknown inputs start large enough to move, because inputs that compensated the wrong choice converge slowly.
    refit = fit(other, base.fit.free, base.fit.values, other.plain)
    ways: dict[str, Way] = {name: "interpolated" if name in ramped else "held" for name in names}
    scored, scored_refit = problem.score(base.fit.values, base.fit.noise), other.score(refit.values, refit.noise)
    block = blocks_of(problem, scored, math.exp(base.fit.noise.memory))
    steady = gain_per_scatter(block, scored, scored_refit, base.fit.penalty - refit.penalty)
    return Between(ways, base.fit.objective - refit.objective, steady)
