"""Linear algebra for estimates, without LAPACK errors.

LAPACK does not check its arguments. For NaN or infinity it writes to stdout, raises LinAlgError or does not return. A
matrix with non-finite entries comes from a diverged model. Functions of this module then return zeros.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from cosim.core.arrays import Array


def least_squares(matrix: Array, side: Array, rcond: float | None = None) -> Array:
    """Return the least-squares solution x of matrix·x = side with the smallest norm."""
    result = _result(lambda a, b: np.linalg.lstsq(a, b, rcond=rcond)[0], matrix, side)
    return np.zeros((matrix.shape[1], *side.shape[1:])) if result is None else result


def pseudo_inverse(matrix: Array) -> Array:
    """Return the Moore-Penrose pseudo-inverse."""
    result = _result(np.linalg.pinv, matrix)
    return np.zeros(matrix.shape[::-1]) if result is None else result


def solution(matrix: Array, side: Array) -> Array:
    """Return the solution x of square equations matrix·x = side; for a singular matrix, the least-squares solution."""
    result = _result(np.linalg.solve, matrix, side)
    return least_squares(matrix, side) if result is None else result


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of the columns. A non-finite column counts as zero."""
    finite = np.isfinite(columns).all(axis=0)
    return np.asarray(np.linalg.qr(columns if finite.all() else np.where(finite, columns, 0.0))[0])


def square_roots(covariances: Array) -> Array:
    """Return a matrix L for each covariance matrix P, with L·Lᵀ = P; zeros for a non-finite P."""
    finite = np.isfinite(covariances).all(axis=(-2, -1), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(finite, covariances, 0.0))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def eigenvalues(matrix: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Return the eigenvalues; an empty array for a non-finite matrix."""
    result = _result(np.linalg.eigvals, matrix) if matrix.size else None
    return np.zeros(0, np.complex128) if result is None else result.astype(np.complex128)


def _result(function: Callable[..., Any], *arrays: Array) -> Any:
    """Return the result of a LAPACK function; None if an array is non-finite or the algorithm does not converge."""
    if all(np.isfinite(array).all() for array in arrays):
        with suppress(np.linalg.LinAlgError):
            return np.asarray(function(*arrays))
    return None
