"""Controllers of many craft at once, with one value per run: the loop of `controller.loop` on arrays.

F, G, H, V, W and K of each run come from its `Settings`. Runs with equal settings share one covariance, which does not
depend on measurements.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from controller.design_model import Matrix, measurement_matrix
from controller.gains import Settings
from controller.kalman import discrete_model
from cosim.model import parameters_of

INPUTS = ("psi", "psi_dot", "ax", "x_ref", "psi_ref")
ESTIMATE = ("x_hat", "vx_hat", "psi_hat", "psi_dot_hat", "a_hat")
OUTPUTS = ("duty_right", "duty_left", "tilt_right", "tilt_left", *ESTIMATE, "x_sigma", "psi_sigma")
NUMBERS = frozenset(p.name for p in parameters_of(Settings))


class Controllers:
    """Factory of controllers for many runs, used by `cosim.sweeps.twins`."""

    def fits(self, block: Any) -> bool:
        """Return True if the FMU has exactly these inputs, in any order, and outputs."""
        inputs = [s.name for s in block.inputs]
        if sorted(inputs) != sorted(INPUTS) or tuple(s.name for s in block.outputs) != OUTPUTS:
            return False
        self.order = [inputs.index(name) for name in INPUTS]
        return True

    def pattern(self, given: Mapping[str, Any]) -> Hashable:
        """Return the estimator, common to runs of one batch."""
        return given.get("estimator")

    def make(self, given: Mapping[str, Any], count: int, *, compiled: bool) -> ManyLoops:
        """Return the controllers of `count` runs; no compiler is needed."""
        return ManyLoops(given, count, self.order)


class ManyLoops:
    """Prediction, update and feedback like `controller.loop.Loop`; x̂ and u have one column per run."""

    def __init__(self, given: Mapping[str, Any], count: int, order: Sequence[int]) -> None:
        self.given, self.order = given, order
        values = {name: v for name, v in given.items() if name in NUMBERS or name == "estimator"}
        varied = any(isinstance(v, np.ndarray) for v in values.values())
        settings = [Settings(**_at(values, k)) for k in range(count if varied else 1)]
        self.F, self.G = (np.array(matrices) for matrices in zip(*map(discrete_model, settings), strict=True))
        self.H = np.array([measurement_matrix(s, s.estimator) for s in settings])
        self.V = np.array([np.diag(s.process_variances) for s in settings])
        self.W = np.array([np.diag(s.measurement_variances) for s in settings])
        self.K = np.array([s.gain_matrix for s in settings])
        self.limit, self.duty, self.sample = np.array(
            [(s.tilt_max, s.duty_nominal, s.sample_time) for s in settings], dtype=float
        ).T

    def begin(self, inputs: Matrix, outputs: Matrix, t: float) -> None:
        """Start the filters at `*_hat_start` with P = 0."""
        self.inputs, self.outputs = inputs, outputs
        for name, row in zip(INPUTS, self._rows(), strict=True):
            row[:] = self.given.get(name, 0.0)
        self.x = np.zeros((5, inputs.shape[1]))
        for name, row in zip(ESTIMATE, self.x, strict=True):
            row[:] = self.given.get(f"{name}_start", 0.0)
        self.P = np.zeros((self.F.shape[0], 5, 5))
        self.u = np.zeros((2, inputs.shape[1]))

    def settle(self) -> None:
        """Compute u₀ = sat(−K·(x̂₀ − x_ref)) without an update."""
        self._feed_back()

    def advance(self, t: float, h: float) -> None:
        """Process one sample, eqs 5.37-5.41 and 6.1; P in Joseph form as in filterpy."""
        if np.any(np.abs(h - self.sample) > 1e-6 * self.sample):
            raise ValueError(f"step of {h} s; the controller is sampled at {self.sample[0]} s (parameter sample_time)")
        F, H = self.F, self.H
        P = F @ self.P @ _transpose(F) + self.V
        S = H @ P @ _transpose(H) + self.W
        K = P @ _transpose(H) @ np.linalg.inv(S)
        I_KH = np.eye(5) - K @ H
        self.P = I_KH @ P @ _transpose(I_KH) + K @ self.W @ _transpose(K)
        z = np.array(self._rows()[:3])
        x = _apply(F, self.x) + _apply(self.G, self.u)
        self.x = x + _apply(K, z - _apply(H, x))
        self._feed_back()

    def _feed_back(self) -> None:
        error = self.x.copy()
        *_, x_ref, psi_ref = self._rows()
        error[0] -= x_ref
        error[2] -= psi_ref
        self.u = np.clip(-_apply(self.K, error), -self.limit, self.limit) + 0.0
        y = self.outputs
        y[0] = y[1] = self.duty
        y[2:4], y[4:9] = self.u, self.x
        y[9], y[10] = (np.sqrt(np.maximum(0.0, self.P[:, k, k])) for k in (0, 2))

    def _rows(self) -> list[Matrix]:
        return [self.inputs[k] for k in self.order]


def _at(values: Mapping[str, Any], k: int) -> dict[str, Any]:
    return {name: float(v[k]) if isinstance(v, np.ndarray) else v for name, v in values.items()}


def _transpose(stack: Matrix) -> Matrix:
    return np.swapaxes(stack, 1, 2)


def _apply(stack: Matrix, columns: Matrix) -> Matrix:
    """Return each matrix times its column; a single matrix applies to all."""
    if len(stack) == 1:
        shared: Matrix = stack[0] @ columns
        return shared
    each: Matrix = np.einsum("nij,jn->in", stack, columns)
    return each
