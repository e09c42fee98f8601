"""Faults injected into a connection during an interval."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from cosim.blocks.stepping import Does, Link, link

MOST = 1e18  # steps, more than any run has


def disturbed(
    kind: str,
    window: tuple[int, int],
    count: int,
    rng: np.random.Generator,
    *,
    value: float | None = None,
    probability: float | None = None,
    delay: int = 0,
) -> Linked:
    """Return the function of a fault on a connection.

    Outside `window` (first and last point) values pass unchanged.

    Args:
        count: Number of communication points of the run.
        delay: Delay in communication points.
    """
    first, _last = window
    given = 0.0 if value is None else value
    if kind in {"bias", "scale", "stuck"}:
        return Within(kind, window, given)
    if kind == "spike":
        hit = np.zeros(count, bool) if probability is None else rng.random(count) < probability
        if probability is None:
            hit[min(first, count - 1)] = True
        return Spikes(window, given, bytearray(hit.tobytes()))
    if kind == "delay":
        return Delayed(window, min(delay, count))
    lost = rng.random(count) < probability if probability is not None else np.ones(count, bool)
    return Held(window, bytearray(lost.tobytes()))


class Linked(Protocol):
    """A function of (communication point, value), with an equivalent in C; called at each point in turn."""

    def __call__(self, k: int, v: Any) -> Any:
        """Return the value at point k."""

    def link(self) -> Link:
        """Return the C equivalent, continuing from the last point."""


class Scaled:
    """v·factor + offset."""

    def __init__(self, factor: float, offset: float) -> None:
        self.factor, self.offset = factor, offset

    def __call__(self, k: int, v: Any) -> Any:
        return v * self.factor + self.offset

    def link(self) -> Link:
        return link(Does.AFFINE, a=self.factor, b=self.offset)


class Added:
    """v + samples[k]."""

    def __init__(self, samples: array[float]) -> None:
        self.samples = samples

    def __call__(self, k: int, v: Any) -> Any:
        return v + self.samples[k]

    def link(self) -> Link:
        return link(Does.ADDED, values=self.samples)


class Within:
    """A bias, a scale or a constant between two points."""

    def __init__(self, kind: str, window: tuple[int, int], value: float) -> None:
        act: dict[str, tuple[Does, Callable[[Any], Any]]] = {
            "bias": (Does.BIAS, lambda v: v + value),
            "scale": (Does.SCALE, lambda v: v * value),
            "stuck": (Does.STUCK, lambda v: value),
        }
        self.kind, self._act = act[kind]
        self.window, self.value = window, value

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        return self._act(v) if first <= k <= last else v

    def link(self) -> Link:
        return link(self.kind, self.window, a=self.value)


class Spikes:
    """v + value where hit[k]."""

    def __init__(self, window: tuple[int, int], value: float, hit: bytearray) -> None:
        self.window, self.value, self.hit = window, value, hit

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        return v + self.value if first <= k <= last and self.hit[k] else v

    def link(self) -> Link:
        return link(Does.SPIKES, self.window, a=self.value, marks=self.hit)


class Held:
    """The last received value while samples are lost."""

    def __init__(self, window: tuple[int, int], lost: bytearray) -> None:
        self.window, self.lost = window, lost
        self._kept: Any = None

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        if k == 0 or not (first <= k <= last and self.lost[k]):
            self._kept = v
        return self._kept

    def link(self) -> Link:
        return link(Does.HELD, self.window, marks=self.lost, kept=array("d", [self._kept]))


class Delayed:
    """The value from `delay` communication points before, at first the first value."""

    def __init__(self, window: tuple[int, int], delay: int) -> None:
        self.window, self.delay = window, delay
        self._past: dict[int, Any] = {}

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        past, delay = self._past, self.delay
        past[k] = v
        past.pop(k - delay - 1, None)
        return past.get(k - delay, past[min(past)]) if first <= k <= last else v

    def link(self) -> Link:
        ring = array("d", [self._past[0], *[0.0] * self.delay])
        return link(Does.DELAYED, self.window, kept=ring, count=len(ring))


def points(begin: float | None, end: float | None, start: float, step: float, count: int) -> tuple[int, int]:
    """Return the first and last communication point in an interval [s]."""
    first = 0 if begin is None else math.ceil(steps_in(begin - start, step) - 1e-9)
    last = count - 1 if end is None else math.floor(steps_in(end - start, step) + 1e-9)
    return first, last


def whole(time: float, step: float) -> int:
    """Return a time as the nearest positive number of steps."""
    return max(1, round(steps_in(time, step)))


def steps_in(time: float, step: float) -> float:
    """Return a time in steps, within a large bound."""
    return min(max(time / step, -MOST), MOST)
