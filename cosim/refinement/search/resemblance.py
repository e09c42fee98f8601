"""Simple laws that the local shape of an unnamed term resembles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import orthonormal
from cosim.refinement.search.shapes import SLIP, Shape, Signals

LIKE = 0.9  # share of a shape's variance beside a straight line that a law explains
WIDTHS = np.geomspace(0.02, 0.5, 12)  # half widths of free play, as shares of half the signal's range


def law_of(terms: Sequence[tuple[Shape, Sequence[float]]], signals: Signals, *, is_rate: bool) -> str:
    """Return the laws that local shapes over one signal resemble together, in words; "" for none.

    Laws are compared as far as the shapes can follow them, which takes a spline. A straight line is no law of its own,
    since parameters of the model take its place.

    Args:
        terms: Shapes with their coefficients.
        is_rate: True if the signal is a velocity.
    """
    shapes = [shape for shape, _ in terms]
    if any(shape.times or shape.turned for shape in shapes) or all(shape.kind != "spline" for shape in shapes):
        return ""
    z, columns = shapes[0].positions(signals), np.hstack([shape.columns(signals) for shape in shapes])
    line, space = (orthonormal(np.column_stack(parts)) for parts in ([np.ones_like(z), z], [*columns.T]))

    def beside_line(column: Array) -> Array:
        return np.asarray(column - line @ (line.T @ column))

    rest = beside_line(columns @ np.concatenate([sizes for _, sizes in terms]))
    power = float(rest @ rest)
    shares: dict[str, float] = {}
    for name, column in _laws(z, is_rate=is_rate):
        law = beside_line(space @ (space.T @ column))
        size = float(law @ law)
        shares[name] = max(shares.get(name, 0.0), float(law @ rest) ** 2 / size / power if size * power > 0.0 else 0.0)
    return " or ".join(name for name in sorted(shares, key=lambda name: -shares[name]) if shares[name] >= LIKE)


def _laws(z: Array, *, is_rate: bool) -> Iterator[tuple[str, Array]]:
    """Yield laws over a signal: words, and values."""
    low, high = np.percentile(z, (0.5, 99.5))
    half = 0.5 * float(high - low) or 1.0
    sign = np.tanh(z / (SLIP * half))
    if is_rate:
        yield "dry friction", sign
        yield "drag with the square of the speed", z * np.abs(z)
        yield "friction with the cube of the speed", z**3
        return
    yield "a preload", sign
    yield "a spring with the cube of the deflection", z**3
    for share in WIDTHS:
        yield "free play", np.clip(z, -share * half, share * half)
