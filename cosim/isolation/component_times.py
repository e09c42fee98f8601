"""Wall time of components and their calls, sampled by the caller of a worker.

At irregular times, some 200 a second, the caller reads which call is running and how many rows are complete, and counts
the time since the last reading for that call. The steps themselves cost nothing more. A share p from n readings has a
standard error of √(p·(1 − p)/n).
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.isolation.rows import ADVANCE, CALLS, GET, OTHER, PUT

SHORTEST, LONGEST = 0.003, 0.007  # [s] between readings
PERIOD = 0.5 * (SHORTEST + LONGEST)
BINS = 200  # equal parts of the rows
LEAST_PARTS = 5  # on each side of a change
MIN_FACTOR = 3.0  # of a component that gets slower
MIN_LOG_LIKELIHOOD_GAIN = 20.0  # of a change of its rate
MIN_EXTRA = 0.5  # [s] that a change costs
WARNING_FACTOR = 5.0  # of a warning during the run
WINDOW, BEFORE = 2.0, 0.1  # [s] of a component for a warning: wall time of the window, and its own time before that
NAMES = {PUT: "set", ADVANCE: "step", GET: "get", OTHER: "other"}


@dataclass(frozen=True)
class Slower:
    """A component whose steps take longer from a time on.

    Attributes:
        factor: Ratio of the times per step after and before.
        since: Simulated time [s].
    """

    component: str
    factor: float
    since: float


@dataclass
class ComponentTimes:
    """Sampled times of a run.

    Attributes:
        rows: Number of rows of the whole run.
        at: Function from rows to simulated time [s].
        warn: Function called when a component gets much slower.
        clock: Wall clock [s].
    """

    components: Sequence[str]
    rows: int
    at: Callable[[int], float]
    warn: Callable[[Slower], None] = lambda slower: None
    clock: Callable[[], float] = time.monotonic
    readings: int = 0  # whose time is counted
    rest: float = 0.0  # [s] between calls of components, as for a checkpoint
    _random: random.Random = field(default_factory=lambda: random.Random(0))

    def __post_init__(self) -> None:
        self._bins = np.zeros((max(1, min(BINS, self.rows)), len(self.components), CALLS))
        self._steps = np.zeros(len(self._bins))  # of controlled steps: those of each part
        self._stepped = 0
        self._reached = 0  # rows
        self._last = self.clock()
        self._marks = [(self._last, 0, np.zeros(len(self.components)))]  # wall time, steps, time of each component
        self._rows_at = {0: 0}  # steps → rows of marks
        self._warned = np.ones(len(self.components))  # factors of the last warnings

    def pause(self) -> float:
        """Return the irregular time [s] to the next reading."""
        return self._random.uniform(SHORTEST, LONGEST)

    def read(self, made: int, doing: int, steps: int = 0) -> None:
        """Count the elapsed time for the current call.

        Args:
            steps: Number of communication steps; 0 if they are the rows.
        """
        now = self.clock()
        elapsed, self._last = now - self._last, now
        number, call = divmod(doing, CALLS)
        self._reached = max(self._reached, made)
        self._steps[min(len(self._bins) - 1, self._bin(made))] += steps - self._stepped
        self._stepped = steps
        if 0 <= number < len(self.components):
            self._bins[min(len(self._bins) - 1, self._bin(made)), number, call] += elapsed
            self.readings += 1
        elif made:  # Before the first row, the worker starts.
            self.rest += elapsed
            self.readings += 1
        if now - self._marks[-1][0] >= 0.5 * WINDOW:
            self._mark(now, made, steps or made)

    def record(self) -> dict[str, Any]:
        """Return the times for a manifest [s]."""
        total = self._bins.sum(axis=0)
        whole = float(total.sum()) + self.rest
        order = sorted(range(len(self.components)), key=lambda k: -total[k].sum())
        components = {}
        for k in order:
            calls = {name: round(float(total[k, call]), 4) for call, name in NAMES.items()}
            components[self.components[k]] = {"share": round(float(total[k].sum()) / max(whole, 1e-9), 4), **calls}
        slower = [{"component": s.component, "factor": round(s.factor, 2), "since": s.since} for s in self.slower()]
        return {"components": components, "rest": round(self.rest, 4), "readings": self.readings, "slower": slower}

    def slower(self) -> list[Slower]:
        """Return components that get slower, by extra time."""
        reached = self._bin(self._reached)
        found = []
        for k, name in enumerate(self.components):
            steps = self._steps[:reached] if self._stepped else np.ones(reached)
            change = _change(self._bins[:reached, k, :OTHER].sum(axis=1), steps)
            if change is not None:
                part, factor, extra = change
                found.append((extra, Slower(name, factor, self.at(-(-part * self.rows // len(self._bins))))))
        return [slower for _, slower in sorted(found, key=lambda pair: -pair[0])]

    def _bin(self, made: int) -> int:
        """Return the part that contains a row."""
        return made * len(self._bins) // max(1, self.rows)

    def _mark(self, now: float, made: int, steps: int) -> None:
        """Warn of components that have become much slower for a step."""
        own = self._bins[:, :, :OTHER].sum(axis=(0, 2))
        self._marks.append((now, steps, own))
        self._rows_at[steps] = made
        begin = next((m for m in reversed(self._marks) if now - m[0] >= WINDOW), None)
        if begin is None or begin[1] < 2:
            return
        before = begin[2] / begin[1]
        after = (own - begin[2]) / max(1, steps - begin[1])
        for k, name in enumerate(self.components):
            if begin[2][k] < BEFORE:
                continue
            factor = after[k] / before[k]
            if factor >= WARNING_FACTOR * self._warned[k]:
                self._warned[k] = factor
                self.warn(Slower(name, float(factor), self.at(self._rows_at[begin[1]])))


def _change(seconds: Array, steps: Array) -> tuple[int, float, float] | None:
    """Return part, factor and extra time [s] of a rise of the time per step.

    The readings of a part are counts of a Poisson process. The change has the largest likelihood; medians on both sides
    keep single interruptions from being changes.
    """
    count = len(seconds)
    if count < 2 * LEAST_PARTS or not seconds.sum() or not steps.sum():
        return None
    parts = np.arange(LEAST_PARTS, count - LEAST_PARTS + 1)
    first = np.maximum(np.cumsum(steps)[parts - 1], 1.0)
    last = np.maximum(steps.sum() - first, 1.0)
    before = np.maximum(np.cumsum(seconds)[parts - 1], PERIOD) / first
    after = np.maximum(seconds.sum() - np.cumsum(seconds)[parts - 1], PERIOD) / last
    pooled = seconds.sum() / steps.sum()
    gains = (first * before * np.log(before / pooled) + last * after * np.log(after / pooled)) / PERIOD
    best = int(np.argmax(gains))
    part, factor, extra = int(parts[best]), after[best] / before[best], (after - before)[best] * last[best]
    each = seconds / np.maximum(steps, 1.0)
    low, high = np.median(each[:part]), np.median(each[part:])
    is_change = gains[best] >= MIN_LOG_LIKELIHOOD_GAIN and factor >= MIN_FACTOR and extra >= MIN_EXTRA
    return (part, float(factor), float(extra)) if is_change and high > 0.0 and high >= MIN_FACTOR * low else None
