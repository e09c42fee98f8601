"""Controller at run time: prediction, update, feedback at each sample."""

from __future__ import annotations

from collections.abc import Sequence

from controller.laws import Law, LawInput, StateFeedback
from controller.observers import Stateful
from controller.settings import Settings


class Loop(Stateful):
    """Controller at run time: prediction with the last command, update with (ψ, ψ̇, a_x), feedback.

    With the linear filter, the default estimator:

         x̂ = F·x̂ + G·u,   P = F·P·F' + V                                             (5.37, 5.38)
         K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P               (5.39-5.41)
         u = law(x̂, references), by default sat(−K·(x̂ − (x_ref, 0, psi_ref, 0, 0)), ±tilt_max)   (6.1)

    After a new position fix, a second update precedes the feedback:

         z = x_meas,   H = (1, −T, 0, 0, 0), T its age

    State (x, vx, ψ, ψ̇, a), a the thrust acceleration. The start has no update and P = 0. Without fixes, x is not
    observable, so the filter needs its start value.
    """

    def __init__(
        self,
        settings: Settings,
        x_hat: Sequence[float],
        x_ref: float,
        psi_ref: float,
        fix: float = 0.0,
        *,
        y_ref: float = 0.0,
        law: Law | None = None,
    ) -> None:
        self.settings = settings
        self.law = StateFeedback(settings) if law is None else law
        self.estimator = self.law.estimator(settings, x_hat, fix)
        self.command = self.law.command(self.estimate, LawInput(x_ref, psi_ref, y_ref, fix=fix))
        parts = {"estimator": self.estimator, "law": self.law}
        self.memory = ("command", *(f"{part}.{name}" for part in parts for name in parts[part].memory))

    def step(
        self,
        measured: Sequence[float],
        x_ref: float,
        psi_ref: float,
        fix: float = 0.0,
        x_meas: float = 0.0,
        *,
        y_meas: float = 0.0,
        y_ref: float = 0.0,
    ) -> tuple[float, ...]:
        """Return the tilt commands [rad] of one sample.

        Args:
            measured: (ψ, ψ̇, a_x).
            fix: Number of the latest fix, 0 before the first; a new number makes x_meas and y_meas [m] valid.
        """
        self.estimator.step(measured, (*self.law.duties, *self.command), fix, (x_meas, y_meas))
        seen = LawInput(x_ref, psi_ref, y_ref, measured[0], x_meas, y_meas, fix, started=True)
        self.command = self.law.command(self.estimate, seen)
        return self.command

    @property
    def estimate(self) -> list[float]:
        """Return x̂ = (x, ẋ, ψ, ψ̇, a)."""
        return list(self.estimator.estimate[:5])

    @property
    def sigma(self) -> tuple[float, float]:
        """Return the estimated standard deviations of x [m] and ψ [rad]."""
        x, psi, *_ = self.estimator.sigma
        return x, psi
