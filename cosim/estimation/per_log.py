"""Parameters with a separate value for each group of logs: names, priors, filter starts, and values of other groups.

In the filter, such a parameter is a constant state θ. A known group value starts with variance 0, an unknown one at the
expected value with the expected spread.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cosim.core.arrays import NamedValues
from cosim.estimation.subject.candidates import Candidate, Free, spread_of_base, usual_size
from cosim.estimation.subject.interface import Subject
from cosim.logs.channel_noise import NORMAL_95

if TYPE_CHECKING:
    from cosim.estimation.fit import Fit
    from cosim.estimation.problem import Problem


@dataclass(frozen=True)
class Origin:
    """Group of a log, and its states with an initial reading: index of the state → index of the output."""

    group: str
    initial: Mapping[int, int]


def own(name: str, group: str) -> str:
    """Return the name of a parameter in a group."""
    return f"{name}@{group}"


def spread(name: str, group: str) -> str:
    """Return the name of the standard deviation of a group's value; a missing entry means a known value."""
    return f"spread of {name}@{group}"


def own_parameters(
    subject: Subject,
    names: Sequence[str],
    groups: Sequence[str],
    values: NamedValues,
    tolerance: NamedValues,
) -> Iterator[Free]:
    """Yield each parameter once per group of logs, with a prior around its value.

    Args:
        tolerance: Parameter → relative tolerance, by default that of the model.
    """
    for name in names:
        p, value = subject.declared[name], values[name]
        share = tolerance.get(name, p.tolerance)
        sigma = usual_size(p) if share is None or p.neutral is not None else spread_of_base(p, value, share)
        for group in dict.fromkeys(groups):
            prior = (value, sigma)
            yield Free(own(name, group), *p.bounds, min(usual_size(p), sigma), prior, parameter=name, group=group)


def drop_own_parameters(candidates: Sequence[Candidate], names: Sequence[str]) -> Iterator[Candidate]:
    """Yield the candidates with parameters per log removed, since these are free in every hypothesis."""
    for c in candidates:
        if free := tuple(f for f in c.free if f.name not in names):
            starts = tuple({n: v for n, v in s.items() if n not in names} for s in c.starts)
            yield replace(c, free=free, starts=starts)


# Expected values, for groups without an estimate, such as those of held-out and sealed logs


def expected_values(f: Fit, besides: str = "") -> dict[str, tuple[float, float]]:
    """Return parameter with a value per group → mean over groups, and spread for a new group.

    For estimates θ̂ of n groups with scatter s, the spread is t·s·√(1 + 1/n), with Student's t for few groups (95 % of
    both distributions agree); s is at least the uncertainty of the estimates. A single group has the spread of the
    prior.

    Args:
        besides: Group to ignore.
    """
    from scipy.special import ndtr, stdtrit

    found = {}
    for name in dict.fromkeys(x.parameter for x in f.free if x.group):
        every = [x for x in f.free if x.parameter == name]
        others = [x for x in every if x.group != besides]
        mean, width = every[0].prior or (f.values[name], every[0].size)
        values = [f.values[x.name] for x in others]
        n = len(values)
        if n > 1:
            s = max(float(np.std(values, ddof=1)), float(np.sqrt(np.mean([f.sigma(x.name) ** 2 for x in others]))))
            width = float(stdtrit(n - 1, ndtr(NORMAL_95))) / NORMAL_95 * s * math.sqrt(1.0 + 1.0 / n)
        found[name] = float(np.mean(values)) if values else mean, width
    return found


def _start_values(f: Fit, group: str) -> dict[str, float]:
    """Return the expected values of a group with their spread, from all further groups."""
    values = expected_values(f, group)
    return {key(n, group): v for n, pair in values.items() for key, v in zip((own, spread), pair, strict=True)}


def fit_for_held_out(problem: Problem, f: Fit, index: int) -> Fit:
    """Return a fit without a held-out log, completed by expected parameters if the log's group is unknown."""
    if not problem.own:
        return f
    groups = [origin.group for origin in problem.origins]
    if groups.count(groups[index]) > 1:
        return f
    return replace(f, values={**f.values, **_start_values(f, groups[index])})


def group_values(f: Fit, groups: Iterable[str]) -> dict[str, float]:
    """Return fitted or expected parameters of each group."""
    values: dict[str, float] = {}
    for group in dict.fromkeys(groups):
        if all(x.group != group for x in f.free):
            values |= _start_values(f, group)
    return values | {x.name: f.values[x.name] for x in f.free if x.group}
