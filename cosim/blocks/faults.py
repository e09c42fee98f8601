"""Noise of a connection, and faults injected into it during an interval."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.base.times import first_point, last_point
from cosim.blocks.stepping import ConvertedLink, LinkKind, link


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
        return WindowFault(kind, window, value or 0.0)
    if kind == "delay":
        return Delay(window, min(delay, count))
    if probability is not None:
        marks = rng.random(count) < probability
    elif kind == "spike":
        marks = np.arange(count) == min(window[0], count - 1)
    else:
        marks = np.ones(count, bool)
    if kind == "spike":
        return Spikes(window, value or 0.0, bytearray(marks.tobytes()))
    return Hold(window, bytearray(marks.tobytes()))


class LinkFunction(Protocol):
    """A function of (communication point, value), with an equivalent in C; called at each point in turn."""

    def __call__(self, k: int, v: Any) -> Any:
        """Return the value at point k."""

    def link(self) -> ConvertedLink:
        """Return the equivalent of this fault for the loop in C, which continues from the last point."""


@dataclass(frozen=True)
class Scaling:
    """Conversion of a value v to v·factor + offset."""

    factor: float
    offset: float

    def __call__(self, k: int, v: Any) -> Any:
        return v * self.factor + self.offset

    def link(self) -> ConvertedLink:
        return link(LinkKind.AFFINE, a=self.factor, b=self.offset)


@dataclass(frozen=True)
class Addition:
    """Addition of a sample to a value: v + samples[k] at point k."""

    samples: array[float]

    def __call__(self, k: int, v: Any) -> Any:
        return v + self.samples[k]

    def link(self) -> ConvertedLink:
        return link(LinkKind.ADDED, values=self.samples)


class WindowFault:
    """A bias, a scale or a constant in a window of communication points."""

    def __init__(self, kind: str, window: tuple[int, int], value: float) -> None:
        effects: dict[str, tuple[LinkKind, Callable[[Any], Any]]] = {
            "bias": (LinkKind.BIAS, lambda v: v + value),
            "scale": (LinkKind.SCALE, lambda v: v * value),
            "stuck": (LinkKind.STUCK, lambda v: value),
        }
        self.kind, self._effect = effects[kind]
        self.window, self.value = window, value

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        return self._effect(v) if first <= k <= last else v

    def link(self) -> ConvertedLink:
        return link(self.kind, self.window, a=self.value)


class Spikes:
    """Spikes on a value: v + value at each point k with marks[k]."""

    def __init__(self, window: tuple[int, int], value: float, marks: bytearray) -> None:
        self.window, self.value, self.marks = window, value, marks

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        return v + self.value if first <= k <= last and self.marks[k] else v

    def link(self) -> ConvertedLink:
        return link(LinkKind.SPIKES, self.window, a=self.value, marks=self.marks)


class Hold:
    """The last received value while samples are lost."""

    def __init__(self, window: tuple[int, int], marks: bytearray) -> None:
        self.window, self.marks = window, marks
        self._value: Any = None
        self._in_c: array[float] | None = None

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        if k == 0 or not (first <= k <= last and self.marks[k]):
            self._value = v
        return self._value

    def link(self) -> ConvertedLink:
        self._in_c = array("d", [self._value])
        return link(LinkKind.HELD, self.window, marks=self.marks, past=self._in_c)

    def save(self, k: int) -> Any:
        return self._value if self._in_c is None else self._in_c[0]

    def restore(self, memory: Any) -> None:
        self._value = memory


class Delay:
    """The value from `delay` communication points before, at first the first value."""

    def __init__(self, window: tuple[int, int], delay: int) -> None:
        self.window, self.delay = window, delay
        self._past: dict[int, Any] = {}
        self._in_c: array[float] | None = None

    def __call__(self, k: int, v: Any) -> Any:
        first, last = self.window
        past, delay = self._past, self.delay
        past[k] = v
        past.pop(k - delay - 1, None)
        return past.get(k - delay, past[min(past)]) if first <= k <= last else v

    def link(self) -> ConvertedLink:
        self._in_c = ring = array("d", bytes(8 * (self.delay + 1)))
        for k, value in self._past.items():
            ring[k % len(ring)] = value
        return link(LinkKind.DELAYED, self.window, past=ring, count=len(ring))

    def save(self, k: int) -> Any:
        if (ring := self._in_c) is None:
            return [*self._past.items()]
        return [(j, ring[j % len(ring)]) for j in range(max(0, k - self.delay), k + 1)]

    def restore(self, memory: Any) -> None:
        self._past = dict(memory)


def points(begin: float | None, end: float | None, start: float, step: float, count: int) -> tuple[int, int]:
    """Return the first and last communication point in an interval [s]."""
    first = 0 if begin is None else first_point(begin, start, step)
    last = count - 1 if end is None else last_point(end, start, step)
    return first, last


def stream(seed: int, name: str) -> np.random.Generator:
    """Return an independent random stream for a noise source. Adding a source does not change the streams of others."""
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    return np.random.default_rng([seed, key])


def samples_of(rng: np.random.Generator, variance: float, bias: float, count: int) -> Array:
    """Return samples of bias + √variance·n in the signal's unit. n is standard normal."""
    samples: Array = bias + np.sqrt(variance) * rng.standard_normal(count)
    return samples


def gaussian(rng: np.random.Generator, variance: float, bias: float, count: int) -> array[float]:
    """Return the samples of `samples_of` for loops over single values."""
    return array("d", samples_of(rng, variance, bias, count).tobytes())
