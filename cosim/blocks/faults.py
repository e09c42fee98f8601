"""Faults injected into a connection: what becomes of its values between two times."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Through = Callable[[int, Any], Any]  # communication point and value → value
MOST = 1e18  # steps, which nobody takes


def disturbed(
    kind: str,
    window: tuple[int, int],
    count: int,
    rng: np.random.Generator,
    *,
    value: float | None = None,
    probability: float | None = None,
    delay: int = 0,
) -> Through:
    """What a fault makes of the value at each communication point; outside `window` (first, last) nothing.

    count: communication points of the run
    delay: communication points
    """
    first, last = window
    given = 0.0 if value is None else value
    if kind in {"bias", "scale", "stuck"}:
        act: dict[str, Callable[[Any], Any]] = {
            "bias": lambda v: v + given,
            "scale": lambda v: v * given,
            "stuck": lambda v: given,
        }
        acting = act[kind]
        return lambda k, v: acting(v) if first <= k <= last else v
    if kind == "spike":
        hit = np.zeros(count, bool) if probability is None else rng.random(count) < probability
        if probability is None:
            hit[min(first, count - 1)] = True
        spikes = hit.tolist()
        return lambda k, v: v + given if first <= k <= last and spikes[k] else v
    if kind == "delay":
        return _delayed(first, last, delay)
    lost = (rng.random(count) < probability).tolist() if probability is not None else [True] * count
    return _held(first, last, lost)


def _held(first: int, last: int, lost: list[bool]) -> Through:
    """The last value that came, while samples are lost."""
    kept: list[Any] = [None]

    def through(k: int, v: Any) -> Any:
        if k == 0 or not (first <= k <= last and lost[k]):
            kept[0] = v
        return kept[0]

    return through


def _delayed(first: int, last: int, delay: int) -> Through:
    """What came `delay` communication points before; the first value where nothing had come then."""
    past: dict[int, Any] = {}

    def through(k: int, v: Any) -> Any:
        past[k] = v
        past.pop(k - delay - 1, None)
        return past.get(k - delay, past[min(past)]) if first <= k <= last else v

    return through


def points(begin: float | None, end: float | None, start: float, step: float, count: int) -> tuple[int, int]:
    """First and last communication point from one time to another [s]."""
    first = 0 if begin is None else math.ceil(steps_in(begin - start, step) - 1e-9)
    last = count - 1 if end is None else math.floor(steps_in(end - start, step) + 1e-9)
    return first, last


def steps_in(time: float, step: float) -> float:
    """Steps in a time; very many where they are beyond a double."""
    return min(max(time / step, -MOST), MOST)
