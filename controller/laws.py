"""Control laws from estimate and references to commands; a controller is an estimator with a law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from controller.gains import Settings
from controller.lqr import feedback
from controller.observers import LinearFilter
from controller.variants import IntegralSettings


class LawInput(NamedTuple):
    """Input of a law at a sample besides the estimate (x, vx, ψ, ψ̇, a).

    Attributes:
        started: False at the start, before the first measurement.
        fix: Number of the latest fix, 0 before the first; its position is x_meas, y_meas [m].
    """

    x_ref: float
    psi_ref: float
    y_ref: float = 0.0
    psi: float = 0.0
    x_meas: float = 0.0
    y_meas: float = 0.0
    fix: float = 0.0
    started: bool = False


class Estimator(Protocol):
    """Interface of the state estimator that a control law uses."""

    def step(self, measured: Sequence[float], command: Sequence[float], fix: float, position: Sequence[float]) -> None:
        """Process one sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            command: Duties and tilts that acted until now.
            fix: Number of the latest fix.
            position: Latest fix.
        """

    @property
    def estimate(self) -> tuple[float, ...]:
        """Return (x, ẋ, ψ, ψ̇, a), then y."""

    @property
    def sigma(self) -> tuple[float, ...]:
        """Return estimated standard deviations of x, ψ and y."""

    def snapshot(self) -> Any:
        """Return the complete state for JSON."""

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""


class Law(Protocol):
    """A control law."""

    def estimator(self, p: Any, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the law's estimator, started at x_hat (x, ẋ, ψ, ψ̇, a)."""

    @property
    def duties(self) -> tuple[float, float]:
        """Return the last command's duties [%], right and left."""

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad], right and left."""

    def outputs(self) -> list[float]:
        """Return further outputs besides the commands."""

    def words(self, start: float) -> str:
        """Return remarks on a run from `start` [s], "" for none."""

    def snapshot(self) -> Any:
        """Return the complete state for JSON."""

    def restore(self, snapshot: Any) -> None:
        """Restore a snapshot exactly."""


def wanted(seen: LawInput) -> tuple[float, ...]:
    """Return the reference of the five states, at rest."""
    return seen.x_ref, 0.0, seen.psi_ref, 0.0, 0.0


class OfLinearFilter:
    """A law without memory, with the Kalman filter of the settings."""

    def estimator(self, p: Settings, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the linear filter."""
        return LinearFilter(p, x_hat, fix)

    def outputs(self) -> list[float]:
        """Return no further outputs."""
        return []

    def words(self, start: float) -> str:
        """Return no remarks."""
        return ""

    def snapshot(self) -> Any:
        """Return no state."""
        return None

    def restore(self, snapshot: Any) -> None:
        """Restore nothing."""


class StateFeedback(OfLinearFilter):
    """State feedback u = sat(−K·(x̂ − x_ref), ±tilt_max), eq 6.1; K by LQR or pole placement."""

    def __init__(self, p: Settings) -> None:
        self.gain, self.limit = p.gain_matrix, p.tilt_max
        self.duties = (p.duty_nominal, p.duty_nominal)

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad]."""
        return feedback(self.gain, x_hat, wanted(seen), self.limit)


class IntegralFeedback(OfLinearFilter):
    """State feedback with integrals: u = sat(−K·(x̂ − x_ref) − K_i·ξ, ±tilt_max).

    ξ integrates measured errors:

        ξ₁ += Δt·(x_meas − x_ref) once there is a fix, Δt·(x̂ − x_ref) before;   ξ₂ += Δt·(ψ_meas − ψ_ref)

    The integrals stop while a tilt is saturated (anti-windup). Without fixes, no measurement contains a force that the
    accelerometer does not sense (a tilted table): x̂ settles at x_ref, but x does not.
    """

    def __init__(self, p: IntegralSettings) -> None:
        self.gain, self.limit, self.sample = p.gain_matrix, p.tilt_max, p.sample_time
        self.integral_gain = p.integral_matrix
        self.duties = (p.duty_nominal, p.duty_nominal)
        self.integrals = (0.0, 0.0)

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad]."""
        if seen.started:
            x = seen.x_meas if seen.fix else x_hat[0]
            errors = x - seen.x_ref, seen.psi - seen.psi_ref
            grown = tuple(xi + self.sample * e for xi, e in zip(self.integrals, errors, strict=True))
            free = self._tilts(x_hat, seen, grown)
            if max(map(abs, free)) <= self.limit:
                self.integrals = grown[0], grown[1]
        return tuple(max(-self.limit, min(self.limit, u)) + 0.0 for u in self._tilts(x_hat, seen, self.integrals))

    def _tilts(self, x_hat: Sequence[float], seen: LawInput, integrals: Sequence[float]) -> tuple[float, ...]:
        """Return the tilts before saturation."""
        error = [a - b for a, b in zip(x_hat, wanted(seen), strict=True)]
        rows = zip(self.gain, self.integral_gain, strict=True)
        return tuple(
            -sum(k * e for k, e in zip((*row, *more), (*error, *integrals), strict=True)) for row, more in rows
        )

    def outputs(self) -> list[float]:
        """Return both integrals."""
        return list(self.integrals)

    def snapshot(self) -> Any:
        """Return both integrals."""
        return list(self.integrals)

    def restore(self, snapshot: Any) -> None:
        """Restore both integrals."""
        self.integrals = snapshot[0], snapshot[1]
