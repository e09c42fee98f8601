"""Terms of no catalogue: basis functions of one signal each, in the equation of a forced state."""

from __future__ import annotations

from collections.abc import Container
from typing import Any

from plant.symbolic.symbols import SymbolicModel

PREFIX = "unnamed"  # of their coefficients among the parameters: `unnamed.state.basis`


def bases(s: SymbolicModel, unknown: Container[str] = ()) -> dict[str, Any]:
    """Basis functions: 1, time, states, powers of velocities, their product with time, circles of angles, commands."""
    import sympy

    found: dict[str, Any] = {"1": sympy.Integer(1), "time": s.time}
    for q, x in zip(s.model.base_states, s.state, strict=False):
        if q.name in unknown:  # drifts unseen: nothing can be said to depend on it
            continue
        found[q.name] = x
        if q.unit in {"m/s", "rad/s"}:
            found[f"{q.name}·|{q.name}|"] = x * sympy.sqrt(x * x)
            found[f"{q.name}³"] = x**3
            found[f"|{q.name}|"] = sympy.sqrt(x * x)
            found[f"time·{q.name}"] = s.time * x
        if q.unit == "rad" and not any(q.name == i.name for i in s.model.inputs):
            found |= {f"sin {q.name}": sympy.sin(x), f"cos {q.name}": sympy.cos(x), f"cos 2{q.name}": sympy.cos(2 * x)}
    for q, u in zip(s.model.inputs, s.command, strict=True):
        found[f"command {q.name}"] = u
        if q.unit == "rad":
            found[f"command {q.name}·|{q.name}|"] = u * sympy.sqrt(u * u)
    return found
