"""Signal properties of a model besides names and units, for checks of logs.

An FMU built by cosim stores these traits in its description, for use without the model.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, field

from cosim.model.model import Model
from cosim.model.namespaces import SCALAR
from cosim.model.planar import PlanarFrame


@dataclass(frozen=True)
class Traits:
    """Declared properties of a model's signals.

    Attributes:
        rates: Output → output that is its time derivative.
        bounds: Signal → least and largest possible value.
        planar: Signal names of a planar motion, or None.
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
    """Return the name of the time derivative of `name`, found by naming convention, such as `angle_dot` or `vx`."""
    usual = (f"{name}_dot", f"v{name}", f"d{name}", f"der({name})")
    words = (name.replace("position", "velocity"), name.replace("angle", "rate"))
    return next((other for other in (*usual, *words) if other != name and other in names), None)


def rates_of(model: Model) -> dict[str, str]:
    """Return the outputs whose derivative is another output, confirmed by the equations: name → derivative."""
    import numpy as np

    names = [q.name for q in model.outputs]
    pairs = {name: rate for name in names if (rate := rate_of(name, names))}
    if not pairs:
        return {}
    place, rng, samples = {name: k for k, name in enumerate(names)}, np.random.default_rng(1), 0
    derivative, output = model.acting(SCALAR)
    for _ in range(3):  # outputs at a random state near the start, and their slopes [1/s]
        start = (np.array(values, dtype=np.float64) for values in (model.start(), model.start_command()))
        x, u = (v + 0.1 * (1.0 + np.abs(v)) * rng.standard_normal(v.size) for v in start)
        command = tuple(u.tolist())
        try:
            with np.errstate(all="ignore"):
                f = np.array(derivative(0.0, tuple(x.tolist()), command))
                # [s], small relative to any time constant
                h = 1e-6 / (1.0 + float(np.max(np.abs(f) / (1.0 + np.abs(x)), initial=0.0)))
                points = (tuple((x + s * h * f).tolist()) for s in (0.0, -1.0, 1.0))
                values, before, after = (np.array(output(0.0, point, command)) for point in points)
                slopes = (after - before) / (2.0 * h)
        except (ArithmeticError, ValueError):  # a root or logarithm is undefined at this state
            continue
        samples += 1
        pairs = {
            n: r for n, r in pairs.items() if abs(slopes[place[n]] - values[place[r]]) <= 1e-3 * abs(values[place[r]])
        }
    return pairs if samples else {}
