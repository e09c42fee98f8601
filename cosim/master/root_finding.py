"""Solution of g(z) = z: Newton's method with damping, and fixed-point iterations with Anderson acceleration.

Newton: (I − G)·Δz = g(z) − z with G = ∂g/∂z, damped until the residual decreases. After each step, the change of g
corrects G (C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965), first
method). G is kept between calls, and computed again when the residual decreases slowly. Iterations end when both the
residual and the next Δz are small, because near a singular I − G the residual can be small far from any solution.

Small means small relative to the magnitude or the nominal value of an unknown. An unknown without a declared nominal
value may be tiny, so that relative to 1 each point would be a solution. For such an unknown its magnitude counts,
unless no step decreases the residual.

Anderson: H. F. Walker, P. Ni, Anderson Acceleration for Fixed-Point Iterations, SIAM J. Numer. Anal. 49 (2011),
eq. (2.2): the combination of the last m + 1 iterates with the smallest combined residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cosim.core.arrays import Array, Flags

SLOW_CONVERGENCE_RATIO = 0.25  # ratio of successive residuals, above which the slopes are computed again
MIN_NEWTON_SHARE = 2.0**-10  # smallest share of a Newton step
MOST_FAILURES = 1  # failures of current slopes; after the first, they are computed from differences
DEPTH = 8  # earlier iterates used by Anderson acceleration
ROUNDING_RESIDUAL = 1e-13  # residual of rounding, relative to the largest magnitude
Map = Callable[[Array], "Array | None"]  # g, or None where it is not defined
Slopes = Callable[..., Array]  # of z, g(z) and `fresh`, which demands differences: ∂g/∂z at z


@dataclass(frozen=True)
class Outcome:
    """Result of iterations: unknowns z, residual g(z) − z, number of iterations, and whether the residual is small.

    Attributes:
        is_rough: True if the residual is small relative to 1, but not to the magnitude of an unknown.
    """

    z: Array
    residual: Array
    iterations: int
    converged: bool
    is_rough: bool = False


@dataclass
class RootFinding:
    """Solver settings, and memory between the solutions of a sequence of problems.

    Attributes:
        scale: Smallest magnitude of each unknown for relative tolerances.
        is_assumed: For each unknown, True if its `scale` is assumed, not declared; by default all are declared.
        slopes: Last computed ∂g/∂z.
        largest: Largest magnitude of all signals so far, which determines the residual due to rounding.
    """

    tolerance: float
    most: int
    scale: Array
    is_assumed: Flags | bool = False
    slopes: Array | None = None
    largest: float = 0.0
    _solved: Array | float = 0.0  # largest magnitude of each unknown in a solution

    def _own_size(self, z: Array, residual: Array, change: Array) -> float:
        """Return the largest change relative to the magnitude of its unknown, apart from rounding."""
        seen = np.max([np.abs(z), np.abs(z + residual), np.abs(change), self._solved + 0.0 * z], axis=0)
        scale = np.maximum(np.abs(z), np.where(self.is_assumed, np.minimum(self.scale, seen), self.scale))
        counts = np.abs(change) > ROUNDING_RESIDUAL * max(self.largest, float(np.max(seen, initial=0.0)))
        return float(np.max(np.abs(change[counts]) / scale[counts], initial=0.0))

    def size(self, z: Array, residual: Array) -> float:
        """Return the largest relative residual."""
        return float(np.max(np.abs(residual) / np.maximum(np.abs(z), self.scale), initial=0.0))

    def newton(self, g: Map, z: Array, slopes: Slopes) -> Outcome | None:
        """Solve by Newton's method from z; return None if g is not defined there."""
        if (value := g(z)) is None:
            return None
        residual = value - z
        size = self.size(z, residual)
        is_current, failures = False, 0  # True if the Jacobian is of this call; how often it failed
        converged = is_small = is_regular = False
        direction, first = residual, np.maximum(np.maximum(np.abs(z), np.abs(value)), self.scale)
        for iteration in range(self.most + 1):
            if not residual.any():
                converged = True
                break
            if self.slopes is None:
                self.slopes, is_current = slopes(z, value, fresh=failures > 0), True
                if size <= self.tolerance:
                    g(z)  # after differences, evaluate g at z again
            matrix = np.eye(z.size) - self.slopes
            try:
                direction, is_regular = np.asarray(np.linalg.solve(matrix, residual)), True
            except np.linalg.LinAlgError:  # singular: use the solution of minimum norm
                direction, is_regular = np.asarray(np.linalg.lstsq(matrix, residual, rcond=None)[0]), False
            is_small = max(size, self.size(z, direction)) <= self.tolerance
            own = [self._own_size(z, residual, each) for each in (residual, direction)] if is_small else [np.inf]
            # If the next step is not unique, only a residual due to rounding counts as small.
            converged = max(own) <= self.tolerance if is_regular else own[0] == 0.0
            if converged or iteration == self.most or failures > MOST_FAILURES:
                break
            moved = None
            if not is_small:
                moved = self._damped(g, z, direction, size)
            elif (there := g(ahead := z + direction)) is not None:  # the full step must reduce the residual clearly
                after = self._own_size(ahead, there - ahead, there - ahead)
                moved = (ahead, there, 1.0) if after <= SLOW_CONVERGENCE_RATIO * own[0] else None
            if moved is None:
                failures += is_current
                self.slopes = None
                continue
            before, was, (z, value, share) = size, (z, value), moved
            residual = value - z
            size = self.size(z, residual)
            is_slow = size > SLOW_CONVERGENCE_RATIO * before or share < 1.0
            self.slopes = None if is_slow else self._updated(z, z - was[0], value - was[1])
        is_rough = is_small or self._own_size(z, residual, residual) > self.tolerance
        sizes = [float(np.max(np.abs(change) / first)) for change in (residual, direction)]
        close = max(sizes[0] / self.tolerance, sizes[1] / self.tolerance**0.5) <= 1.0
        is_small = is_regular and (is_small or close)
        return self._end(z, residual, iteration, converged, is_small, is_rough)

    def anderson(self, g: Map, z: Array) -> Outcome | None:
        """Solve by accelerated fixed-point iterations from z; return None if g is not defined there."""
        points: list[Array] = []
        residuals: list[Array] = []
        if (value := g(z)) is None:
            return None
        before, stalls = np.inf, 0
        for iteration in range(self.most + 1):
            residual = value - z
            own = self._own_size(z, residual, residual)
            is_small = self.size(z, residual) <= self.tolerance
            stalls += own > SLOW_CONVERGENCE_RATIO * before
            if iteration == self.most or (is_small and (own <= self.tolerance or stalls > z.size + 1)):
                break
            before = own
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
        return self._end(z, residual, iteration, is_small and own <= self.tolerance, is_small, True)

    def _updated(self, z: Array, dz: Array, dg: Array) -> Array:
        """Return the Jacobian after Broyden's update."""
        assert self.slopes is not None
        units = np.maximum(np.abs(z), self.scale)
        length = np.max(np.abs(dz / units))
        if length <= self.tolerance:  # in so small a change, rounding may dominate
            return self.slopes
        along = dz / units / length  # in this order to avoid underflow
        return np.asarray(self.slopes + np.outer((dg - self.slopes @ dz) / length, along / units) / (along @ along))

    def _end(self, z: Array, residual: Array, count: int, converged: bool, is_small: bool, is_rough: bool) -> Outcome:
        """Return the outcome, and store the magnitudes of the unknowns if the residual is small enough."""
        if converged or is_small:
            self._solved = np.maximum(self._solved, np.abs(z))
        return Outcome(z, residual, count, converged or is_small, is_rough and is_small and not converged)

    def _damped(self, g: Map, z: Array, direction: Array, size: float) -> tuple[Array, Array, float] | None:
        """Return a point z' with a smaller residual, g(z'), and the share of the full step that leads to z'."""
        share = 1.0
        while share >= MIN_NEWTON_SHARE and np.isfinite(direction).all():
            ahead = z + share * direction
            value = g(ahead)
            if value is not None and self.size(ahead, value - ahead) <= max((1.0 - 0.1 * share) * size, self.tolerance):
                return ahead, value, share
            share *= 0.5
        return None
