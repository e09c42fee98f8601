"""Linear models at a point, and their reduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.core.arrays import Array

MIN_COUPLING = 1e-9  # smallest entry of a matrix that couples, relative to its largest entry
MAX_RATE_AT_REST = 1e-6  # [state unit/s]


@dataclass(frozen=True)
class Point:
    """A linearization point: time [s], states and inputs in the order of the model."""

    time: float
    states: Array
    inputs: Array


@dataclass(frozen=True)
class Linear:
    """Linear model d(x − x₀)/dt = A·(x − x₀) + B·(u − u₀) + f₀, y − y₀ = C·(x − x₀) + D·(u − u₀).

    Attributes:
        rates: f₀, zero at an equilibrium.
        values: y₀.
        units: Units of states, inputs and outputs by name; "" if unknown.
        method: Origin of the derivatives.
        notes: Remarks on the derivatives.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    point: Point
    rates: Array
    values: Array
    units: Mapping[str, str]
    method: str
    notes: tuple[str, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Return True at an equilibrium. Only there the poles determine stability."""
        return float(np.abs(self.rates).max(initial=0.0)) < MAX_RATE_AT_REST

    def ss(self) -> Any:
        """Return the linear model as a `control.StateSpace` with signal names."""
        import control

        names = {group: list(getattr(self, group)) for group in ("states", "inputs", "outputs")}
        return control.ss(self.A, self.B, self.C, self.D, **names, remove_useless_states=False)

    def matrix(self, name: str) -> tuple[Array, tuple[str, ...], tuple[str, ...]]:
        """Return A, B, C or D with the names of its rows and columns."""
        rows = self.states if name in "AB" else self.outputs
        return getattr(self, name), rows, self.states if name in "AC" else self.inputs


def residualize(linear: Linear, fast: Sequence[str]) -> Linear:
    """Return the model with fast states eliminated at their steady state.

    0 = A₂₁·x + A₂₂·x₂ + B₂·u is solved for x₂.

    Raises:
        ValueError: The states do not settle by themselves (A₂₂ singular).
    """
    if not fast:
        return linear
    import control

    inputs, feedthrough = np.column_stack([linear.B, linear.rates]), np.pad(linear.D, ((0, 0), (0, 1)))
    system = control.ss(linear.A, inputs, linear.C, feedthrough, remove_useless_states=False)
    places = [linear.states.index(n) for n in fast]
    try:
        slow = control.model_reduction(system, places, "matchdc", warn_unstable=False)
    except ValueError:
        text = "they do not settle while the other states are constant (their block of A is singular)"
        cure = "leave out states that only integrate"
        raise ValueError(f"{', '.join(fast)} cannot be residualized: {text}; {cure}") from None
    kept = select(linear, [n for n in linear.states if n not in fast], linear.inputs, linear.outputs)
    return replace(kept, A=slow.A, B=slow.B[:, :-1], C=slow.C, D=slow.D[:, :-1], rates=slow.B[:, -1])


def missing_states(linear: Linear, states: Sequence[str]) -> list[str]:
    """Return the states outside a selection that influence selected states."""
    rows = [linear.states.index(n) for n in states]
    influence = np.abs(linear.A[rows]).max(axis=0, initial=0.0)
    least = MIN_COUPLING * np.abs(linear.A).max(initial=0.0)
    return [n for n, size in zip(linear.states, influence, strict=True) if n not in states and size > least]


def select(linear: Linear, states: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]) -> Linear:
    """Return a selection of states, inputs and outputs; contributions of other states are lost."""
    x = [linear.states.index(n) for n in states]
    u = [linear.inputs.index(n) for n in inputs]
    y = [linear.outputs.index(n) for n in outputs]
    return replace(
        linear,
        A=linear.A[np.ix_(x, x)],
        B=linear.B[np.ix_(x, u)],
        C=linear.C[np.ix_(y, x)],
        D=linear.D[np.ix_(y, u)],
        states=tuple(states),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        point=Point(linear.point.time, linear.point.states[x], linear.point.inputs[u]),
        rates=linear.rates[x],
        values=linear.values[y],
    )
