"""Comparison of held and interpolated inputs between rows, and of inputs taken earlier, by their likelihood.

With even prior odds, another way is told if its probability is that of a claimed part, and its gain is no chance over
blocks of time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import logit, ndtr

from cosim.core.text import counted, join_names, plain
from cosim.estimation.fit import fit
from cosim.estimation.problem import Problem
from cosim.refinement.decision.bundle import steadiness
from cosim.refinement.decision.posterior import CERTAIN, MISFIT
from cosim.refinement.search.fits import Hypothesis

Way = Literal["held", "interpolated"]


@dataclass(frozen=True)
class Between:
    """Interpolation of each input, and the log-likelihood gain of the opposite choice for all inputs.

    Attributes:
        line: Line of a study with the opposite choice, if that is clearly likelier; else "".
        warning: Warning of it, or "".
    """

    ways: Mapping[str, Way]
    gain: float
    line: str = ""
    warning: str = ""


@dataclass(frozen=True)
class Late:
    """An input that explains the logs better if it is taken some rows earlier than recorded."""

    name: str
    rows: int
    gain: float
    warning: str


def between_rows(problem: Problem, base: Hypothesis) -> Between:
    """Refit the recalibrated model with every input held instead of interpolated between rows, or vice versa."""
    ramped, names = problem.settings.interpolated, problem.layout.inputs
    flipped = frozenset(names) - ramped
    logs = [replace(data, interpolated=flipped) for data in problem.logs]
    other = replace(problem, logs=logs, settings=replace(problem.settings, interpolated=flipped))
    gain, told = _gain_of(problem, base, other)
    ways: dict[str, Way] = {name: "interpolated" if name in ramped else "held" for name in names}
    if not told:
        return Between(ways, gain)
    opposite = {name: "interpolated" if name in flipped else "held" for name in names}
    setting = f"{{{', '.join(f'{name}: {way}' for name, way in opposite.items())}}}"
    setting = opposite[names[0]] if len(set(opposite.values())) == 1 else setting
    inputs, line = join_names([f"{name} is taken as {way}" for name, way in ways.items()]), f"`inputs: {setting}`"
    warning = f"between rows {inputs}; the other way {told}: if the rig commands its inputs that way, "
    return Between(ways, gain, line, f"{warning}write {line} in the study")


def late_input(problem: Problem, best: Hypothesis) -> Late | None:
    """Return the input that is recorded late, as behind a filter of its own; None without one.

    No candidate takes an input earlier than recorded. The best hypothesis is refitted with each input earlier, by one
    row and by twice as many as long as that is likelier.
    """
    late: Late | None = None
    shortest, step = min(len(data.u) for data in problem.logs), problem.logs[0].step
    for column, name in enumerate(problem.layout.inputs):
        rows = 1
        while rows < shortest and any(np.ptp(data.u[:, column]) for data in problem.logs):
            logs = []
            for data in problem.logs:
                u = data.u.copy()
                u[:-rows, column], u[-rows:, column] = u[rows:, column].copy(), u[-1, column]
                logs.append(replace(data, u=u))
            gain, told = _gain_of(problem, best, replace(problem, logs=logs))
            if not told or (late is not None and gain <= late.gain):
                break
            warning = (
                f"{name} taken {counted(rows, 'row')} earlier than recorded {told}: its column may lag, as behind a "
                "filter or a sensor of its own, which no candidate describes; log the input before the filter, or "
                f"move its column {plain(rows * step)} s earlier and refine again"
            )
            late, rows = Late(name, rows, gain, warning), 2 * rows
    return late


def _gain_of(problem: Problem, h: Hypothesis, other: Problem) -> tuple[float, str]:
    """Return the gain of a hypothesis by a refit to other inputs, and the gain in words if it is no chance, else ""."""
    # Unknown inputs start large enough to move, because inputs that compensated the wrong choice converge slowly.
    refit = fit(other, h.fit.free, h.fit.values, other.plain)
    gain, steady = h.fit.objective - refit.objective, steadiness(problem, refit, h.fit, other)
    if gain <= float(logit(CERTAIN)) or float(ndtr(-steady)) >= MISFIT:
        return gain, ""
    return gain, f"raises the log-likelihood of the logs by {plain(gain)}, {plain(steady, 2)} times its scatter"
