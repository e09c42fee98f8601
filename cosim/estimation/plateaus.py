"""Parameters on which the likelihood does not depend near their estimates, such as a lag shorter than a row.

A step of a fit may end on such a plateau, where it has no slope. An estimate on a plateau has no information, and would
have an interval of width 0. Its region reaches as far as the likelihood is within its 95 % region (Venzon and
Moolgavkar 1988, Appl. Stat. 37:87), the other parameters fixed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from cosim.estimation.fit import CONVERGED, Fit
from cosim.estimation.problem import Problem
from cosim.estimation.subject.candidates import Free
from cosim.logs.channel_noise import NORMAL_95

DOUBLINGS_FROM, HALVINGS = 0.01, 5  # search for the end of a plateau: first distance in sizes, and bisections
FURTHEST = 1e4  # distance in sizes from which a plateau has no end


def with_flat_directions(problem: Problem, f: Fit) -> Fit:
    """Return the fit with a region for each parameter on a plateau, and a variance that reaches as far.

    The region is no scatter about the estimate: a lag shorter than a row has an upper limit only.
    """
    flat = [k for k, x in enumerate(f.free) if f.is_flat(x.name) and x.low < x.high]
    if not flat or f.scattered is None:
        return f
    scattered, regions = f.scattered.copy(), dict(f.regions)
    for k in flat:
        x = f.free[k]
        low, high = regions[x.name] = _walk(problem, f, x, x.low)[0], _walk(problem, f, x, x.high)[0]
        scattered[k, k] = (max(f.values[x.name] - low, high - f.values[x.name]) / NORMAL_95) ** 2
    return replace(f, scattered=scattered, regions=regions)


def values_beside_plateaus(problem: Problem, f: Fit, parameters: Sequence[Free]) -> dict[str, float]:
    """Return likelier values of those parameters that are on a plateau, and not without effect."""
    better = {}
    for x in parameters:
        if f.is_flat(x.name) and f.values[x.name] != x.neutral:
            ends = (_walk(problem, f, x, limit) for limit in (x.low, x.high))
            nll, value = min((nll, value) for _, nll, value in ends)
            if nll < f.nll - CONVERGED:
                better[x.name] = value
    return better


def _walk(problem: Problem, f: Fit, x: Free, limit: float) -> tuple[float, float, float]:
    """Walk from an estimate towards a limit while the NLL rises by less than ½·1.96².

    Returns:
        The last value, the least NLL on the way, and its value.
    """
    start = f.values[x.name]
    tried = [(f.nll, start)]

    def is_inside(distance: float) -> bool:
        value = start + math.copysign(distance, limit - start)
        nll = problem.score({**f.values, x.name: value}, f.noise).nll
        tried.append((nll if math.isfinite(nll) else math.inf, value))
        return nll - f.nll < 0.5 * NORMAL_95**2

    whole, inside, outside = min(abs(limit - start), FURTHEST * x.size), 0.0, DOUBLINGS_FROM * x.size
    while outside < whole and is_inside(outside):
        inside, outside = outside, 2.0 * outside
    outside = min(outside, whole)
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if is_inside(middle) else (inside, middle)
    return limit if outside == whole else start + math.copysign(outside, limit - start), *min(tried)
