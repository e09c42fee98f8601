"""Parameters with a separate value for each group of logs: names, priors, and filter starts.

In the filter, such a parameter is a constant state θ. A known group value starts with variance 0, an unknown one at the
expected value with the expected spread. A state initialized from its first reading satisfies the sensor equation
y = g(x, θ) at the start, so that x and θ are correlated,

    x₀ ← x₀ + G⁻¹(y − g(x₀, θ))      δx = −G⁻¹ ∂g/∂θ · δθ      G = ∂g/∂x
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import pseudo_inverse
from cosim.estimation.kernel.kernel import Data, Kernel
from cosim.estimation.subject.candidates import Candidate, Free, spread_of_base, usual_size
from cosim.estimation.subject.interface import Subject

STEP = 1e-4  # step of differences relative to max(1, value); readings are nearly linear


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
    values: Mapping[str, float],
    tolerance: Mapping[str, float],
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


def start_of_log(
    kernel: Kernel, data: Data, p: Array, x0: Array, own: Mapping[str, tuple[float, float]], initial: Mapping[int, int]
) -> tuple[Array, Array]:
    """Return the start state of a log, and the factor L of the covariance L·L' that is added to P0.

    L has shape (stochastic states, parameters per log).

    Args:
        own: Parameter → value and standard deviation.
        initial: Index of a state with an initial reading → index of the output.
    """
    layout = kernel.layout
    places = [layout.constants[name] for name in own]
    x, spreads = x0.copy(), np.array([s for _, s in own.values()])
    x[places] = [value for value, _ in own.values()]
    factor = np.zeros((len(x), len(places)))
    factor[places, range(len(places))] = spreads
    if initial:
        first, memory, outputs = data.rows(0, 1), np.zeros(layout.memory), list(initial.values())

        def read(state: Array) -> Array:
            return np.asarray(kernel.simulate(first, p, state, memory).outputs[0, outputs])

        y, states = read(x), list(initial)
        gain = pseudo_inverse(_slopes(read, x, states, y))
        factor[states] = -gain @ _slopes(read, x, places, y) * spreads
        x[states] += gain @ (x0[states] - y)
    return x, factor[list(layout.stochastic)]


def _slopes(read: Callable[[Array], Array], x: Array, places: Sequence[int], y: Array) -> Array:
    """Return the derivatives of readings by some states, shape (readings, states)."""
    columns = []
    for place in places:
        step = STEP * max(1.0, abs(float(x[place])))
        moved = x.copy()
        moved[place] += step
        columns.append((read(moved) - y) / step)
    return np.column_stack(columns)
