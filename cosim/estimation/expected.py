"""What is expected of a parameter per log where its group's value is not known: of a log kept apart, a sealed one."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from cosim.estimation.fit import Fit
from cosim.estimation.per_log import own, spread
from cosim.estimation.problem import Problem
from cosim.logs.channel_noise import NORMAL_95


def means(f: Fit) -> dict[str, float]:
    """Return each parameter per log as a mean over the groups."""
    return {name: expected(f, name)[0] for name in dict.fromkeys(x.parameter for x in f.free if x.group)}


def expected(f: Fit, name: str, besides: str = "") -> tuple[float, float]:
    """Return the mean over groups of a parameter per log, and the standard deviation expected of a further group.

    Of estimates θ̂ of n groups, that scatter by s about their mean, t·s·√(1 + 1/n), with Student's t for the few that
    they are (95 % of both distributions alike); s is no less than they are uncertain. Of a single one, the prior's.
    besides: a group that is not looked at
    """
    every = [x for x in f.free if x.parameter == name]
    seen = [x for x in every if x.group != besides]
    mean, prior = every[0].prior or (f.values[name], every[0].size)
    values = [f.values[x.name] for x in seen]
    if len(values) < 2:
        return (values[0] if values else mean), prior
    from scipy.special import stdtrit

    n = len(values)
    s = max(float(np.std(values, ddof=1)), float(np.sqrt(np.mean([f.sigma(x.name) ** 2 for x in seen]))))
    return float(np.mean(values)), float(stdtrit(n - 1, 0.975)) / NORMAL_95 * s * math.sqrt(1.0 + 1.0 / n)


def as_expected(f: Fit, group: str) -> dict[str, float]:
    """Return values of a group as they are expected of what the fit has of the others, with their spread."""
    values = {}
    for name in dict.fromkeys(x.parameter for x in f.free if x.group):
        values[own(name, group)], values[spread(name, group)] = expected(f, name, group)
    return values


def unseen(problem: Problem, f: Fit, left_out: int) -> Fit:
    """Return a fit of all logs but one; of that one's parameters nothing is known where no other is of its group."""
    if not problem.own:
        return f
    group = problem.origins[left_out].group
    if any(o.group == group for k, o in enumerate(problem.origins) if k != left_out):
        return f
    return replace(f, values={**f.values, **as_expected(f, group)})


def of_every_log(f: Fit, groups: Iterable[str]) -> dict[str, float]:
    """Return values of parameters per log, for each of the groups: as fitted, or as expected."""
    fitted = {x.name: f.values[x.name] for x in f.free if x.group}
    known = {x.group for x in f.free if x.group}
    return {**{k: v for g in dict.fromkeys(groups) if g not in known for k, v in as_expected(f, g).items()}, **fitted}
