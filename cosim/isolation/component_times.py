"""Wall time of components and their calls, sampled by the caller of a worker.

At irregular times, some 200 a second, the caller reads which call is running and how many rows are complete, and counts
the time since the last reading for that call. The steps themselves cost nothing more. A share p from n readings has a
standard error of √(p·(1 − p)/n).

On a machine that gets busy, every step takes longer. A component counts as slower only by the factor by which its time
per step grows more than that of the rest of the run.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.isolation.rows import ADVANCE, CALLS, GET, OTHER, PUT, WAITING

SHORTEST, LONGEST = 0.003, 0.007  # [s] between readings
PERIOD = 0.5 * (SHORTEST + LONGEST)
BINS = 200  # equal parts of the rows
LEAST_PARTS = 5  # on each side of a change
MIN_FACTOR = 3.0  # of a component that gets slower
MIN_LOG_LIKELIHOOD_GAIN = 20.0  # of a change of its rate
MIN_EXTRA = 0.5  # [s] that a change costs
WARNING_FACTOR = 5.0  # of a warning during the run
WINDOW, BEFORE = 2.0, 0.1  # [s] of a component for a warning: wall time of the window, and its own time before that
DEVIATIONS = 2.0  # of the logarithm of the others' factor
EVEN = 2.0  # factor between components, below which the whole run gets slower
RUN = ""  # component of a `Slower` that means the whole run
NAMES = {PUT: "set", ADVANCE: "step", GET: "get", OTHER: "other"}


@dataclass(frozen=True)
class Slower:
    """A component, or the whole run, whose steps take longer from a time on.

    Attributes:
        component: Its name, `RUN` for the whole run.
        factor: Ratio of the times per step after and before; of a component relative to the rest of the run, if that
            gets slower too.
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
        given: Rows of a stopped run, whose repetition is not counted.
    """

    components: Sequence[str]
    rows: int
    at: Callable[[int], float]
    warn: Callable[[Slower], None] = lambda slower: None
    clock: Callable[[], float] = time.monotonic
    given: int = 0
    readings: int = 0  # whose time is counted
    rest: float = 0.0  # [s] between calls of components, as for a checkpoint
    waiting: float = 0.0  # [s] for the clock of a paced run, or for the end of a pause; not in `readings`
    _random: random.Random = field(default_factory=lambda: random.Random(0))

    def __post_init__(self) -> None:
        self._bins = np.zeros((max(1, min(BINS, self.rows)), len(self.components), CALLS))
        self._steps = np.zeros(len(self._bins))  # of controlled steps: those of each part
        self._stepped = 0
        self._reached = 0  # rows
        self._last = self.clock()
        self._begin(self._last, 0)
        self._warned = np.ones(len(self.components) + 1)  # factors of the last warnings; the last one: of the run
        self._rests = np.zeros(len(self._bins))  # `rest` by parts
        self._pending, self._done = np.zeros(len(self.components)), 0  # time of the step that is not over; steps

    def _begin(self, now: float, steps: int) -> None:
        """Start the measurement anew after some steps."""
        self._last, self._stepped = now, steps
        first = steps or self.given
        self._marks = [(now, first, np.zeros(len(self.components) + 1))]  # wall time, steps, time of each part
        self._rows_at = {first: self.given}  # steps → rows of marks

    def pause(self) -> float:
        """Return the irregular time [s] to the next reading."""
        return self._random.uniform(SHORTEST, LONGEST)

    def read(self, made: int, doing: int, steps: int = 0) -> None:
        """Count the elapsed time for the current call.

        Args:
            steps: Number of communication steps; 0 if they are the rows.
        """
        now = self.clock()
        if made < self.given:
            self._begin(now, steps)
            return
        elapsed, self._last = now - self._last, now
        number, call = divmod(doing, CALLS)
        self._reached = max(self._reached, made)
        self._steps[min(len(self._bins) - 1, self._bin(made))] += steps - self._stepped
        self._stepped = steps
        if (done := steps or made) != self._done:
            self._pending[:], self._done = 0.0, done
        if doing == WAITING:
            self.waiting += elapsed
        elif 0 <= number < len(self.components):
            self._pending[number] += elapsed if call < OTHER else 0.0
            self._bins[min(len(self._bins) - 1, self._bin(made)), number, call] += elapsed
            self.readings += 1
        elif made:  # Before the first row, the worker starts.
            self.rest += elapsed
            self._rests[min(len(self._bins) - 1, self._bin(made))] += elapsed
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
        waiting = {"waiting": round(self.waiting, 4)} if self.waiting else {}
        rest = {"rest": round(self.rest, 4), **waiting}
        return {"components": components, **rest, "readings": self.readings, "slower": slower}

    def slower(self) -> list[Slower]:
        """Return components that get slower than the rest, by extra time; otherwise the run, if it does."""
        first, reached = self._bin(self.given), self._bin(self._reached)
        if reached <= first:  # of a resumed run that ends before it goes on
            return []
        steps = self._steps[first:reached] if self._stepped else np.ones(reached - first)
        parts = np.column_stack([self._bins[first:reached, :, :OTHER].sum(axis=2), self._rests[first:reached]])
        found = []
        for k, name in enumerate(self.components):
            if (change := _change(parts[:, k], steps)) is None:
                continue
            part, factor, extra = change
            before, after = parts[:part].sum(axis=0), parts[part:].sum(axis=0)
            own = _relative(before, after, steps[part:].sum() / max(1.0, steps[:part].sum()))[k]
            extra *= (own - 1.0) / (factor - 1.0)
            if own >= MIN_FACTOR and extra >= MIN_EXTRA:
                found.append((extra, Slower(name, float(own), self._time_of(part))))
        if not found and (change := _change(parts.sum(axis=1), steps)) is not None:
            part, factor, extra = change
            before, after = parts[:part].sum(axis=0), parts[part:].sum(axis=0)
            if _is_even(before, after):
                found.append((extra, Slower(RUN, factor, self._time_of(part))))
        return [slower for _, slower in sorted(found, key=lambda pair: -pair[0])]

    def _time_of(self, part: int) -> float:
        """Return the simulated time [s] of a part's start."""
        return self.at(-(-(self._bin(self.given) + part) * self.rows // len(self._bins)))

    def _bin(self, made: int) -> int:
        """Return the part that contains a row."""
        return made * len(self._bins) // max(1, self.rows)

    def _mark(self, now: float, made: int, steps: int) -> None:
        """Warn of components with much slower steps.

        A step that is not over does not count: a hang, or a machine that does not answer, is no slow step.
        """
        own = np.append(self._bins[:, :, :OTHER].sum(axis=(0, 2)) - self._pending, self.rest)
        self._marks.append((now, steps, own))
        self._rows_at[steps] = made
        begin = next((m for m in reversed(self._marks) if now - m[0] >= WINDOW), None)
        if begin is None or begin[1] - self._marks[0][1] < 2:
            return
        before, after = begin[2], own - begin[2]
        longer = max(1, steps - begin[1]) / (begin[1] - self._marks[0][1])
        factors = _relative(before, after, longer)
        is_run = before.sum() and not (self._warned[:-1] > 1.0).any() and _is_even(before, after)
        factors[-1] = after.sum() / before.sum() / longer if is_run else 1.0
        for k, name in enumerate((*self.components, RUN)):
            is_known = k == len(self.components) or before[k] >= BEFORE
            if is_known and factors[k] >= WARNING_FACTOR * self._warned[k]:
                self._warned[k] = factors[k]
                self.warn(Slower(name, float(factors[k]), self.at(self._rows_at[begin[1]])))


def _relative(before: Array, after: Array, longer: float) -> Array:
    """Return the factor of each part's time per step, divided by that of all others if these get slower.

    The others get slower if the confidence interval of their factor is above 1.

    Args:
        before: Times [s] of the parts, `after` those of later steps.
        longer: Ratio of the numbers of steps after and before.
    """
    own = np.maximum(after, 0.0) / np.maximum(before, PERIOD) / longer
    others_before, others_after = before.sum() - before, after.sum() - after
    n, m = np.maximum(others_before / PERIOD, 1.0), np.maximum(others_after / PERIOD, 1.0)
    others = m / n / longer
    is_slower = (others_before >= BEFORE) & (np.log(others) > DEVIATIONS * np.sqrt(1.0 / n + 1.0 / m))
    result: Array = own / np.where(is_slower, others, 1.0)
    return result


def _is_even(before: Array, after: Array) -> bool:
    """Return whether several parts took enough time to be compared, and all got slower alike."""
    known = before >= BEFORE
    factors = after[known] / before[known]
    return int(known.sum()) > 1 and bool(factors.max() < EVEN * factors.min())


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
