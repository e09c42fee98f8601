"""A loop with a component that answers only after a step and cannot save its state: coupled with a delay, not solved.

Such a component makes each step with the inputs z of the step's start. At its end the loop returns g(z); the residual
g(z) − z is measured there. Motion makes it of the order of the step. With a loop gain G it is multiplied by G from step
to step, so that the coupling diverges for |G| > 1.

Exponential growth is told from other growth by the steps in which the residual doubles: their number is constant. That
of a polynomial, or of values that settle, rises.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np

from cosim.base.arrays import Array

DOUBLINGS = 12  # of the residual, for the judgement whether it grows without bound
EVEN = 1.5  # ratio of the steps that the second and the first half of these doublings take
LARGE = 1e9  # residual in nominal values from which on such growth ends a run


class DelayedLoop:
    """Residuals of a loop at the ends of its steps.

    Args:
        reason: Why the loop is not solved.
        places: Places of the delayed inputs in the row, `names` of them, and their nominal values.
    """

    def __init__(self, reason: str, places: Sequence[int], names: Sequence[str], nominal: Sequence[float]) -> None:
        self.reason, self.places, self._names, self._nominal = reason, tuple(places), names, np.array(nominal)
        self._shares = array("d")  # residual of each step, relative to its signal
        self._largest = 0.0  # residual in nominal values
        self.worst: dict[str, Any] = {}
        self.last: dict[str, Any] = {}
        self._doublings: list[tuple[int, float]] = []  # step and size at which the residual had doubled again

    def note(self, t: float, assumed: Array, returned: Array) -> bool:
        """Note a residual; return whether it grows without bound."""
        residual = returned - assumed
        sizes = np.abs(residual) / self._nominal
        worst = int(np.argmax(sizes))
        size, value, change = (float(each[worst]) for each in (sizes, assumed, residual))
        self.last = {"signal": self._names[worst], "time": t, "value": value, "residual": change}
        if not self.worst or size > self._largest:
            self._largest, self.worst = size, self.last
        self._shares.append(abs(change) / max(abs(value), abs(value + change)) if change else 0.0)
        return self._grows(size)

    def _grows(self, size: float) -> bool:
        """Return whether a residual grows without bound."""
        if size <= 0.0 or (self._doublings and size < 2.0 * self._doublings[-1][1]):
            return False
        self._doublings.append((len(self._shares), size))
        steps = [step for step, _ in self._doublings[-DOUBLINGS - 1 :]]
        if size < LARGE or len(steps) <= DOUBLINGS:
            return False
        middle = steps[DOUBLINGS // 2]
        return steps[-1] - middle <= EVEN * (middle - steps[0])

    def record(self) -> dict[str, Any]:
        """Return the entry of the manifest."""
        if not self._shares:
            return {"reason": self.reason}
        shares = np.frombuffer(self._shares)
        relative = {"median": float(np.median(shares)), "last": float(shares[-1])}
        return {"reason": self.reason, "largest": self.worst, "last": self.last, "relative": relative}
