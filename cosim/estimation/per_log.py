"""Parameters of which each group of logs has its own value: names, priors, and where the filter of a log starts.

In the filter such a parameter is a constant state θ. Where its group's value is known it starts there with variance 0,
else at what is expected of a further group, with the spread that is expected. A state that starts at its first reading
starts there as the sensor would have it: y = g(x, θ) holds at the start, so that x and θ are correlated from there,
    x₀ ← x₀ + G⁻¹(y − g(x₀, θ))      δx = −G⁻¹ ∂g/∂θ · δθ      G = ∂g/∂x
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import pseudo_inverse
from cosim.kernel.kernel import Data, Kernel
from cosim.subject.base_parameters import spread_of_base
from cosim.subject.candidates import Candidate, Free, usual_size
from cosim.subject.interface import Subject

STEP = 1e-4  # of a value, or of 1 where it is less, for differences; readings are nearly straight lines


@dataclass(frozen=True)
class Origin:
    """Of a log: its group, and states that start at a reading → the outputs that show them, by their places."""

    group: str
    shown: Mapping[int, int]


def own(name: str, group: str) -> str:
    """Return the name of the value of a parameter for a group."""
    return f"{name}@{group}"


def spread(name: str, group: str) -> str:
    """Return the name of the standard deviation of that value; without it, the value is known."""
    return f"spread of {name}@{group}"


def own_parameters(
    subject: Subject,
    names: Sequence[str],
    groups: Sequence[str],
    values: Mapping[str, float],
    tolerance: Mapping[str, float],
) -> Iterator[Free]:
    """Yield each parameter once for each group, held near the subject's value: by its tolerance or its usual size."""
    for name in names:
        p, value = subject.declared[name], values[name]
        share = tolerance.get(name, p.tolerance)
        sigma = usual_size(p) if share is None or p.neutral is not None else spread_of_base(p, value, share)
        for group in dict.fromkeys(groups):
            prior = (value, sigma)
            yield Free(own(name, group), *p.bounds, min(usual_size(p), sigma), prior, parameter=name, group=group)


def not_per_log(candidates: Sequence[Candidate], names: Sequence[str]) -> Iterator[Candidate]:
    """Yield candidates without parameters that are per log: those are free in every hypothesis."""
    for c in candidates:
        if free := tuple(f for f in c.free if f.name not in names):
            starts = tuple({n: v for n, v in s.items() if n not in names} for s in c.starts)
            yield replace(c, free=free, starts=starts)


def started(
    kernel: Kernel, data: Data, p: Array, x0: Array, known: Mapping[str, tuple[float, float]], shown: Mapping[int, int]
) -> tuple[Array, Array]:
    """Start state of a log, and L, stochastic states × constants, with which L·L' is its covariance beside P0.

    known: parameter → value and standard deviation; shown: as of an `Origin`
    """
    layout = kernel.layout
    places = [layout.constants[name] for name in known]
    x, spreads = x0.copy(), np.array([s for _, s in known.values()])
    x[places] = [value for value, _ in known.values()]
    moved = np.zeros((len(x), len(places)))
    moved[places, range(len(places))] = spreads
    if shown:
        first, memory, outputs = data.rows(0, 1), np.zeros(layout.memory), list(shown.values())

        def read(state: Array) -> Array:
            return np.asarray(kernel.simulate(first, p, state, memory).outputs[0, outputs])

        here, states = read(x), list(shown)
        inside = pseudo_inverse(_slopes(read, x, states, here))
        moved[states] = -inside @ _slopes(read, x, places, here) * spreads
        x[states] += inside @ (x0[states] - here)
    return x, moved[list(layout.stochastic)]


def _slopes(read: Callable[[Array], Array], x: Array, places: Sequence[int], here: Array) -> Array:
    """Return derivatives of readings by some states, shape (readings, states)."""
    columns = []
    for place in places:
        step = STEP * max(1.0, abs(float(x[place])))
        there = x.copy()
        there[place] += step
        columns.append((read(there) - here) / step)
    return np.column_stack(columns)
