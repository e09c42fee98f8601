"""Control laws: what makes commands of an estimate and references. A controller is an estimator and one of these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from controller.gains import Settings
from controller.lqr import feedback
from controller.observers import LinearFilter
from controller.variants import IntegralSettings


class Seen(NamedTuple):
    """What a law is given at a sample, beside the estimate (x, vx, ψ, ψ̇, a).

    started: whether this is a sample with measurements; at the start there are none
    fix:     the number of the latest fix, 0 before the first; x_meas, y_meas [m] are its position
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
    """What a law is given its estimate by."""

    def step(self, measured: Sequence[float], command: Sequence[float], fix: float, position: Sequence[float]) -> None:
        """Take one sample: (ψ, ψ̇, a_x), the command (duties, tilts) that acted until now, number and place of a fix."""

    @property
    def estimate(self) -> tuple[float, ...]:
        """(x, ẋ, ψ, ψ̇, a), then y."""

    @property
    def sigma(self) -> tuple[float, ...]:
        """Standard deviations of x, ψ and y that it believes in."""

    def snapshot(self) -> Any:
        """Return all that decides its future, as JSON knows it."""

    def restore(self, snapshot: Any) -> None:
        """Go back to a snapshot, bit for bit."""


class Law(Protocol):
    """A control law."""

    def estimator(self, p: Any, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the estimator of this law, which starts at x_hat (x, ẋ, ψ, ψ̇, a)."""

    @property
    def duties(self) -> tuple[float, float]:
        """Duties [%] that go with the tilts it commanded last, right and left."""

    def command(self, x_hat: Sequence[float], seen: Seen) -> tuple[float, ...]:
        """Tilts [rad], right and left."""

    def outputs(self) -> list[float]:
        """What it publishes beside its commands."""

    def words(self, start: float) -> str:
        """What is to be known at the end of a run that began at `start` [s]; "" for nothing."""

    def snapshot(self) -> Any:
        """What decides its future, as JSON knows it."""

    def restore(self, snapshot: Any) -> None:
        """Go back to a snapshot, bit for bit."""


def wanted(seen: Seen) -> tuple[float, ...]:
    """Where the five states are to be: at rest."""
    return seen.x_ref, 0.0, seen.psi_ref, 0.0, 0.0


class OfLinearFilter:
    """A law that takes its estimate from the Kalman filter that the settings name; it remembers nothing."""

    def estimator(self, p: Settings, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the linear filter."""
        return LinearFilter(p, x_hat, fix)

    def outputs(self) -> list[float]:
        """Nothing more."""
        return []

    def words(self, start: float) -> str:
        """Nothing."""
        return ""

    def snapshot(self) -> Any:
        """Nothing."""
        return None

    def restore(self, snapshot: Any) -> None:
        """Nor is there anything to go back to."""


class StateFeedback(OfLinearFilter):
    """u = sat(−K·(x̂ − x_ref), ±tilt_max), eq 6.1; K by LQR or by pole placement."""

    def __init__(self, p: Settings) -> None:
        self.gain, self.limit = p.gain_matrix, p.tilt_max
        self.duties = (p.duty_nominal, p.duty_nominal)

    def command(self, x_hat: Sequence[float], seen: Seen) -> tuple[float, ...]:
        """Tilts [rad]."""
        return feedback(self.gain, x_hat, wanted(seen), self.limit)


class IntegralFeedback(OfLinearFilter):
    """u = sat(−K·(x̂ − x_ref) − K_i·ξ, ±tilt_max), ξ the integrals of what is measured less its reference.

        ξ₁ += Δt·(x_meas − x_ref) once there is a fix, Δt·(x̂ − x_ref) before;   ξ₂ += Δt·(ψ_meas − ψ_ref)

    While a tilt is saturated the integrals stand still, so that they do not wind up. Without fixes a push that the
    accelerometer does not feel (a table out of level) is in no measurement: x̂ comes to rest at x_ref, x does not.
    """

    def __init__(self, p: IntegralSettings) -> None:
        self.gain, self.limit, self.sample = p.gain_matrix, p.tilt_max, p.sample_time
        self.integral_gain = p.integral_matrix
        self.duties = (p.duty_nominal, p.duty_nominal)
        self.integrals = (0.0, 0.0)

    def command(self, x_hat: Sequence[float], seen: Seen) -> tuple[float, ...]:
        """Tilts [rad]."""
        if seen.started:
            x = seen.x_meas if seen.fix else x_hat[0]
            errors = x - seen.x_ref, seen.psi - seen.psi_ref
            grown = tuple(xi + self.sample * e for xi, e in zip(self.integrals, errors, strict=True))
            free = self._tilts(x_hat, seen, grown)
            if max(map(abs, free)) <= self.limit:
                self.integrals = grown[0], grown[1]
        return tuple(max(-self.limit, min(self.limit, u)) + 0.0 for u in self._tilts(x_hat, seen, self.integrals))

    def _tilts(self, x_hat: Sequence[float], seen: Seen, integrals: Sequence[float]) -> tuple[float, ...]:
        """Before they are saturated."""
        error = [a - b for a, b in zip(x_hat, wanted(seen), strict=True)]
        rows = zip(self.gain, self.integral_gain, strict=True)
        return tuple(
            -sum(k * e for k, e in zip((*row, *more), (*error, *integrals), strict=True)) for row, more in rows
        )

    def outputs(self) -> list[float]:
        """Both integrals."""
        return list(self.integrals)

    def snapshot(self) -> Any:
        """Both integrals."""
        return list(self.integrals)

    def restore(self, snapshot: Any) -> None:
        """Both integrals."""
        self.integrals = snapshot[0], snapshot[1]
