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

SAME = 1e-6  # distance within which two poles are equal, relative to the fastest pole
RANK = 1e-9  # share of the largest singular value below which one is zero
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
    """Return the structure of a linear model."""
    A, B, C = linear.A, linear.B, linear.C
    n = len(A)
    values, size = poles(A), _scale(A)
    groups = _grouped(values, SAME * size)
    to, by = reachable(A, B), reachable(A.T, C.T)
    found = tuple(_pole(A, B, C, values[g], size) for g in groups)
    stable = all(p.value.real < -SAME * size for p in found)
    return Structure(found, to, by, condition(A, B) if to == n > 0 else float("inf"), stable)


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


def controllability(A: Array, B: Array, powers: int | None = None) -> Array:
    """Return (B, AB, A²B, …, Aᵖ⁻¹B), by default p = n; eq 5.35 has one more."""
    parts = [B]
    for _ in range((len(A) if powers is None else powers) - 1):
        parts.append(A @ parts[-1])
    return np.hstack(parts) if len(A) else np.zeros((0, 0))


def condition(A: Array, B: Array) -> float:
    """Return the condition number of the controllability matrix in model units."""
    return float(np.linalg.cond(controllability(A, B)))


def reachable(A: Array, B: Array) -> int:
    """Return the dimension of the controllable subspace of the balanced model."""
    from scipy.linalg import matrix_balance

    if not len(A) or not B.size:
        return 0
    balanced, (scaling, _) = matrix_balance(A, permute=False, separate=True)
    base, fresh = np.zeros((len(A), 0)), B / scaling[:, None]
    fresh = fresh / np.maximum(np.abs(fresh).max(axis=0), 1e-300)
    most = max(float(np.abs(balanced).max()), 1e-300)
    while fresh.size and base.shape[1] < len(A):
        left = fresh - base @ (base.T @ fresh)
        left = left - base @ (base.T @ left)
        u, s, _ = np.linalg.svd(left, full_matrices=False)
        new = u[:, s > RANK * 1e3]
        base = np.hstack([base, new])
        fresh = balanced @ new / most
    return int(base.shape[1])


def jordan_blocks(A: Array, value: complex, count: int) -> tuple[int, ...]:
    """Return the sizes of an eigenvalue's Jordan blocks, largest first.

    On the invariant subspace from Schur's form, A − λI is nilpotent, and the ranks of its powers give the sizes.
    """
    from scipy.linalg import matrix_balance, schur

    if count == 1:
        return (1,)
    order = [k for block in _blocks(A) for k in block]
    balanced, _ = matrix_balance(A[np.ix_(order, order)], permute=False)
    size = max(float(np.linalg.norm(balanced, 2)), 1e-300)
    form, _, found = schur(balanced, output="complex", sort=lambda v: abs(v - value) <= 10.0 * SAME * size)
    if found != count:
        return (count,)
    nilpotent = (form[:count, :count] - value * np.eye(count)) / size
    nullities, power = [0], np.eye(count, dtype=complex)
    while nullities[-1] < count and len(nullities) <= count:
        power = power @ nilpotent
        singular = np.linalg.svd(power, compute_uv=False)
        nullities.append(int(np.sum(singular <= RANK ** min(len(nullities), 1.5))))
    at_least = [*np.diff(nullities).tolist(), 0]  # number of blocks of size 1 or larger, 2 or larger, …
    sizes = [k + 1 for k, more in enumerate(at_least[:-1]) for _ in range(max(0, more - at_least[k + 1]))]
    return tuple(sorted(sizes, reverse=True)) or (count,)


def _pole(A: Array, B: Array, C: Array, values: Poles, size: float) -> Pole:
    value = complex(values.mean())
    if abs(value.imag) < SAME * size:
        value = complex(value.real, 0.0)
    return Pole(value, len(values), jordan_blocks(A, value, len(values)), _full(A, B, value), _full(A.T, C.T, value))


def _full(A: Array, B: Array, value: complex) -> bool:
    """Return True if (A − λI, B) has rank n (Popov, Belevitch, Hautus).

    Columns of B are normalised.
    """
    n = len(A)
    shifted = A - value * np.eye(n)
    size = max(float(np.linalg.norm(shifted, 2)), 1e-300)
    columns = B / np.maximum(np.abs(B).max(axis=0), 1e-300) if B.size else B
    singular = np.linalg.svd(np.hstack([shifted / size, columns]), compute_uv=False)
    return bool(np.sum(singular > RANK * 1e3 * singular[0]) == n) if n else True


def _grouped(values: Poles, within: float) -> list[list[int]]:
    groups: list[list[int]] = []
    for k, v in enumerate(values):
        near = next((g for g in groups if abs(values[g].mean() - v) <= max(within, 1e-12)), None)
        if near is None:
            groups.append([k])
        else:
            near.append(k)
    return groups


def _scale(A: Array) -> float:
    return max((abs(v) for v in poles(A)), default=0.0)
