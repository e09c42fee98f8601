"""Control laws from estimate and references to commands; a controller is an estimator with a law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from controller.observers import Estimator, LinearFilter, Stateful
from controller.settings import IntegralSettings, Settings


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


class Law(Stateful):
    """A control law, by default with the Kalman filter of the settings and the nominal duties.

    Attributes:
        duties: The last command's duties [%], right and left.
    """

    def __init__(self, p: Settings) -> None:
        self.gain, self.limit = p.gain_matrix, p.tilt_max
        self.duties = (p.duty_nominal, p.duty_nominal)

    def estimator(self, p: Any, x_hat: Sequence[float], fix: float) -> Estimator:
        """Return the law's estimator, started at x_hat (x, ẋ, ψ, ψ̇, a)."""
        return LinearFilter(p, x_hat, fix)

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        """Return the tilts [rad], right and left."""
        raise NotImplementedError

    def outputs(self) -> list[float]:
        """Return further outputs besides the commands."""
        return []

    def words(self, start: float) -> str:
        """Return remarks on a run from `start` [s], "" for none."""
        return ""


def feedback(gain: Sequence[Sequence[float]], error: Sequence[float], limit: float) -> tuple[float, ...]:
    """Return tilt commands [rad], eq 6.1: u = sat(−K·(x̂ − x_ref), ±limit), K (2, n)."""
    # Adding 0.0 turns −0.0 into 0.0, so that a craft at rest gives 0 in every file.
    return tuple(max(-limit, min(limit, -sum(k * e for k, e in zip(row, error, strict=True)))) + 0.0 for row in gain)


def control_error(x_hat: Sequence[float], seen: LawInput) -> list[float]:
    """Return x̂ less the reference of the five states, at rest."""
    return [a - b for a, b in zip(x_hat, (seen.x_ref, 0.0, seen.psi_ref, 0.0, 0.0), strict=True)]


class StateFeedback(Law):
    """State feedback u = sat(−K·(x̂ − x_ref), ±tilt_max), eq 6.1; K by LQR or pole placement."""

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        return feedback(self.gain, control_error(x_hat, seen), self.limit)


class IntegralFeedback(Law):
    """State feedback with integrals: u = sat(−K·(x̂ − x_ref) − K_i·ξ, ±tilt_max).

    ξ integrates measured errors:

        ξ₁ += Δt·(x_meas − x_ref) once there is a fix, Δt·(x̂ − x_ref) before;   ξ₂ += Δt·(ψ_meas − ψ_ref)

    The integrals stop while a tilt is saturated (anti-windup). Without fixes, no measurement contains a force that the
    accelerometer does not sense (a tilted table): x̂ settles at x_ref, but x does not.
    """

    memory = ("integrals",)

    def __init__(self, p: IntegralSettings) -> None:
        super().__init__(p)
        self.gain = tuple((*own, *more) for own, more in zip(p.gain_matrix, p.integral_matrix, strict=True))
        self.sample = p.sample_time
        self.integrals = [0.0, 0.0]

    def command(self, x_hat: Sequence[float], seen: LawInput) -> tuple[float, ...]:
        error = control_error(x_hat, seen)
        if seen.started:
            x = seen.x_meas if seen.fix else x_hat[0]
            errors = x - seen.x_ref, seen.psi - seen.psi_ref
            grown = [xi + self.sample * e for xi, e in zip(self.integrals, errors, strict=True)]
            if max(map(abs, feedback(self.gain, [*error, *grown], float("inf")))) <= self.limit:
                self.integrals = grown
        return feedback(self.gain, [*error, *self.integrals], self.limit)

    def outputs(self) -> list[float]:
        """Return both integrals."""
        return list(self.integrals)
