"""Simple laws that the local shape of an unnamed term resembles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import orthonormal
from cosim.estimation.kernel.nameless import KNOTS
from cosim.refinement.decision.posterior import LITTLE
from cosim.refinement.search.shapes import Shape, Signals, values_of


def law_of(terms: Sequence[tuple[Shape, Sequence[float]]], signals: Signals, *, is_rate: bool) -> str:
    """Return the laws that local shapes over one signal resemble together, in words; "" for none.

    Laws are compared as far as the shapes can follow them, which takes a spline. A straight line is no law of its own,
    since parameters of the model take its place.

    Args:
        terms: Shapes with their coefficients.
        is_rate: True if the signal is a velocity.
    """
    shapes = [shape for shape, _ in terms]
    if any(shape.times for shape in shapes) or all(shape.kind != "spline" for shape in shapes):
        return ""
    z, columns = values_of(signals, shapes[0].of), np.hstack([shape.columns(signals) for shape in shapes])
    line, space = (orthonormal(np.column_stack(parts)) for parts in ([np.ones_like(z), z], [*columns.T]))

    def beside_line(column: Array) -> Array:
        return np.asarray(column - line @ (line.T @ column))

    rest = beside_line(columns @ np.concatenate([sizes for _, sizes in terms]))
    if is_rate:
        laws = [
            ("dry friction", np.sign(z)),
            ("drag with the square of the speed", z * np.abs(z)),
            ("friction with the cube of the speed", z**3),
        ]
    else:
        widths = np.linspace(0.0, np.abs(z).max(), KNOTS)[1:-1]
        laws = [("a preload", np.sign(z)), ("a spring with the cube of the deflection", z**3)]
        laws += [("free play", np.clip(z, -width, width)) for width in widths]
    shares: dict[str, float] = {}
    for name, column in laws:
        law = beside_line(space @ (space.T @ column))
        power = float(law @ law) * float(rest @ rest)
        shares[name] = max(shares.get(name, 0.0), float(law @ rest) ** 2 / power if power else 0.0)
    return " or ".join(n for n in sorted(shares, key=lambda n: -shares[n]) if shares[n] > 1.0 - LITTLE)
