"""Linear models at a point, their reduction, and their structure: poles, controllability and observability."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.arrays import Array

MIN_COUPLING = 1e-9  # smallest nonzero entry of a matrix, relative to its largest entry
MAX_RATE_AT_REST = 1e-6  # largest derivative at an equilibrium [state unit/s]
POLE_TOLERANCE = 1e-6  # largest distance of equal poles, relative to the fastest pole
AXIS_TOLERANCE = 1e-9  # real part relative to the largest pole (at least 1 rad/s) below which a pole is on the axis
RANK_TOLERANCE = 1e-6  # smallest singular value of independent directions, which have size 1; not below POLE_TOLERANCE


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
        rates: Derivatives f₀ at the point; zero at an equilibrium.
        values: Outputs y₀ at the point.
        units: Units of states, inputs and outputs by name; "" if unknown.
        method: How the derivatives were computed.
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
        """Return True if the point is an equilibrium; only then do the poles determine stability."""
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
    """Return the model with fast states replaced by their steady state.

    0 = A₂₁·x + A₂₂·x₂ + B₂·u is solved for x₂.

    Raises:
        ValueError: The fast states have no steady state (A₂₂ is singular).
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
        text = "with the other states constant, they have no steady state (their block of A is singular)"
        cure = "omit pure integrators"
        raise ValueError(f"{', '.join(fast)} cannot be residualized: {text}; {cure}") from None
    kept = select(linear, [n for n in linear.states if n not in fast], linear.inputs, linear.outputs)
    return replace(kept, A=slow.A, B=slow.B[:, :-1], C=slow.C, D=slow.D[:, :-1], rates=slow.B[:, -1])


def missing_states(linear: Linear, states: Sequence[str]) -> list[str]:
    """Return the states outside a selection that influence the selected states."""
    rows = [linear.states.index(n) for n in states]
    influence = np.abs(linear.A[rows]).max(axis=0, initial=0.0)
    least = MIN_COUPLING * np.abs(linear.A).max(initial=0.0)
    return [n for n, size in zip(linear.states, influence, strict=True) if n not in states and size > least]


def select(linear: Linear, states: Sequence[str], inputs: Sequence[str], outputs: Sequence[str]) -> Linear:
    """Return a model with selected states, inputs and outputs; contributions of other states are neglected."""
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


Poles = NDArray[np.complex128]


@dataclass(frozen=True)
class Pole:
    """A pole with multiplicity, controllability and observability.

    Attributes:
        natural_frequency: |λ| [rad/s].
        damping_ratio: −Re λ/|λ|, NaN at 0.
        time_constant: −1/Re λ [s], infinite on the imaginary axis.
    """

    value: complex
    count: int
    natural_frequency: float
    damping_ratio: float
    time_constant: float
    controllable: bool
    observable: bool


@dataclass(frozen=True)
class Structure:
    """Poles, slowest first, and ranks of controllability and observability.

    Attributes:
        condition: Condition number of (B, AB, … Aⁿ⁻¹B); infinite without full rank.
    """

    poles: tuple[Pole, ...]
    controllable: int
    observable: int
    condition: float
    stable: bool


def structure(linear: Linear) -> Structure:
    """Return the poles of a linear model, and its ranks of controllability and observability."""
    import control

    A, B, C = linear.A, linear.B, linear.C
    values = poles(A)
    largest = float(np.abs(values).max(initial=0.0))
    distance, axis = POLE_TOLERANCE * largest, AXIS_TOLERANCE * max(1.0, largest)
    groups: list[list[complex]] = []
    for value in values.tolist():
        near = next((g for g in groups if abs(np.mean(g) - value) <= max(distance, 1e-12)), None)
        if near is None:
            groups.append([value])
        else:
            near.append(value)
    every = []
    for group in groups:
        value = complex(np.mean(group))
        value = complex(
            value.real if abs(value.real) > axis else 0.0, value.imag if abs(value.imag) >= distance else 0.0
        )
        size, real = abs(value), value.real
        ratio, time = -real / size if size else math.nan, -1.0 / real if real else math.inf
        reached, shown = _is_controllable(A, B, value), _is_controllable(A.T, C.T, value)
        every.append(Pole(value, len(group), size, ratio, time, reached, shown))
    rank = controllable_rank(A, B)
    condition = float(np.linalg.cond(control.ctrb(A, B))) if rank == len(A) > 0 else float("inf")
    stable = all(p.value.real < 0.0 for p in every)
    return Structure(tuple(every), rank, controllable_rank(A.T, C.T), condition, stable)


def poles(A: Array) -> Poles:
    """Return the eigenvalues of A, slowest first."""
    values = np.linalg.eigvals(A).astype(complex)
    return np.array(sorted(values.tolist(), key=lambda v: (round(abs(v), 12), v.real, -v.imag)), dtype=complex)


def controllable_rank(A: Array, B: Array) -> int:
    """Return the rank of (B, AB, …, Aⁿ⁻¹B), from an orthonormal basis (block Arnoldi).

    A is balanced and scaled to size 1.
    """
    from scipy.linalg import matrix_balance

    if not len(A) or not B.size:
        return 0
    balanced, (scaling, _) = matrix_balance(A, permute=False, separate=True)
    base, fresh = np.zeros((len(A), 0)), B / scaling[:, None]
    fresh = fresh / np.maximum(np.abs(fresh).max(axis=0), 1e-300)
    most = max(float(np.abs(balanced).max()), 1e-300)
    while fresh.size and base.shape[1] < len(A):
        for _ in range(2):  # the second pass removes the rounding of the first
            fresh = fresh - base @ (base.T @ fresh)
        u, s, _ = np.linalg.svd(fresh, full_matrices=False)
        new = u[:, s > RANK_TOLERANCE]
        base = np.hstack([base, new])
        fresh = balanced @ new / most
    return int(base.shape[1])


def _is_controllable(A: Array, B: Array, value: complex) -> bool:
    """Return True if the eigenvalue λ is controllable: (A − λI, B) has rank n (Popov, Belevitch, Hautus).

    The columns of B are normalised.
    """
    shifted = A - value * np.eye(len(A))
    size = max(float(np.linalg.norm(shifted, 2)), 1e-300)
    columns = B / np.maximum(np.abs(B).max(axis=0), 1e-300) if B.size else B
    return bool(np.linalg.matrix_rank(np.hstack([shifted / size, columns]), rtol=RANK_TOLERANCE) == len(A))
