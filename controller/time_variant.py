"""Model predictive control with limits, and A(t), B(t) of the craft's equations along the planned motion."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from controller.design_model import Matrix
from controller.extended import ExtendedFilter, level_tilt
from controller.full_model import INPUTS, STATES
from controller.horizon import NAMES, PREDICTED, PredictionSteps, condensed, cost_to_go, of_steps, weights
from controller.laws import Estimator, LawInput
from controller.predictive import POSITIONS, Predicting
from controller.slopes import Slopes
from controller.time_variant_settings import TimeVariantSettings
from cosim.model.namespaces import arrays

SMALL = 0.25  # |λ|·h up to which the series of φ₁ is used, with error (|λ|·h)⁵/120


class TimeVariantLaw(Predicting):
    """Time-variant predictive law for motors and tilts, optimal over the N steps of the horizon.

    The commands u minimise

         Σ (z'·Q·z + u'·R·u)·Δ + z_N'·P·z_N,   |α| ≤ tilt_max,   duty_min ≤ δ ≤ duty_max,
         ż = f(x̄, ū) + A(t)·(x − x̄) + B(t)·(u − ū),   A(t) = ∂f/∂x, B(t) = ∂f/∂u at x̄(t), ū(t)

    z is the deviation from rest at the references of x, y and ψ; x̄, ū are motion and commands planned at the previous
    sample, shifted by one sample. At the first sample x̄ is the estimate and ū the command at rest. Commands, A and B
    are held over a prediction step. P is the cost to go of the LQR at hover. With one program per sample, the plan
    follows a changed reference within some samples (real-time iteration, Diehl, Bock, Schlöder 2005). An own extended
    Kalman filter estimates all states.
    """

    filter: ExtendedFilter

    def __init__(self, p: TimeVariantSettings, printed: Mapping[str, Any], y_hat: float = 0.0) -> None:
        super().__init__(p)
        self.p, self.printed, self.y_hat = p, printed, y_hat
        self.slopes = Slopes(p.craft, printed)
        self.rates = p.craft.acting(arrays()).derivative
        self.of_step = of_steps(p)
        hover = np.array([p.craft.start()])
        self.hover = hover[0, PREDICTED]
        A, B = self._linear(hover, self.rest[None])
        fastest = p.prediction_step * float(np.abs(np.linalg.eigvals(A[0])).max())
        self.doublings = max(0, math.ceil(math.log2(max(fastest, SMALL) / SMALL)))
        F, held = held_over(A, p.prediction_step, self.doublings)
        self.Q, self.R = (p.prediction_step * weight for weight in weights(p))
        self.P = cost_to_go(F[0], (held @ B)[0], self.Q, self.R)
        self.path, self.plan = np.zeros((0, len(NAMES))), np.zeros((0, len(INPUTS)))  # no plan yet

    def estimator(self, p: TimeVariantSettings, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the extended Kalman filter, started at x_hat with the tilts that cause its acceleration."""
        x, vx, psi, psi_dot, a = x_hat
        tilt = level_tilt(p.craft, a)
        start = {"x": x, "vx": vx, "psi": psi, "psi_dot": psi_dot, "y": self.y_hat}
        tilts = {"tilt_right": tilt, "tilt_left": tilt}
        self.filter = ExtendedFilter(p.craft, p.noise, self.printed, start | tilts, fix)
        return self.filter

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad]; `duties` holds the duties."""
        x = self.filter.filter.x[PREDICTED]
        target = self.hover.copy()
        target[POSITIONS] += seen.x_ref, seen.y_ref, seen.psi_ref
        path, plan = self._expected(x)
        cost = condensed(self.p, self._steps(path, plan, target), (x - target)[:, None], self.program.scale)
        cost = cost.at(np.ones(1))
        scaled = self.best(cost)
        self.path = target + np.vstack([x - target, cost.free + cost.forced @ scaled])
        self.plan = self.rest + (scaled.reshape(-1, len(INPUTS)) * self.program.scale)[self.of_step]
        return self.tilts

    def outputs(self) -> list[float]:
        """Return ŷ [m], its standard deviation, iterations, and 1 for solved."""
        return [self.filter.estimate[5], self.filter.sigma[2], float(self.iterations), float(self.solved)]

    def snapshot(self) -> dict[str, Any]:
        """Return the law's state with its planned motion."""
        return {"path": self.path.tolist(), "plan": self.plan.tolist(), **super().snapshot()}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the law's state with its planned motion."""
        self.path = np.array(snapshot["path"]).reshape(-1, len(NAMES))
        self.plan = np.array(snapshot["plan"]).reshape(-1, len(INPUTS))
        super().restore(snapshot)

    def _expected(self, x: Matrix) -> tuple[Matrix, Matrix]:
        """Return motion and commands at each step from the previous plan."""
        n = len(self.of_step)
        if not len(self.path):
            return np.tile(x, (n, 1)), np.tile(self.rest, (n, 1))
        at = np.minimum(np.arange(n) + self.p.sample_time / self.p.prediction_step, n)
        before = np.minimum(np.floor(at + 1e-9).astype(int), n - 1)
        share = (at - before)[:, None]
        return (1.0 - share) * self.path[before] + share * self.path[before + 1], self.plan[before]

    def _steps(self, path: Matrix, plan: Matrix, target: Matrix) -> PredictionSteps:
        """Return the prediction steps as deviations from target and rest command."""
        states = np.zeros((len(path), len(STATES)))
        states[:, PREDICTED] = path
        A, B = self._linear(states, plan)
        rates = np.stack(np.broadcast_arrays(*self.rates(0.0, tuple(states.T), tuple(plan.T))), axis=1)[:, PREDICTED]
        drift = rates[..., None] + A @ (target - path)[..., None] + B @ (self.rest - plan)[..., None]
        F, held = held_over(A, self.p.prediction_step, self.doublings)
        return PredictionSteps(F, held @ B, held @ drift, self.Q, self.R, self.P)

    def _linear(self, states: Matrix, commands: Matrix) -> tuple[Matrix, Matrix]:
        """Return the Jacobians along the horizon: A (N, 12, 12) by predicted states, B (N, 12, 4) by commands."""
        n = len(STATES)
        A = self.slopes.along("state", states, commands, (n, n))
        B = self.slopes.along("command", states, commands, (n, len(INPUTS)))
        return A[:, PREDICTED][:, :, PREDICTED], B[:, PREDICTED]


def held_over(A: Matrix, step: float, doublings: int) -> tuple[Matrix, Matrix]:
    """Return F = exp(h·A) and ∫₀ʰ exp(s·A) ds = h·φ₁(h·A) of each A.

    The step h consists of 2^doublings short ones with
    h·φ₁(h·A) = h·(I + h·A/2 + (h·A)²/6 + (h·A)³/24);   F = I + A·h·φ₁(h·A);   h·φ₁ → h·φ₁ + F·h·φ₁,   F → F·F.
    """
    h, unit = step / 2**doublings, np.eye(A.shape[-1])
    hA = h * A
    held = h * (unit + hA @ (unit / 2.0 + hA @ (unit / 6.0 + hA / 24.0)))
    F = unit + A @ held
    for _ in range(doublings):
        held, F = held + F @ held, F @ F
    return F, held
