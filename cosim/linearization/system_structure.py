"""Structure of a linear model: poles, controllability and observability."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.core.arrays import Array
from cosim.linearization.linear_model import Linear

POLE_TOLERANCE = 1e-6  # distance of equal poles, relative to the fastest pole
RANK_TOLERANCE = 1e-9  # largest zero singular value, relative to the largest singular value
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
        condition: Condition of (B, AB, … Aⁿ⁻¹B); infinite without full rank.
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
    distance = POLE_TOLERANCE * float(np.abs(values).max(initial=0.0))
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
        value = complex(value.real, value.imag if abs(value.imag) >= distance else 0.0)
        size, real = abs(value), value.real
        ratio, time = -real / size if size else math.nan, -1.0 / real if real else math.inf
        reached, shown = _is_controllable(A, B, value), _is_controllable(A.T, C.T, value)
        every.append(Pole(value, len(group), size, ratio, time, reached, shown))
    rank = controllable_rank(A, B)
    condition = float(np.linalg.cond(control.ctrb(A, B))) if rank == len(A) > 0 else float("inf")
    stable = all(p.value.real < -distance for p in every)
    return Structure(tuple(every), rank, controllable_rank(A.T, C.T), condition, stable)


def poles(A: Array) -> Poles:
    """Return the eigenvalues of A, slowest first."""
    values = np.linalg.eigvals(A).astype(complex)
    return np.array(sorted(values.tolist(), key=lambda v: (round(abs(v), 12), v.real, -v.imag)), dtype=complex)


def controllable_rank(A: Array, B: Array) -> int:
    """Return the dimension of the controllable subspace of the balanced model."""
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
        new = u[:, s > RANK_TOLERANCE * 1e3]
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
    return bool(np.linalg.matrix_rank(np.hstack([shifted / size, columns]), rtol=RANK_TOLERANCE * 1e3) == len(A))
