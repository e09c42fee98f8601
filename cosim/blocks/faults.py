"""Noise of a connection, and faults injected into a connection during an interval."""

from __future__ import annotations

import hashlib
from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cosim.blocks.stepping import ConvertedLink, LinkKind, address_of
from cosim.core.times import first_point, last_point

AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS = LinkKind


@dataclass(eq=False)
class LinkFunction:
    """A function of (communication point, value) that changes values of a connection, with an equivalent in C.

    Attributes:
        kind: Effect on a value. Attributes not listed here are fields of `ConvertedLink`.
        window: First and last communication point with the effect; at other points, values are unchanged.
        delay: Delay in communication points.
    """

    kind: LinkKind
    window: tuple[int, int] = (0, 0)
    a: float = 0.0
    b: float = 0.0
    values: Any = None
    marks: bytearray | None = None
    delay: int = 0
    _past: dict[int, Any] = field(default_factory=dict)  # point → value; for HELD, the last received value at key 0
    _in_c: array[float] | None = None

    def __call__(self, k: int, v: Any) -> Any:
        """Return the changed value at communication point k; points must be in order."""
        kind = self.kind
        if kind is AFFINE:
            return v * self.a + self.b
        if kind is ADDED:
            return v + self.values[k]
        acts = self.window[0] <= k <= self.window[1] and (self.marks is None or bool(self.marks[k]))
        if kind is HELD:
            if k == 0 or not acts:
                self._past[0] = v
            return self._past[0]
        if kind is DELAYED:  # before the first delayed value, use the first value
            self._past[k] = v
            self._past.pop(k - self.delay - 1, None)
            return self._past.get(k - self.delay, self._past[min(self._past)]) if acts else v
        if not acts:
            return v
        if kind is SCALE:
            return v * self.a
        return self.a if kind is STUCK else v + self.a

    def link(self) -> ConvertedLink:
        """Return the equivalent for the C loop, which continues after the last point."""
        count = 0 if self.values is None else len(self.values)
        if self.kind is HELD:
            self._in_c = array("d", [self._past[0]])
        elif self.kind is DELAYED:
            self._in_c, count = array("d", bytes(8 * (self.delay + 1))), self.delay + 1
            for k, value in self._past.items():
                self._in_c[k % count] = value
        buffers = self.values, self.marks, self._in_c
        result = ConvertedLink(self.kind, *self.window, self.a, self.b, *map(address_of, buffers), count)
        result.keeping = buffers
        return result

    def save(self, k: int) -> Any:
        """Return the past values on which later points depend, as of point k; None if there are none."""
        ring = self._in_c
        if self.kind is HELD:
            return self._past[0] if ring is None else ring[0]
        if self.kind != DELAYED:
            return None
        if ring is None:
            return [*self._past.items()]
        return [(j, ring[j % len(ring)]) for j in range(max(0, k - self.delay), k + 1)]

    def restore(self, memory: Any) -> None:
        """Restore the values that `save` returned."""
        if memory is not None:
            self._past = {0: memory} if self.kind is HELD else dict(memory)


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

    Outside `window` (first and last communication point), values are unchanged.

    Args:
        count: Number of communication points of the run.
        delay: Delay in communication points.
    """
    if kind in {"bias", "scale", "stuck"}:
        return LinkFunction(LinkKind[kind.upper()], window, a=value or 0.0)
    if kind == "delay":
        return LinkFunction(DELAYED, window, delay=min(delay, count))
    if probability is not None:
        marks = rng.random(count) < probability
    elif kind == "spike":
        marks = np.arange(count) == min(window[0], count - 1)
    else:
        marks = np.ones(count, bool)
    effect = SPIKES if kind == "spike" else HELD
    return LinkFunction(effect, window, a=value or 0.0, marks=bytearray(marks.tobytes()))


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
    """Return `count` samples bias + √variance·n in the signal's unit, with standard normal n."""
    return array("d", (bias + np.sqrt(variance) * rng.standard_normal(count)).tobytes())
