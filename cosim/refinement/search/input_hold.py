"""Comparison of held and interpolated inputs between rows, and of inputs taken earlier, by their likelihood.

With even prior odds, another way is told if its probability is that of a claimed part, and its gain is no chance over
blocks of time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import logit
from scipy.stats import norm

from cosim.core.text import counted, join_names, plain
from cosim.estimation.fit import fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.posterior import CERTAIN, MISFIT
from cosim.refinement.decision.scatter import steadiness
from cosim.refinement.search.fits import Hypothesis

Way = Literal["held", "interpolated"]


def _is_likelier(gain: float, steady: float) -> bool:
    return gain > float(logit(CERTAIN)) and float(norm.sf(steady)) < MISFIT


@dataclass(frozen=True)
class Between:
    """Interpolation of each input, and the log-likelihood gain of the opposite choice for all inputs.

    Attributes:
        steady: Gain divided by its scatter over blocks of time.
        line: Line of a study with the opposite choice, if that is clearly likelier; else "".
    """

    ways: Mapping[str, Way]
    gain: float
    steady: float
    line: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a warning if the opposite choice is clearly likelier."""
        if not self.line:
            return ()
        inputs = join_names([f"{name} is taken as {way}" for name, way in self.ways.items()])
        return (
            f"between rows {inputs}; the other way raises the log-likelihood of the logs by "
            f"{plain(self.gain)}, {plain(self.steady, 2)} times its scatter: if the rig commands its inputs that way, "
            f"write {self.line} in the study",
        )


def between_rows(problem: Problem, base: Hypothesis) -> Between:
    """Refit the recalibrated model with every input held instead of interpolated between rows, or vice versa."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    gain, steady = _gain_of(problem, base, other)
    ways: dict[str, Way] = {name: "interpolated" if name in ramped else "held" for name in names}
    opposite = {name: "interpolated" if name in flipped else "held" for name in names}
    setting = ", ".join(f"{name}: {way}" for name, way in opposite.items())
    setting = opposite[names[0]] if len(set(opposite.values())) == 1 else f"{{{setting}}}"
    return Between(ways, gain, steady, f"`inputs: {setting}`" if _is_likelier(gain, steady) else "")


def _gain_of(problem: Problem, h: Hypothesis, other: Problem) -> tuple[float, float]:
    """Return the gain of a hypothesis by a refit to other inputs, and the gain divided by its scatter."""
    # Unknown inputs start large enough to move, because inputs that compensated the wrong choice converge slowly.
    refit = fit(other, h.fit.free, h.fit.values, other.plain)
    return h.fit.objective - refit.objective, steadiness(problem, refit, h.fit, other)


@dataclass(frozen=True)
class Late:
    """An input that explains the logs better if it is taken some rows earlier than recorded."""

    name: str
    rows: int
    gain: float
    steady: float

    def warning(self, step: float) -> str:
        """Return a warning for logs with this time between rows [s]."""
        return (
            f"{self.name} taken {counted(self.rows, 'row')} earlier than recorded raises the log-likelihood of the "
            f"logs by {plain(self.gain)}, {plain(self.steady, 2)} times its scatter: its column may lag, as behind a "
            "filter or a sensor of its own, which no candidate describes; log the input before the filter, or move "
            f"its column {plain(self.rows * step)} s earlier and refine again"
        )


def late_input(problem: Problem, best: Hypothesis) -> Late | None:
    """Return the input that is recorded late, as behind a filter of its own; None without one.

    No candidate takes an input earlier than recorded. The best hypothesis is refitted with each input earlier, by one
    row and by twice as many as long as that is likelier.
    """
    late: Late | None = None
    shortest = min(len(data.u) for data in problem.logs)
    for column, name in enumerate(problem.layout.inputs):
        rows = 1
        while rows < shortest and any(np.ptp(data.u[:, column]) for data in problem.logs):
            logs = []
            for data in problem.logs:
                u = data.u.copy()
                u[:-rows, column], u[-rows:, column] = u[rows:, column].copy(), u[-1, column]
                logs.append(replace(data, u=u))
            moved = Late(name, rows, *_gain_of(problem, best, replace(problem, logs=logs)))
            if not _is_likelier(moved.gain, moved.steady) or (late is not None and moved.gain <= late.gain):
                break
            late, rows = moved, 2 * rows
    return late
