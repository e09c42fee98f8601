"""Solution of g(z) = z: Newton's method with damping, and fixed-point iterations with Anderson acceleration.

Newton: (I − G)·Δz = g(z) − z with G = ∂g/∂z, damped until the residual decreases. G is kept between calls and computed
again when the residual decreases slowly. The end is reached when both the residual and the next Δz are small: near a
singular I − G, a residual is small beside z without any solution near.

Anderson: H. F. Walker, P. Ni, Anderson Acceleration for Fixed-Point Iterations, SIAM J. Numer. Anal. 49 (2011),
eq. (2.2): the combination of the last m + 1 iterates with the smallest combined residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cosim.base.arrays import Array

SLOW = 0.25  # ratio of successive residuals, above which the slopes are computed again
SHORTEST = 2.0**-10  # smallest share of a Newton step
MOST_FAILURES = 1  # failures of current slopes; after the first, they are computed from differences
DEPTH = 8  # earlier iterates used by Anderson acceleration
Map = Callable[[Array], "Array | None"]  # g, or None where it is not defined


class Slopes(Protocol):
    """Source of the slopes of g."""

    def __call__(self, z: Array, g: Array, *, fresh: bool) -> Array:
        """Return ∂g/∂z at z; `fresh` demands differences."""


@dataclass(frozen=True)
class Outcome:
    """End of iterations: unknowns, their residual g(z) − z, iterations, and whether the residual is small enough."""

    z: Array
    residual: Array
    iterations: int
    converged: bool


class NotDefined(Exception):
    """Error: g is not defined at the first z."""


@dataclass
class RootFinding:
    """Settings and memory of a sequence of solutions.

    Attributes:
        scale: Smallest magnitude of each unknown for relative tolerances.
        slopes: Last computed ∂g/∂z.
        computed: Number of computations of the slopes.
    """

    tolerance: float
    most: int
    scale: Array
    slopes: Array | None = None
    computed: int = 0

    def size(self, z: Array, residual: Array) -> float:
        """Return the largest relative residual."""
        return float(np.max(np.abs(residual) / np.maximum(np.abs(z), self.scale), initial=0.0))

    def newton(self, g: Map, z: Array, slopes: Slopes) -> Outcome:
        """Solve by Newton's method from z.

        Raises:
            NotDefined: g is not defined at z.
        """
        value = self._first(g, z)
        residual = value - z
        size = self.size(z, residual)
        is_current, failures = False, 0  # whether the slopes are of this call, and how often they were of no use
        converged = False
        for iteration in range(self.most + 1):
            if not residual.any():
                converged = True
                break
            if self.slopes is None:
                self.slopes, is_current = slopes(z, value, fresh=failures > 0), True
                self.computed += 1
                if size <= self.tolerance:
                    g(z)  # Differences leave another point behind.
            direction = _solve(np.eye(z.size) - self.slopes, residual)
            converged = max(size, self.size(z, direction)) <= self.tolerance
            if converged or iteration == self.most or failures > MOST_FAILURES:
                break
            moved = self._damped(g, z, direction, size)
            if moved is None:
                failures += is_current
                self.slopes = None
                continue
            before, (z, value, share) = size, moved
            residual = value - z
            size = self.size(z, residual)
            if size > SLOW * before or share < 1.0:
                self.slopes = None
        return Outcome(z, residual, iteration, converged)

    def anderson(self, g: Map, z: Array) -> Outcome:
        """Solve by accelerated fixed-point iterations from z.

        Raises:
            NotDefined: g is not defined at z.
        """
        points: list[Array] = []
        residuals: list[Array] = []
        value = self._first(g, z)
        for iteration in range(self.most + 1):
            residual = value - z
            if self.size(z, residual) <= self.tolerance or iteration == self.most:
                break
            points, residuals = [*points[-DEPTH:], z], [*residuals[-DEPTH:], residual]
            ahead = value
            if len(points) > 1:
                dz, dr = np.diff(np.array(points), axis=0).T, np.diff(np.array(residuals), axis=0).T
                weights = np.linalg.lstsq(dr, residual, rcond=None)[0]
                ahead = value - (dz + dr) @ weights
            moved = self._damped(g, z, ahead - z, float("inf"))
            if moved is None:
                break
            z, value, _ = moved
        return Outcome(z, residual, iteration, self.size(z, residual) <= self.tolerance)

    def _first(self, g: Map, z: Array) -> Array:
        value = g(z)
        if value is None:
            raise NotDefined
        return value

    def _damped(self, g: Map, z: Array, direction: Array, size: float) -> tuple[Array, Array, float] | None:
        """Return a better point, g there, and its share."""
        share = 1.0
        while share >= SHORTEST and np.isfinite(direction).all():
            ahead = z + share * direction
            value = g(ahead)
            if value is not None and self.size(ahead, value - ahead) <= max((1.0 - 0.1 * share) * size, self.tolerance):
                return ahead, value, share
            share *= 0.5
        return None


def _solve(matrix: Array, right: Array) -> Array:
    """Return the smallest solution of a linear system."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])
