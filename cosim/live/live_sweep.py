"""Live page of a sweep: finished runs and the criteria so far."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from cosim.live.live_page import LivePage
from cosim.sweeps.run_statistics import share_interval
from cosim.sweeps.runs import RunResult
from cosim.sweeps.workflow import CriterionLimit, RunsObserver

BINS = 24  # of a histogram
MAX_FAILURES = 5  # reasons on the page


class LiveSweep(LivePage, RunsObserver):
    """An observer of a sweep's runs that shows them on a page."""

    activity = "sweep"

    def __init__(self, title: str, port: int = 0) -> None:
        self._limits: Sequence[CriterionLimit] = ()
        self._total = self._done = self._failed = self._earlier = 0
        self._values: list[list[float]] = []
        self._met: list[int] = []
        self._failures: dict[str, int] = {}
        self._since = 0.0
        super().__init__(title, port)

    def begin(self, title: str, count: int, limits: Sequence[CriterionLimit], earlier: Iterable[RunResult]) -> None:
        """Prepare for the runs of a sweep, some of which an earlier call has made."""
        self._limits, self._total, self._since = limits, count, time.monotonic()
        self._values, self._met = [[] for _ in limits], [0 for _ in limits]
        self.add([*earlier])
        self._earlier = self._done
        self.update(phase="running", title=title)

    def add(self, results: Sequence[RunResult]) -> None:
        """Count finished runs."""
        with self._lock:
            for result in results:
                self._done += 1
                if result.status != "ok":
                    self._failed += 1
                    reason = str(result.status)
                    self._failures[reason] = self._failures.get(reason, 0) + 1
                    continue
                for k, (value, met) in enumerate(zip(result.values, result.met, strict=True)):
                    self._values[k].append(value)
                    self._met[k] += met
        self.update()

    def state(self) -> dict[str, Any]:
        """Return the whole state."""
        state = super().state()
        with self._lock:
            made, passed = self._done - self._earlier, time.monotonic() - self._since
            rate = made / passed if made and not self.has_ended else None
            return {
                **state,
                "done": self._done,
                "total": self._total,
                "failed": self._failed,
                "rate": rate,
                "remaining": (self._total - self._done) / rate if rate else None,
                "criteria": [self._criterion(k) for k in range(len(self._limits))],
                "failures": [{"why": why, "count": n} for why, n in [*self._failures.items()][:MAX_FAILURES]],
            }

    def _criterion(self, k: int) -> dict[str, Any]:
        """Return the share of runs that meet a criterion, with its interval, and the histogram of its values."""
        limit, of = self._limits[k], self._done - self._failed
        low, high = share_interval(self._met[k], of)
        values = np.array(self._values[k])
        values = values[np.isfinite(values)]
        about = {"name": limit.name, "max": limit.max, "unit": limit.unit, "met": self._met[k], "of": of}
        about |= {"low": low, "high": high, "undefined": of - values.size}
        if not values.size:
            return {**about, "counts": [], "ends": [0.0, limit.max]}
        least, most = min(limit.max, float(values.min())), max(limit.max, float(np.quantile(values, 0.98)))
        margin = 0.05 * (most - least) or 1.0
        ends = least - margin, most + margin
        counts, _ = np.histogram(np.clip(values, *ends), BINS, ends)
        return {**about, "counts": counts.tolist(), "ends": [*ends]}
