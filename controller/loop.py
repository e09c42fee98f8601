"""What runs in the loop at each sample: predict, update, feed back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from controller.gains import Settings
from controller.laws import Law, Seen, StateFeedback


class Loop:
    """The controller at run time. Order at a sample: predict with the last command, update with (ψ, ψ̇, a_x), feed back.

    With the linear filter, which a law takes that has none of its own:

        x̂ = F·x̂ + G·u,   P = F·P·F' + V                                             (5.37, 5.38)
        K = P·H'/(H·P·H' + W),   x̂ += K·(z − H·x̂),   P = (I − K·H)·P               (5.39-5.41)
        u = law(x̂, references), by default sat(−K·(x̂ − (x_ref, 0, psi_ref, 0, 0)), ±tilt_max)   (6.1)

    Where a fix of the position has come since the last sample, a second update with it before the feedback:
        z = x_meas,   H = (1, −T, 0, 0, 0), T its age

    State (x, vx, ψ, ψ̇, a), a the thrust acceleration. At the start there is no update, P = 0.
    Without fixes x is not observable: the filter must be told where it starts.
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
        self.command = self.law.command(self.estimate, Seen(x_ref, psi_ref, y_ref, fix=fix))

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
        """Tilt commands [rad] from the measurements (ψ, ψ̇, a_x) and references of one sample.

        fix: the number of the latest fix, 0 before the first; where it has changed, x_meas and y_meas [m] are it
        """
        self.estimator.step(measured, (*self.law.duties, *self.command), fix, (x_meas, y_meas))
        seen = Seen(x_ref, psi_ref, y_ref, measured[0], x_meas, y_meas, fix, started=True)
        self.command = self.law.command(self.estimate, seen)
        return self.command

    @property
    def estimate(self) -> list[float]:
        """x̂ = (x, ẋ, ψ, ψ̇, a)."""
        return list(self.estimator.estimate[:5])

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviations of x [m] and ψ [rad] the filter believes in."""
        x, psi, *_ = self.estimator.sigma
        return x, psi

    def snapshot(self) -> dict[str, Any]:
        """All that decides the future, as plain numbers: the estimator's, last command, what the law remembers."""
        return {
            "estimator": self.estimator.snapshot(),
            "command": list(self.command),
            "law": self.law.snapshot(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot, bit for bit."""
        self.estimator.restore(snapshot["estimator"])
        self.command = tuple(snapshot["command"])
        self.law.restore(snapshot["law"])
