"""Expected values of parameters per log for groups without an estimate, such as held-out and sealed logs."""

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
    """Return parameter → mean over the groups, for the parameters with a value per group."""
    return {name: expected_value(f, name)[0] for name in dict.fromkeys(x.parameter for x in f.free if x.group)}


def expected_value(f: Fit, name: str, besides: str = "") -> tuple[float, float]:
    """Return a parameter's mean over groups and its spread for a new group.

    For estimates θ̂ of n groups with scatter s, the spread is t·s·√(1 + 1/n), with Student's t for few groups (95 % of
    both distributions agree); s is at least the uncertainty of the estimates. A single group has the spread of the
    prior.

    Args:
        besides: Group to ignore.
    """
    every = [x for x in f.free if x.parameter == name]
    others = [x for x in every if x.group != besides]
    mean, prior = every[0].prior or (f.values[name], every[0].size)
    values = [f.values[x.name] for x in others]
    if len(values) < 2:
        return (values[0] if values else mean), prior
    from scipy.special import stdtrit

    n = len(values)
    s = max(float(np.std(values, ddof=1)), float(np.sqrt(np.mean([f.sigma(x.name) ** 2 for x in others]))))
    return float(np.mean(values)), float(stdtrit(n - 1, 0.975)) / NORMAL_95 * s * math.sqrt(1.0 + 1.0 / n)


def expected_values(f: Fit, group: str) -> dict[str, float]:
    """Return the expected values of a group with their spread, from all further groups."""
    values = {}
    for name in dict.fromkeys(x.parameter for x in f.free if x.group):
        values[own(name, group)], values[spread(name, group)] = expected_value(f, name, group)
    return values


def fit_for_held_out(problem: Problem, f: Fit, index: int) -> Fit:
    """Return a fit without a held-out log, completed by expected parameters if the log's group is unknown."""
    if not problem.own:
        return f
    groups = [origin.group for origin in problem.origins]
    if groups.count(groups[index]) > 1:
        return f
    return replace(f, values={**f.values, **expected_values(f, groups[index])})


def group_values(f: Fit, groups: Iterable[str]) -> dict[str, float]:
    """Return fitted or expected parameters of each group."""
    values: dict[str, float] = {}
    for group in dict.fromkeys(groups):
        if all(x.group != group for x in f.free):
            values |= expected_values(f, group)
    return values | {x.name: f.values[x.name] for x in f.free if x.group}
