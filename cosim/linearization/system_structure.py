"""Structure of a linear model: poles, Jordan blocks, controllability and observability.

States with mutual feedback form a block, and A is block triangular, so that its poles are those of the blocks. A pole
of several blocks is then equal to rounding in each, without the spread ε^(1/k) of a defective eigenvalue.
"""

from __future__ import annotations

from dataclasses import dataclass
from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array
from cosim.linearization.linear_model import Linear

POLE_TOLERANCE = 1e-6  # distance of equal poles, relative to the fastest pole
RANK_TOLERANCE = 1e-9  # largest zero singular value, relative to the largest singular value
Poles = NDArray[np.complex128]


@dataclass(frozen=True)
class Pole:
    """A pole with multiplicity and sizes of its Jordan blocks, its controllability and observability."""

    value: complex
    count: int
    blocks: tuple[int, ...]
    controllable: bool
    observable: bool

    @property
    def natural_frequency(self) -> float:
        """Return |λ| [rad/s]."""
        return abs(self.value)

    @property
    def damping_ratio(self) -> float:
        """Return −Re λ/|λ|, NaN at 0."""
        return -self.value.real / abs(self.value) if self.value else float("nan")

    @property
    def time_constant(self) -> float:
        """Return −1/Re λ [s], infinite on the imaginary axis."""
        return -1.0 / self.value.real if self.value.real else float("inf")


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
    A, B, C = linear.A, linear.B, linear.C
    values = poles(A)
    size = float(np.abs(values).max(initial=0.0))
    every = tuple(_pole(A, B, C, values[group], size) for group in _groups(values, POLE_TOLERANCE * size))
    rank = controllable_rank(A, B)
    condition = float(np.linalg.cond(controllability(A, B))) if rank == len(A) > 0 else float("inf")
    stable = all(p.value.real < -POLE_TOLERANCE * size for p in every)
    return Structure(every, rank, controllable_rank(A.T, C.T), condition, stable)


def poles(A: Array) -> Poles:
    """Return the eigenvalues of A by blocks, slowest first."""
    values = [complex(v) for block in _blocks(A) for v in np.linalg.eigvals(A[np.ix_(block, block)])]
    return np.array(sorted(values, key=lambda v: (round(abs(v), 12), v.real, -v.imag)), dtype=complex)


def _blocks(A: Array) -> list[list[int]]:
    """Return blocks of states with mutual feedback, in block triangular order."""
    from scipy.sparse.csgraph import connected_components

    if not len(A):
        return []
    count, label = connected_components(A != 0.0, directed=True, connection="strong")
    sorter: TopologicalSorter[int] = TopologicalSorter({k: set() for k in range(count)})
    for i, j in zip(*np.nonzero(A), strict=True):
        if label[i] != label[j]:
            sorter.add(int(label[j]), int(label[i]))
    return [np.flatnonzero(label == k).tolist() for k in sorter.static_order()]


def controllability(A: Array, B: Array) -> Array:
    """Return (B, AB, A²B, …, Aⁿ⁻¹B); eq 5.35 has one power more."""
    parts = [B]
    for _ in A[1:]:
        parts.append(A @ parts[-1])
    return np.hstack(parts)


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


def jordan_blocks(A: Array, value: complex, count: int) -> tuple[int, ...]:
    """Return sizes of an eigenvalue's Jordan blocks, largest first.

    On the invariant subspace from Schur's form, A − λI is nilpotent, and the ranks of its powers give the sizes.
    """
    from scipy.linalg import matrix_balance, schur

    if count == 1:
        return (1,)
    order = [k for block in _blocks(A) for k in block]
    balanced, _ = matrix_balance(A[np.ix_(order, order)], permute=False)
    size = max(float(np.linalg.norm(balanced, 2)), 1e-300)
    form, _, dimension = schur(balanced, output="complex", sort=lambda v: abs(v - value) <= 10 * POLE_TOLERANCE * size)
    if dimension != count:
        return (count,)
    nilpotent = (form[:count, :count] - value * np.eye(count)) / size
    nullities, power = [0], np.eye(count, dtype=complex)
    while nullities[-1] < count and len(nullities) <= count:
        power = power @ nilpotent
        singular = np.linalg.svd(power, compute_uv=False)
        nullities.append(int(np.sum(singular <= RANK_TOLERANCE ** min(len(nullities), 1.5))))
    at_least = [*np.diff(nullities).tolist(), 0]  # number of blocks of size 1 or larger, 2 or larger, …
    sizes = [k + 1 for k, more in enumerate(at_least[:-1]) for _ in range(max(0, more - at_least[k + 1]))]
    return tuple(sorted(sizes, reverse=True)) or (count,)


def _pole(A: Array, B: Array, C: Array, values: Poles, size: float) -> Pole:
    value = complex(values.mean())
    if abs(value.imag) < POLE_TOLERANCE * size:
        value = complex(value.real, 0.0)
    blocks = jordan_blocks(A, value, len(values))
    return Pole(value, len(values), blocks, _is_controllable(A, B, value), _is_controllable(A.T, C.T, value))


def _is_controllable(A: Array, B: Array, value: complex) -> bool:
    """Return True if the eigenvalue λ is controllable: (A − λI, B) has rank n (Popov, Belevitch, Hautus).

    The columns of B are normalised.
    """
    shifted = A - value * np.eye(len(A))
    size = max(float(np.linalg.norm(shifted, 2)), 1e-300)
    columns = B / np.maximum(np.abs(B).max(axis=0), 1e-300) if B.size else B
    singular = np.linalg.svd(np.hstack([shifted / size, columns]), compute_uv=False)
    return bool(np.sum(singular > RANK_TOLERANCE * 1e3 * singular[0]) == len(A))


def _groups(values: Poles, distance: float) -> list[list[int]]:
    groups: list[list[int]] = []
    for k, v in enumerate(values):
        near = next((g for g in groups if abs(values[g].mean() - v) <= max(distance, 1e-12)), None)
        if near is None:
            groups.append([k])
        else:
            near.append(k)
    return groups
