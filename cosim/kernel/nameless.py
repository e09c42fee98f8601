"""Terms of no catalogue in the equation of a forced state: basis functions of one signal each, and local shapes.

A local shape is set by numbers, so that one kernel serves every place on every signal. With z the signals,
    to · (by.1 + f) · (Σ c_k·bump(ζ − k) + c·rise(ζ))      f = by·z, clipped to −1 … 1 where dry is 1      ζ = of·z
bump falls from 1 to 0 within 2, rise climbs from 0 to 1 between −1 and 1. All numbers 0: there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Any

from cosim.model.symbolic.symbols import SymbolicModel

PREFIX = "unnamed"  # of their coefficients among the parameters: `unnamed.state.basis`
LOCAL = "local"  # of the numbers of a local shape: `local.1.of.position`, and `local.1.of.1` of the constant
SLOTS, KNOTS = 2, 8  # local shapes at a time, and bumps of each
ROLES = ("of", "by")
REACH = 2.0  # of ζ, at which a bump has fallen to 0


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
            found[f"{q.name} where positive"] = (x + sympy.sqrt(x * x)) / 2
            found[f"{q.name} where negative"] = (x - sympy.sqrt(x * x)) / 2
            found[f"time·{q.name}"] = s.time * x
        if q.unit == "rad" and not any(q.name == i.name for i in s.model.inputs):
            found |= {f"sin {q.name}": sympy.sin(x), f"cos {q.name}": sympy.cos(x), f"cos 2{q.name}": sympy.cos(2 * x)}
    for q, u in zip(s.model.inputs, s.command, strict=True):
        found[f"command {q.name}"] = u
        if q.unit == "rad":
            found[f"command {q.name}·|{q.name}|"] = u * sympy.sqrt(u * u)
    return found


def local_signals(s: SymbolicModel, unknown: Container[str] = ()) -> dict[str, Any]:
    """Over what a shape may be local: time, states that do not drift unseen, circles of angles, commands."""
    import sympy

    known = [(q, x) for q, x in zip(s.model.base_states, s.state, strict=False) if q.name not in unknown]
    found = {"time": s.time} | {q.name: x for q, x in known}
    for q, x in known:
        if q.unit == "rad":
            found |= {f"cos {q.name}": sympy.cos(x), f"sin {q.name}": sympy.sin(x)}
    return found | {f"command {q.name}": u for q, u in zip(s.model.inputs, s.command, strict=True)}


@dataclass(frozen=True)
class LocalShape:
    """One local shape as symbols: factor · shape, each a symbol of its own that `stages` say how to compute.

    terms:  what it adds to each equation
    slopes: symbol of a signal → derivatives of factor and shape by it
    """

    factor: Any
    shape: Any
    terms: tuple[Any, ...]
    stages: tuple[dict[Any, Any], ...]
    slopes: dict[Any, tuple[Any, Any]]


def local_shape(
    slot: int, signals: dict[str, Any], equations: Sequence[str], number: Callable[[str], Any]
) -> LocalShape:
    """A local shape; `number` gives the symbol of a parameter by its name. It is differentiated once, not per state."""
    import sympy

    def symbol(name: str) -> Any:
        return sympy.Symbol(f"{LOCAL}{slot}_{name}", real=True)

    weights = {role: {z: number(f"{LOCAL}.{slot}.{role}.{n}") for n, z in signals.items()} for role in ROLES}

    def slope(role: str, x: Any) -> Any:
        return sum(w * sympy.diff(z, x) for z, w in weights[role].items())

    over, plain, factor, shape, bend, edge = map(symbol, ("over", "plain", "factor", "shape", "bend", "edge"))
    dry = number(f"{LOCAL}.{slot}.dry")
    told = number(f"{LOCAL}.{slot}.by.1") + plain + dry * (clipped(plain) - plain)
    value = number(f"{LOCAL}.{slot}.rise") * rise(over)
    value += sum(number(f"{LOCAL}.{slot}.{k}") * bump(over - k) for k in range(KNOTS))
    mixed = {role: sum(w * z for z, w in of.items()) for role, of in weights.items()}
    return LocalShape(
        factor,
        shape,
        tuple(number(f"{LOCAL}.{slot}.to.{name}") * factor * shape for name in equations),
        (
            {over: number(f"{LOCAL}.{slot}.of.1") + mixed["of"], plain: mixed["by"]},
            {factor: told, shape: value, bend: sympy.diff(value, over), edge: sympy.diff(told, plain)},
        ),
        {x: (edge * slope("by", x), bend * slope("of", x)) for x in signals.values() if x.is_Symbol},
    )


def bump(x: Any) -> Any:
    """(1 − x²/4)³ where that is positive: of an array or a symbol."""
    below = 1 - x * x / REACH**2
    return ((below + abs(below)) / 2) ** 3


def clipped(x: Any) -> Any:
    """−1 … 1."""
    return (abs(x + 1) - abs(x - 1)) / 2


def rise(x: Any) -> Any:
    """0 below −1, 1 above 1, a cubic between."""
    c = clipped(x)
    return (2 + 3 * c - c**3) / 4
