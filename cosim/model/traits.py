"""Signal properties of a model beyond names and units, for the checks of logs.

An own FMU stores the traits in its description, for use without the model.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from typing import Any

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
        static: True without states; measurements are a table without time.
    """

    rates: Mapping[str, str] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    planar: PlanarFrame | None = None
    static: bool = False

    @classmethod
    def of(cls, model: Model) -> Traits:
        """Return the traits of a model, with rates from its equations."""
        signals = {q.name: q for q in (*model.outputs, *model.inputs)}
        bounds = {n: q.bounds for n, q in signals.items() if q.bounded}
        return cls(rates_of(model), bounds, model.planar, model.static)


def rate_of(name: str, known: Container[str]) -> str | None:
    """Return the time derivative of `name` by its name, such as `angle_dot` or `vx`."""
    usual = (f"{name}_dot", f"v{name}", f"d{name}", f"der({name})")
    words = (name.replace("position", "velocity"), name.replace("angle", "rate"))
    return next((other for other in (*usual, *words) if other != name and other in known), None)


def rates_of(model: Model) -> dict[str, str]:
    """Return output → derivative output, confirmed by the equations near the start."""
    import numpy as np

    names = [q.name for q in model.outputs]
    pairs = {name: rate for name in names if (rate := rate_of(name, names))}
    if not pairs:
        return {}
    place, rng, drawn = {name: k for k, name in enumerate(names)}, np.random.default_rng(1), 0
    for _ in range(3):
        try:
            values, slopes = _moving(model, rng)
        except (ArithmeticError, ValueError):  # an undefined state of a root or a logarithm
            continue
        drawn += 1
        off = np.array([abs(slopes[place[n]] - values[place[r]]) for n, r in pairs.items()])
        size = np.array([abs(values[place[r]]) for r in pairs.values()])
        pairs = {n: r for (n, r), same in zip(pairs.items(), off <= 1e-3 * size, strict=True) if same}
    return pairs if drawn else {}


def _moving(model: Model, rng: Any) -> tuple[Any, Any]:
    """Return outputs at a random state near the start, and their slopes [1/s]."""
    import numpy as np

    derivative, output = model.acting(SCALAR)
    start, held = np.array(model.start(), dtype=np.float64), np.array(model.start_command(), dtype=np.float64)
    x, u = (v + 0.1 * (1.0 + np.abs(v)) * rng.standard_normal(v.size) for v in (start, held))
    command = tuple(u.tolist())
    with np.errstate(all="ignore"):
        f = np.array(derivative(0.0, tuple(x.tolist()), command))
        h = 1e-6 / (1.0 + float(np.max(np.abs(f) / (1.0 + np.abs(x)), initial=0.0)))  # [s] small relative to any change
        now, before, after = (np.array(output(0.0, tuple((x + s * h * f).tolist()), command)) for s in (0.0, -1.0, 1.0))
        return now, (after - before) / (2.0 * h)
