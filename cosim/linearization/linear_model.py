"""Linear models at a point, and their reduction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.linearization.kinks import Kink

HELD = 1e-9  # share of a matrix's largest entry below which an entry couples nothing

STILL = 1e-6  # [state unit/s] rates below count as zero


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
        kinks: States and inputs without a derivative at the point, with one-sided slopes.
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
    kinks: tuple[Kink, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Return True at an equilibrium, whose stability follows from the poles."""
        return not self.rates.size or float(np.abs(self.rates).max()) < STILL

    def ss(self) -> Any:
        """Return the model as a named `control.StateSpace`."""
        import control

        names = {name: list(getattr(self, name)) for name in ("states", "inputs", "outputs")}
        return control.ss(self.A, self.B, self.C, self.D, **names, remove_useless_states=False)

    def unit(self, name: str) -> str:
        """Return the unit of a state, input or output."""
        return self.units.get(name, "")


def residualised(linear: Linear, fast: Sequence[str]) -> Linear:
    """Return the model with fast states eliminated at their steady state.

    0 = A₂₁·x + A₂₂·x₂ + B₂·u is solved for x₂.

    Raises:
        ValueError: The states do not settle by themselves (A₂₂ singular).
    """
    if not fast:
        return linear
    gone = [linear.states.index(n) for n in fast]
    kept = [k for k in range(len(linear.states)) if k not in gone]
    own = linear.A[np.ix_(gone, gone)]
    if np.linalg.matrix_rank(own) < len(gone):
        raise ValueError(f"{', '.join(fast)} do not settle by themselves: their own part of A is singular")
    by_states = -np.linalg.solve(own, linear.A[np.ix_(gone, kept)])
    by_inputs = -np.linalg.solve(own, linear.B[gone])
    into, out = linear.A[np.ix_(kept, gone)], linear.C[:, gone]
    return replace(
        linear,
        A=linear.A[np.ix_(kept, kept)] + into @ by_states,
        B=linear.B[kept] + into @ by_inputs,
        C=linear.C[:, kept] + out @ by_states,
        D=linear.D + out @ by_inputs,
        states=tuple(linear.states[k] for k in kept),
        point=replace(linear.point, states=linear.point.states[kept]),
        rates=linear.rates[kept] - into @ np.linalg.solve(own, linear.rates[gone]),
    )


def missing_states(linear: Linear, states: Sequence[str]) -> list[str]:
    """Return states outside a selection with influence on selected states."""
    kept = [linear.states.index(n) for n in states]
    others = [k for k in range(len(linear.states)) if k not in kept]
    if not others or not kept:
        return []
    reach = np.abs(linear.A[np.ix_(kept, others)]).max(axis=0)
    return [linear.states[k] for k, size in zip(others, reach, strict=True) if size > HELD * np.abs(linear.A).max()]


def chosen(linear: Linear, states: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]) -> Linear:
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
