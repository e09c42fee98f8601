"""Linear algebra for estimates: a result for every matrix, never a LAPACK error.

LAPACK does not check its arguments. For NaN or infinity it writes to stdout, raises LinAlgError or does not return.
A matrix with non-finite entries comes from a diverged model and supports no estimate. The result is then zero: no
step, no gain, no correction.
"""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Array


def least_squares(matrix: Array, side: Array, rcond: float | None = None) -> Array:
    """Return the least-squares solution of minimum norm."""
    if _finite(matrix, side):
        try:
            return np.asarray(np.linalg.lstsq(matrix, side, rcond=rcond)[0])
        except np.linalg.LinAlgError:  # the iteration did not converge
            pass
    return np.zeros((matrix.shape[1], *side.shape[1:]))


def pseudo_inverse(matrix: Array) -> Array:
    """Return the pseudo-inverse."""
    if _finite(matrix):
        try:
            return np.asarray(np.linalg.pinv(matrix))
        except np.linalg.LinAlgError:
            pass
    return np.zeros(matrix.shape[::-1])


def solution(matrix: Array, side: Array) -> Array:
    """Return the solution of square equations.

    The least-squares solution replaces the solution of singular equations.
    """
    if _finite(matrix, side):
        try:
            return np.asarray(np.linalg.solve(matrix, side))
        except np.linalg.LinAlgError:
            pass
    return least_squares(matrix, side)


def orthonormal(columns: Array) -> Array:
    """Return an orthonormal basis of the columns. A non-finite column counts as zero."""
    finite = np.isfinite(columns).all(axis=0)
    return np.asarray(np.linalg.qr(columns if finite.all() else np.where(finite, columns, 0.0))[0])


def square_roots(covariances: Array) -> Array:
    """Return L of each covariance, with L·L' = P; zero for a non-finite covariance."""
    finite = np.isfinite(covariances).all(axis=(-2, -1), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(finite, covariances, 0.0))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def eigenvalues(matrix: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
    """Return the eigenvalues; none of a non-finite matrix."""
    if matrix.size and _finite(matrix):
        try:
            return np.linalg.eigvals(matrix).astype(np.complex128)
        except np.linalg.LinAlgError:
            pass
    return np.zeros(0, np.complex128)


def _finite(*arrays: Array) -> bool:
    return all(bool(np.isfinite(a).all()) for a in arrays)
