"""Noise of a connection, and faults injected into it during an interval."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.blocks.stepping import ConvertedLink, LinkKind, address_of
from cosim.core.times import first_point, last_point

AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS = LinkKind


@dataclass(eq=False)
class LinkFunction:
    """A function of (communication point, value) with an equivalent in C; called at each point in turn.

    Attributes:
        kind: Effect on a value; further attributes have the names of the fields of `ConvertedLink`.
        window: First and last point at which the effect acts; elsewhere values pass unchanged.
        past: Ring of previous values, one longer than the delay in points; of HELD the last received value. The loop in
            C goes on with it.
        check: Function of (point, value) that raises an error of a value that is no item.
    """

    kind: LinkKind
    window: tuple[int, int] = (0, 0)
    a: float = 0.0
    b: float = 0.0
    values: Any = None
    marks: bytearray | None = None
    past: Any = None
    check: Callable[[int, Any], None] | None = None

    def __call__(self, k: int, v: Any) -> Any:
        """Return the value at point k."""
        kind = self.kind
        if self.check is not None:
            self.check(k, v)
            return v
        if kind is AFFINE:
            return v * self.a + self.b
        if kind is ADDED:
            return v + self.values[k]
        acts = self.window[0] <= k <= self.window[1] and (self.marks is None or bool(self.marks[k]))
        if kind is HELD:
            if k == 0 or not acts:
                self.past[0] = v
            return self.past[0]
        if kind is DELAYED:  # at first the first value
            count = len(self.past)
            self.past[k % count] = v
            return self.past[0 if k < count else (k + 1) % count] if acts else v
        if not acts:
            return v
        if kind is SCALE:
            return v * self.a
        return self.a if kind is STUCK else v + self.a

    def link(self) -> ConvertedLink:
        """Return the equivalent for the loop in C, which continues from the last point."""
        if isinstance(self.past, list):
            self.past = array("d", self.past)
        buffers = self.values, self.marks, self.past
        count = len(self.past or self.values or ())
        result = ConvertedLink(self.kind, *self.window, self.a, self.b, *map(address_of, buffers), count)
        result.keeping = buffers
        return result

    def save(self) -> Any:
        """Return the past values that later points need; None without one."""
        return None if self.past is None else [*self.past]

    def restore(self, memory: Any) -> None:
        """Restore saved values."""
        if memory is not None:
            self.past[:] = memory


def fault_function(
    kind: str,
    window: tuple[int, int],
    count: int,
    rng: np.random.Generator,
    *,
    value: float | None = None,
    probability: float | None = None,
    delay: int = 0,
) -> LinkFunction:
    """Return the function of a fault on a connection.

    Outside `window` (first and last point) values pass unchanged.

    Args:
        count: Number of communication points of the run.
        delay: Delay in communication points.
    """
    if kind in {"bias", "scale", "stuck"}:
        return LinkFunction(LinkKind[kind.upper()], window, a=value or 0.0)
    if kind == "delay":
        return LinkFunction(DELAYED, window, past=[0.0] * (min(delay, count) + 1))
    if probability is not None:
        marks = rng.random(count) < probability
    elif kind == "spike":
        marks = np.arange(count) == min(window[0], count - 1)
    else:
        marks = np.ones(count, bool)
    effect, past = (SPIKES, None) if kind == "spike" else (HELD, [0.0])
    return LinkFunction(effect, window, a=value or 0.0, marks=bytearray(marks.tobytes()), past=past)


def points(begin: float | None, end: float | None, start: float, step: float, count: int) -> tuple[int, int]:
    """Return the first and last communication point in an interval [s]."""
    first = 0 if begin is None else first_point(begin, start, step)
    last = count - 1 if end is None else last_point(end, start, step)
    return first, last


def stream(seed: int, name: str) -> np.random.Generator:
    """Return an independent random stream for a noise source. Adding a source does not change the streams of others."""
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return np.random.default_rng([seed, key])


def gaussian(rng: np.random.Generator, variance: float, bias: float, count: int) -> array[float]:
    """Return samples of bias + √variance·n in the signal's unit. n is standard normal."""
    return array("d", (bias + np.sqrt(variance) * rng.standard_normal(count)).tobytes())
