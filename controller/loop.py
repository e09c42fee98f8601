"""Controller at run time: at each sample, an estimator gives an estimate, from which a control law gives commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from controller.observers import Estimator, LinearFilter, Stateful
from controller.settings import Floats, IntegralSettings, Numbers, Settings


class LawInput(NamedTuple):
    """Input of a control law at a sample, besides the estimate (x, vx, ψ, ψ̇, a).

    Attributes:
        x_meas, y_meas: Position of the latest fix [m].
        fix: Number of the latest fix, 0 before the first; a new number makes its position valid.
        psi: Measured heading [rad].
        started: False before the first measurement.
    """

    x_ref: float
    psi_ref: float
    x_meas: float = 0.0
    y_meas: float = 0.0
    fix: float = 0.0
    y_ref: float = 0.0
    psi: float = 0.0
    started: bool = False


class Law(Stateful):
    """A control law, by default with the Kalman filter of the settings and the nominal duties.

    Attributes:
        duties: The last command's duties [%], right and left.
    """

    def __init__(self, p: Settings) -> None:
        self.gain, self.limit = p.gain_matrix, p.tilt_max
        self.duties = (p.duty_nominal, p.duty_nominal)

    def estimator(self, p: Any, x_hat: Numbers, fix: float) -> Estimator:
        """Return the estimator of the law, with the initial estimate x_hat = (x, ẋ, ψ, ψ̇, a)."""
        return LinearFilter(p, x_hat, fix)

    def command(self, x_hat: Numbers, seen: LawInput) -> Floats:
        """Return the tilts [rad], right and left."""
        raise NotImplementedError

    def outputs(self) -> list[float]:
        """Return further outputs besides the commands."""
        return []

    def words(self) -> str:
        """Return a sentence with remarks on the run; "" if there are none."""
        return ""


def feedback(gain: Sequence[Numbers], error: Numbers, limit: float) -> Floats:
    """Return tilt commands [rad], eq 6.1: u = sat(−K·(x̂ − x_ref), ±limit), K (2, n)."""
    # Adding 0.0 turns −0.0 into 0.0, so that a craft at rest gives 0 in every file.
    return tuple(max(-limit, min(limit, -sum(k * e for k, e in zip(row, error, strict=True)))) + 0.0 for row in gain)


def control_error(x_hat: Numbers, seen: LawInput) -> list[float]:
    """Return the deviation of the five estimated states from rest at the references."""
    return [a - b for a, b in zip(x_hat, (seen.x_ref, 0.0, seen.psi_ref, 0.0, 0.0), strict=True)]


class StateFeedback(Law):
    """State feedback u = sat(−K·(x̂ − x_ref), ±tilt_max), eq 6.1; K by LQR or pole placement."""

    def command(self, x_hat: Numbers, seen: LawInput) -> Floats:
        return feedback(self.gain, control_error(x_hat, seen), self.limit)


class IntegralFeedback(Law):
    """State feedback with integrals: u = sat(−K·(x̂ − x_ref) − K_i·ξ, ±tilt_max).

    ξ integrates measured errors:

        ξ₁ += Δt·(x_meas − x_ref) once there is a fix, Δt·(x̂ − x_ref) before;   ξ₂ += Δt·(ψ_meas − ψ_ref)

    The integrals stop while a tilt is saturated (anti-windup). Without fixes, no measurement shows a force that the
    accelerometer does not sense (of a tilted table): x̂ settles at x_ref, but x does not.
    """

    memory = ("integrals",)

    def __init__(self, p: IntegralSettings) -> None:
        super().__init__(p)
        self.sample, self.integrals = p.sample_time, [0.0, 0.0]

    def command(self, x_hat: Numbers, seen: LawInput) -> Floats:
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


class Loop(Stateful):
    """Controller at run time: prediction with the last command, update with (ψ, ψ̇, a_x), feedback.

    With the linear filter, the default estimator:

         x̂ = F·x̂ + G·u,   P = F·P·F' + V                                             (5.37, 5.38)
         K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P               (5.39-5.41)
         u = law(x̂, references), by default sat(−K·(x̂ − (x_ref, 0, psi_ref, 0, 0)), ±tilt_max)   (6.1)

    After a new position fix, a second update precedes the feedback:

         z = x_meas,   H = (1, −T, 0, 0, 0), T its age

    State (x, vx, ψ, ψ̇, a), a the thrust acceleration. At the start, P = 0 and there is no update. Without fixes, x is
    not observable, so the filter needs its start value.
    """

    def __init__(self, settings: Settings, x_hat: Numbers, *seen: float, law: Law | None = None) -> None:
        self.settings = settings
        start = LawInput(*seen)  # type: ignore[arg-type]  # its first fields are floats
        self.law = StateFeedback(settings) if law is None else law
        self.estimator = self.law.estimator(settings, x_hat, start.fix)
        self.command = self.law.command(self.estimate, start)
        parts = {"estimator": self.estimator, "law": self.law}
        self.memory = ("command", *(f"{part}.{name}" for part in parts for name in parts[part].memory))

    def step(self, measured: Numbers, *seen: float) -> Floats:
        """Return the tilt commands [rad] of one sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            seen: First fields of `LawInput`, at least x_ref and psi_ref.
        """
        now = LawInput(*seen)._replace(psi=measured[0], started=True)  # type: ignore[arg-type]
        self.estimator.step(measured, (*self.law.duties, *self.command), now.fix, (now.x_meas, now.y_meas))
        self.command = self.law.command(self.estimate, now)
        return self.command

    def outputs(self) -> list[float]:
        """Return commands, estimate, its standard deviations, and further outputs of the law."""
        return [*self.law.duties, *self.command, *self.estimate, *self.sigma, *self.law.outputs()]

    @property
    def estimate(self) -> list[float]:
        """Return x̂ = (x, ẋ, ψ, ψ̇, a)."""
        return list(self.estimator.estimate[:5])

    @property
    def sigma(self) -> tuple[float, float]:
        """Return the estimated standard deviations of x [m] and ψ [rad]."""
        x, psi, *_ = self.estimator.sigma
        return x, psi
