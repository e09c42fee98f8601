"""Terms outside the catalogue in forced equations and readings: basis functions of one signal, and local shapes.

Parameters define a local shape, so that one kernel serves every place on every signal. With signals z,

    to · (by.1 + by·z) · (Σ c_k·bump(ζ − k) + c·rise(ζ) + a·sin ζ + b·cos ζ)      ζ = of·z

bump falls from 1 to 0 within 2, rise climbs from 0 to 1 between −1 and 1. With all parameters 0, no shape exists.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cosim.core.units import unit_of_rate
from cosim.model.quantities import Quantity
from cosim.model.symbolic.symbols import SymbolicModel
from cosim.terms.fmu_model import FmuModel

READING = "reading of "  # prefix of an output in place of a state whose equation has a local shape
PREFIX = "unnamed"  # prefix of coefficients: `unnamed.state.basis`
RATE = "rate of "  # prefix of the rate of an output in co-simulation
LOCAL = "local"  # prefix of a local shape's parameters: `local.1.of.position`, and `local.1.of.1` of the constant
SLOTS, KNOTS = 2, 8  # simultaneous local shapes, and bumps of each
ROLES = ("of", "by")
REACH = 2.0  # ζ at which a bump reaches 0


@dataclass(frozen=True)
class Known:
    """Signals on which unnamed terms may depend, with their symbols.

    Attributes:
        states: States; in co-simulation outputs and their rates.
        rates: State → state that equals its derivative.
    """

    time: Any
    states: Sequence[tuple[Quantity, Any]]
    commands: Sequence[tuple[Quantity, Any]]
    rates: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, s: SymbolicModel, measured: Container[str] | None = None, excluded: Container[str] = ()) -> Known:
        """Return the signals of a model.

        Args:
            measured: Outputs that stand in place of states in co-simulation, by default all of them.
            excluded: States that drift unobserved, which cannot be regressors.
        """
        states = [(q, x) for q, x in zip(s.model.base_states, s.state, strict=False) if q.name not in excluded]
        rates: dict[str, str] = {}
        if isinstance(s.model, FmuModel) and s.model.stepped:
            import sympy

            states = [(q, x) for q, x in states if measured is None or q.name in measured]
            names, known = [q.name for q in s.model.base_states], {q.name for q, _ in states}
            rates = {names[k]: names[v] for k, v in s.model.rates.items() if {names[k], names[v]} <= known}
            for q in [q for q, _ in states if q.name not in {*rates, *rates.values()}]:
                rate = Quantity(f"{RATE}{q.name}", unit_of_rate(q.unit), f"rate of {q.doc or q.name}")
                states.append((rate, sympy.Symbol(f"state:{rate.name}", real=True)))
                rates[q.name] = rate.name
        return cls(s.time, states, [*zip(s.model.inputs, s.command, strict=True)], rates)


def bases(known: Known) -> dict[str, Any]:
    """Return name → basis function of time, a state, a velocity, an angle or a command, and the constant."""
    import sympy

    functions: dict[str, Any] = {"1": sympy.Integer(1), "time": known.time}
    inputs = {q.name for q, _ in known.commands}
    for q, x in known.states:
        functions[q.name] = x
        if q.unit in {"m/s", "rad/s"}:
            functions[f"{q.name}·|{q.name}|"] = x * sympy.sqrt(x * x)
            functions[f"{q.name}³"] = x**3
            functions[f"|{q.name}|"] = sympy.sqrt(x * x)
            functions[f"{q.name} where positive"] = (x + sympy.sqrt(x * x)) / 2
            functions[f"{q.name} where negative"] = (x - sympy.sqrt(x * x)) / 2
            functions[f"time·{q.name}"] = known.time * x
        if q.unit == "rad" and q.name not in inputs:
            functions |= {
                f"sin {q.name}": sympy.sin(x),
                f"cos {q.name}": sympy.cos(x),
                f"cos 2{q.name}": sympy.cos(2 * x),
            }
    for q, u in known.commands:
        functions[f"command {q.name}"] = u
        if q.unit == "rad":
            functions[f"command {q.name}·|{q.name}|"] = u * sympy.sqrt(u * u)
    return functions


def local_signals(known: Known) -> dict[str, Any]:
    """Return the signals of local shapes: time, states, sine and cosine of angles, commands."""
    import sympy

    signals = {"time": known.time} | {q.name: x for q, x in known.states}
    for q, x in known.states:
        if q.unit == "rad":
            signals |= {f"cos {q.name}": sympy.cos(x), f"sin {q.name}": sympy.sin(x)}
    return signals | {f"command {q.name}": u for q, u in known.commands}


@dataclass(frozen=True)
class LocalShape:
    """Symbols of a local shape, an unnamed term that acts in a range of a signal: factor times shape.

    Attributes:
        terms: Contribution to each equation, and to each reading.
        over, bend: Symbols of ζ and of the derivative of the shape by ζ.
        sums: Symbol of ζ and of the factor → expression.
        value: Expression of the shape.
        slopes: Symbol of a signal → derivatives of factor and shape.
    """

    factor: Any
    shape: Any
    over: Any
    bend: Any
    terms: tuple[Any, ...]
    sums: dict[Any, Any]
    value: Any
    slopes: dict[Any, tuple[Any, Any]]

    @property
    def stages(self) -> tuple[dict[Any, Any], ...]:
        """Return the stages computed first; derived here because printing alone needs the derivative of the shape."""
        return self.sums, {self.shape: self.value, self.bend: self.value.diff(self.over)}


def local_shape(
    slot: int, signals: dict[str, Any], equations: Sequence[str], number: Callable[[str], Any]
) -> LocalShape:
    """Return a local shape and its derivatives by states.

    Args:
        slot: Number of the shape, part of its parameters' names.
        number: Function from a parameter's name to its symbol.
    """
    import sympy

    def symbol(name: str) -> Any:
        return sympy.Symbol(f"{LOCAL}{slot}_{name}", real=True)

    weights = {role: {z: number(f"{LOCAL}.{slot}.{role}.{n}") for n, z in signals.items()} for role in ROLES}

    def slope(role: str, x: Any) -> Any:
        return sum(w * sympy.diff(z, x) for z, w in weights[role].items() if x in z.free_symbols)

    over, factor, shape, bend = map(symbol, ("over", "factor", "shape", "bend"))
    value = number(f"{LOCAL}.{slot}.rise") * rise(over)
    value += sum(number(f"{LOCAL}.{slot}.{k}") * bump(over - k) for k in range(KNOTS))
    value += sum(number(f"{LOCAL}.{slot}.{w.__name__}") * w(over) for w in (sympy.sin, sympy.cos))
    sums = {role: sum(w * z for z, w in of.items()) for role, of in weights.items()}
    return LocalShape(
        factor,
        shape,
        over,
        bend,
        tuple(number(f"{LOCAL}.{slot}.to.{name}") * factor * shape for name in equations),
        {over: number(f"{LOCAL}.{slot}.of.1") + sums["of"], factor: number(f"{LOCAL}.{slot}.by.1") + sums["by"]},
        value,
        {x: (slope("by", x), bend * slope("of", x)) for x in signals.values() if x.is_Symbol},
    )


def bump(x: Any) -> Any:
    """Return (1 − x²/4)³ where positive, for arrays or symbols."""
    below = 1 - x * x / REACH**2
    return ((below + abs(below)) / 2) ** 3


def rise(x: Any) -> Any:
    """Return a smooth step in x: 0 below −1, 1 above 1, and a cubic between."""
    c = (abs(x + 1) - abs(x - 1)) / 2  # x limited to −1 … 1
    return (2 + 3 * c - c**3) / 4
