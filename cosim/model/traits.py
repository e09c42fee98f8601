"""Signal properties of a model besides names and units, for checks of logs.

An FMU built by cosim stores these traits in its description, so that logs can be checked without the model.
"""

from __future__ import annotations

import math
import random
from collections.abc import Container, Mapping
from dataclasses import dataclass, field

from cosim.model.duals import Dual, DualNamespace
from cosim.model.model import Model
from cosim.model.namespaces import SCALAR
from cosim.model.planar import PlanarFrame


@dataclass(frozen=True)
class Traits:
    """Declared properties of a model's signals.

    Attributes:
        rates: Output → output that is its time derivative.
        bounds: Signal → least and largest possible value.
        planar: Signal names of a planar motion; None if the model has none.
    """

    rates: Mapping[str, str] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    planar: PlanarFrame | None = None

    @classmethod
    def of(cls, model: Model, rates: Mapping[str, str] | None = None) -> Traits:
        """Return the traits of a model.

        Args:
            rates: Output → output that is its time derivative; by default from the equations.
        """
        signals = {q.name: q for q in (*model.outputs, *model.inputs)}
        bounds = {n: q.bounds for n, q in signals.items() if any(map(math.isfinite, q.bounds))}
        return cls(rates_of(model) if rates is None else rates, bounds, model.planar)


def rate_of(name: str, names: Container[str]) -> str | None:
    """Return the name of the time derivative of `name` by the usual names, such as `angle_dot` or `vx`, or None."""
    usual = (f"{name}_dot", f"v{name}", f"d{name}", f"der({name})")
    words = (name.replace("position", "velocity"), name.replace("angle", "rate"))
    return next((other for other in (*usual, *words) if other != name and other in names), None)


def rates_of(model: Model) -> dict[str, str]:
    """Return name → derivative for each output whose derivative is another output, confirmed by the equations."""
    names = [q.name for q in model.outputs]
    pairs = {name: rate for name in names if (rate := rate_of(name, names))}
    generator, samples = random.Random(1), 0
    derivative, output = model.acting(SCALAR).derivative, model.acting(DualNamespace()).output
    for _ in range(3 if pairs else 0):  # outputs and their rates of change at a random state near the start
        groups = model.start(), model.start_command()
        x, u = (tuple(v + 0.1 * (1.0 + abs(v)) * generator.gauss(0.0, 1.0) for v in group) for group in groups)
        try:
            motion = tuple(Dual(v, [rate]) for v, rate in zip(x, derivative(0.0, x, u), strict=True))
            outputs = dict(zip(names, output(0.0, motion, u), strict=True))
        except (ArithmeticError, ValueError, TypeError):  # undefined at this state, or for dual numbers
            continue
        samples += 1
        values = {n: (y.value, y.slopes[0]) if isinstance(y, Dual) else (y, 0.0) for n, y in outputs.items()}
        pairs = {n: r for n, r in pairs.items() if abs(values[n][1] - values[r][0]) <= 1e-3 * abs(values[r][0])}
    return pairs if samples else {}
