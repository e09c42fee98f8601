"""Comparison of held and interpolated inputs between rows by their likelihood.

Only the recalibrated base model is compared. The two alternatives are not nested, so their difference is compared with
its scatter over blocks of time (Vuong 1989).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from cosim.core.text import counted, plain
from cosim.estimation.fit import fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.scatter import blocks_of, gain_per_scatter
from cosim.refinement.search.hypotheses import Hypothesis

Way = Literal["held", "interpolated"]
EARLIER = (1, 2, 4, 8)  # rows by which an input is taken earlier than recorded
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
    def is_otherwise(self) -> bool:
        """Return whether the opposite choice is clearly likelier."""
        return self.gain > LIKELIER and self.steady > STEADILY

    @property
    def other_line(self) -> str:
        """Return the line of a study with the opposite choice."""
        opposite = {name: "held" if way == "interpolated" else "interpolated" for name, way in self.ways.items()}
        setting = opposite[next(iter(opposite))]
        if len(set(opposite.values())) > 1:
            setting = f"{{{', '.join(f'{name}: {way}' for name, way in opposite.items())}}}"
        return f"`inputs: {setting}`"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the opposite choice is clearly likelier."""
        if not self.is_otherwise:
            return ()
        inputs = []
        for way in dict.fromkeys(self.ways.values()):
            names = [name for name in self.ways if self.ways[name] == way]
            inputs.append(f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} taken as {way}")
        texts = {"gain": plain(self.gain), "steadiness": plain(self.steady, 2), "line": self.other_line}
        return (
            (
                "between rows {inputs}; the other way raises the log-likelihood of the logs by {gain}, {steadiness} "
                "times its scatter: if the rig commands its inputs that way, write {line} in the study"
            ).format(inputs=" and ".join(inputs), **texts),
        )


def between_rows(problem: Problem, base: Hypothesis) -> Between:
    """Refit the recalibrated model with every input held instead of interpolated between rows, or vice versa."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    ways: dict[str, Way] = {name: "interpolated" if name in ramped else "held" for name in names}
    return Between(ways, *_gain_of(problem, base, other))


def _gain_of(problem: Problem, h: Hypothesis, other: Problem) -> tuple[float, float]:
    """Return the gain of a hypothesis by a refit to other inputs, and the gain divided by its scatter."""
    # Unknown inputs start large enough to move, because inputs that compensated the wrong choice converge slowly.
    refit = fit(other, h.fit.free, h.fit.values, other.plain)
    scored, scored_refit = problem.score(h.fit.values, h.fit.noise), other.score(refit.values, refit.noise)
    block = blocks_of(problem, scored, math.exp(h.fit.noise.memory))
    steady = gain_per_scatter(block, scored, scored_refit, h.fit.penalty - refit.penalty)
    return h.fit.objective - refit.objective, steady


@dataclass(frozen=True)
class Late:
    """An input that explains the logs better if it is taken some rows earlier than recorded."""

    name: str
    rows: int
    gain: float
    steady: float

    def warning(self, step: float) -> str:
        """Return a warning for logs with this time between rows [s]."""
        numbers = {"gain": plain(self.gain), "steadiness": plain(self.steady, 2), "time": plain(self.rows * step)}
        return (
            "{name} taken {rows} earlier than recorded raises the log-likelihood of the logs by {gain}, "
            "{steadiness} times its scatter: its column may lag, as behind a filter or a sensor of its own, "
            "which no candidate describes; log the input before the filter, or move its column {time} s earlier "
            "and refine again"
        ).format(name=self.name, rows=counted(self.rows, "row"), **numbers)


def late_input(problem: Problem, best: Hypothesis) -> Late | None:
    """Return the input that is recorded late, as behind a filter of its own; None without one.

    No candidate takes an input earlier than recorded. The best hypothesis is refitted with each input earlier, by one
    row and by twice as many as long as that is likelier.
    """
    late: Late | None = None
    for column, name in enumerate(problem.layout.inputs):
        if not any(np.ptp(data.u[:, column]) for data in problem.logs):
            continue
        for rows in EARLIER:
            logs = []
            for data in problem.logs:
                u = data.u.copy()
                u[:-rows, column], u[-rows:, column] = u[rows:, column].copy(), u[-1, column]
                logs.append(replace(data, u=u))
            moved = Late(name, rows, *_gain_of(problem, best, replace(problem, logs=logs)))
            if not (moved.gain > max(LIKELIER, late.gain if late else 0.0) and moved.steady > STEADILY):
                break
            late = moved
    return late
