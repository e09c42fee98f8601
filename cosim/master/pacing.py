"""Pace of a run: each communication point waits until it is due on the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, MutableSequence, Sequence
from typing import Any

import numpy as np

from cosim.isolation.rows import WAITING

SPIN = 2e-4  # [s] before a point is due; in this time the clock is polled instead of sleeping
NAP = 0.1  # longest sleep [s], after which a requested end of the run is noticed
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p999": 99.9}


class Pacer:
    """Waiting until communication points are due, and a record of how late they were.

    Due times are counted from the first point, so that a late point does not delay later ones. A run that is behind
    does not wait until it has caught up.

    Attributes:
        clock: Function that returns the time on the clock [s].
        begin: Time on the clock at which point 0 is due.

    Args:
        pace: Simulated seconds per second.
        h: Communication step [s].
        doing: Current call, as in `Rows`.
        progress: Function that is called with the point during long waits; it may raise an exception to end the run.
    """

    def __init__(
        self,
        pace: float,
        steps: int,
        h: float,
        doing: MutableSequence[int],
        progress: Callable[[int], None] | None = None,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.pace, self.length, self.h = pace, h / pace, h
        self._doing, self._progress, self.clock, self._sleep = doing, progress, clock, sleep
        self._late = np.zeros(steps + 1, np.float32)  # lateness of each point [s]
        self._behind = np.zeros(steps + 1, np.bool_)  # True for points that the steps reached too late
        self.begin, self._points = 0.0, 0

    def wait(self, k: int) -> None:
        """Wait until point k is due, first asleep, then by polling the clock; the clock starts at point 0."""
        clock, doing = self.clock, self._doing
        now = clock()
        if k == 0:
            self.begin = now
        due = self.begin + k * self.length
        if now > due:
            self._behind[k] = True
        elif now < due:
            call, doing[0] = doing[0], WAITING
            while (rest := due - now - SPIN) > 0.0:
                self._sleep(min(rest, NAP))
                if rest > NAP and self._progress is not None:
                    self._progress(k)
                now = clock()
            while now < due:
                now = clock()
            doing[0] = call
        self._late[k] = now - due
        self._points = k + 1

    def record(self, start: float) -> dict[str, Any]:
        """Return overruns and jitter [s] for the manifest.

        Args:
            start: Simulated time of point 0 [s].
        """
        late, behind = self._late[1 : self._points].astype(float), self._behind[1 : self._points]
        if not late.size:
            return {"pace": self.pace, "points": 0, "overruns": {"count": 0}}
        overruns: dict[str, Any] = {"count": int(behind.sum())}
        if behind.any():
            places = np.flatnonzero(behind)
            worst, first = int(places[late[places].argmax()]), int(places[0])
            overruns |= {"worst": _rounded(late[worst]), "at": _rounded(start + (worst + 1) * self.h)}
            overruns |= {"first_at": _rounded(start + (first + 1) * self.h)}
            overruns["beyond_step"] = int((late[places] > self.length).sum())
        jitter = {name: _rounded(np.percentile(late, share)) for name, share in PERCENTILES.items()}
        return {
            "pace": self.pace,
            "points": int(late.size),
            "overruns": overruns,
            "jitter": jitter | {"max": _rounded(late.max())},
            "within_1_ms": float((late <= 1e-3).mean()),
            "behind_at_end": _rounded(late[-1]),
        }

    def notes(self, start: float) -> Sequence[str]:
        """Return a warning about late points."""
        record = self.record(start)
        overruns, count = record["overruns"], record["overruns"].get("beyond_step")
        if not count:
            return ()
        worst = f"at worst {1e3 * overruns['worst']:.3g} ms at t = {overruns['at']:.6g} s"
        return (
            f"{count} of {record['points']} communication points were more than a step behind the pace {self.pace:g}, "
            f"{worst}, and {1e3 * max(0.0, record['behind_at_end']):.3g} ms at the end",
        )


def _rounded(value: Any) -> float:
    return float(f"{value:.9g}")
