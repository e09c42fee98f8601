"""Terms and their places. Terms are declared in multiples of signals; `bind` adds name, units and typical sizes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any, ClassVar, dataclass_transform

from cosim.core.units import unit_product
from cosim.model.model import Effect, Number, Values
from cosim.model.namespaces import Namespace
from cosim.model.quantities import Parameter, parameter, parameters_of

ABSOLUTE = "absolute"  # key of a field's metadata
UNIT_FACTOR = re.compile(r"(?P<symbol>[A-Za-z]+|1)(\^(?P<power>\d+))?")


@dataclass(frozen=True)
class RatioFactor:
    """Dependence of an inertia ratio on a parameter p: the factor ((p + shift)/(value + shift))^power, 1 at p = value.

    A shift of 0 gives a power law; another shift is the constant that the model adds to the parameter.
    """

    parameter: str
    value: float
    shift: float
    power: float

    def at(self, value: Number) -> Number:
        """Return the factor for a value p of the parameter."""
        return ((value + self.shift) / (self.value + self.shift)) ** self.power


@dataclass(frozen=True)
class Opposite:
    """The second end of a spring or damper that connects two pairs of position and velocity.

    Attributes:
        position, state: Indices of the second end's position and velocity.
        gear: Ratio of the first end's position to this end's position, without deflection of the connection.
        ratio: Acceleration of this end per opposite acceleration of the first end, at the FMU's parameter values.
        factors: Factors of the ratio, one for each parameter of an inertia.
    """

    position: int
    state: int
    gear: float
    ratio: float
    factors: tuple[RatioFactor, ...] = ()


@dataclass(frozen=True)
class Direction:
    """Change of all derivatives f per unit of force along a velocity v.

    d(x) = −(f(x; b + δ) − f(x; b))/(δ·v), where b is a damping parameter of the FMU.

    Both values of f are evaluated at a typical speed v and at 0 for the velocities of other directions.

    Attributes:
        number: Number of the direction in its model.
        parameter: Variable b of the FMU.
        change, high: Change δ, and the upper limit of b; if b + δ exceeds the limit, −δ is used.
        state: Index of v.
        speed: Typical speed.
        rates: Indices of the rates that change.
    """

    number: int
    parameter: str
    change: float
    high: float
    state: int
    speed: float
    rates: tuple[int, ...]

    def changed(self, value: float) -> float:
        """Return the value of b + δ or, beyond the upper limit, b − δ."""
        return value + self.change if value + self.change <= self.high else value - self.change


@dataclass(frozen=True)
class Place:
    """A place of an FMU where terms can act.

    Attributes:
        name: Name of the input, velocity or state, used in the terms' names.
        units, sizes: Symbol in `scaled` → unit, and symbol → typical size in the logs.
        input: Index of the input of an input term, or of the port of a force or rate; −1 for a term on a rate.
        position, state: Indices of the position, and of the velocity or storage state.
        middle: Mean of the storage state in the logs.
        resolution: Smallest change of velocity that an integration step resolves, for the transition of friction.
        sign: Sign of the port's effect on the derivative of the velocity.
        gain: Derivative of the storage per unit of the port.
        opposite: Other end of a connection; a force acts on both, along their relative position and velocity.
        direction: Change of the derivatives per unit of force, for a force that changes more than one derivative.
        is_driven: True if an input acts on the velocity, through this place or another.
    """

    name: str
    units: Mapping[str, str]
    sizes: Mapping[str, float]
    input: int = -1
    position: int = -1
    state: int = -1
    middle: float = 0.0
    sign: float = 1.0
    gain: float = 1.0
    resolution: float = 0.0
    opposite: Opposite | None = None
    direction: Direction | None = None
    is_driven: bool = False

    def motion(self, state: Values) -> tuple[Number, Number]:
        """Return position and velocity; at a connection, those of the first end relative to the second."""
        position, velocity, other = state[self.position], state[self.state], self.opposite
        if other is None:
            return position, velocity
        return position - other.gear * state[other.position], velocity - other.gear * state[other.state]


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Term(Effect):
    """A term of the general catalogue, before or after it is bound to a place. Each subclass becomes a dataclass.

    Attributes:
        kind: First part of the name, `kind_at_place`; by default the name before binding.
        place: Place of a bound term.
        least: Parameter → lower limit, as a multiple of the smallest velocity that an integration step resolves.
    """

    kind: ClassVar[str]
    place: ClassVar[Place]
    least: ClassVar[Mapping[str, float]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if not hasattr(cls, "kind") and "name" in vars(cls):
            cls.kind = cls.name
        dataclass(frozen=True, kw_only=True)(cls)


class InputTerm(Term):
    """A term that changes one input of the FMU. Symbols in `scaled`: u, M (largest value), T (time between rows)."""

    def change(self, m: Namespace, value: Number) -> Number:
        """Return the changed input, for a term without memory."""
        return value

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return all inputs, with this one changed."""
        return {**command, self.place.name: self.change(m, command[self.place.name])}


class RememberingTerm(InputTerm):
    """An input term with memory, which is updated once per substep."""

    def advance(self, m: Namespace, h: Number, value: Number, memory: Values) -> tuple[Number, Values]:
        """Return the changed input from `t` to `t + h` [s], and the new memory.

        The initial memory equals the input.
        """
        raise NotImplementedError

    def transmit(self, m: Namespace, command: Mapping[str, Number]) -> Mapping[str, Number]:
        """Return the inputs unchanged; `shape` changes them."""
        return command

    def shape(self, m: Namespace, t: Number, h: Number, command: Values, memory: Values) -> tuple[Values, Values]:
        """Return the command with this input changed, and the new memory, whose last value is 1 once initialized."""
        place = self.place.input
        value, (*kept, begun) = command[place], memory
        past = tuple(m.where(begun > 0.5, past, value) for past in kept)
        changed, after = self.advance(m, h, value, past)
        return (*command[:place], changed, *command[place + 1 :]), (*after, 1.0)


class Force(Term):
    """A force that acts on a velocity. Symbols in `scaled`: u (unit of the force), q (position) and v (velocity).

    At a connection of two pairs, position and velocity are relative, and the symbol k is the stiffness of the
    connection.

    Attributes:
        repeats: Parameter with the period of a force that repeats along the position; "" for none.
    """

    repeats: ClassVar[str] = ""

    def force(self, m: Namespace, position: Number, velocity: Number) -> Number:
        """Return the force in the direction of the velocity."""
        raise NotImplementedError


class RateTerm(Term):
    """An addition to the derivative of a storage state. Symbols in `scaled`: r (the derivative) and q (the state)."""

    def rate(self, m: Namespace, level: Number) -> Number:
        """Return the addition to the derivative at a level of the storage."""
        raise NotImplementedError


def scaled(
    unit: str,
    *,
    doc: str,
    default: float = 0.0,
    neutral: float | None = None,
    typical: float | None = None,
    low: float = -math.inf,
    high: float = math.inf,
    absolute: bool = False,
) -> Any:
    """Declare a parameter of a term, with values as multiples of typical sizes at its place.

    Args:
        unit: Product of powers of symbols, such as `u/v^2`, or the units `1` and `s`.
        default, neutral, typical, low, high: Values as multiples of the same product, taken of the typical sizes.
        absolute: True if the value is measured from the mean of the state at the place, not from zero.
    """
    declaration = Parameter("", default, unit, doc, (low, high), neutral, typical)
    return field(default=default, metadata={"parameter": declaration, ABSOLUTE: absolute})


scaled_size = partial(scaled, neutral=0.0)  # a parameter with the neutral value 0


def bind(kind: type[Any], place: Place) -> type[Any]:
    """Return a term bound to a place: a class with name, units, bounds and typical sizes."""
    least = dict.fromkeys(kind.resolved, place.resolution)
    least |= {name: multiple * place.resolution for name, multiple in kind.least.items()}
    absolute = {f.name for f in fields(kind) if f.metadata.get(ABSOLUTE)}
    own, middles, sizes = dict[str, Any](), dict[str, float](), dict[str, float]()
    for p in parameters_of(kind):
        middle = middles[p.name] = place.middle if p.name in absolute else 0.0
        size = sizes[p.name] = math.prod(place.sizes.get(symbol, 1.0) ** power for symbol, power in _factors(p.unit))
        limit = least.get(p.name, -math.inf)
        low, high = (middle + bound * size for bound in p.bounds)
        own[p.name] = parameter(
            max(middle + float(p.default) * size, limit),
            unit=unit_of(p.unit, place.units),
            doc=p.doc,
            bounds=(max(low, limit), max(high, 2.0 * limit)),
            neutral=None if p.neutral is None else p.neutral * size,
            typical=None if p.typical is None else p.typical * size,
        )
    starts = tuple({n: middles[n] + v * sizes[n] for n, v in start.items()} for start in kind.starts)
    bound: type[Any] = kind.named(f"{kind.kind}_at_{place.name}", place=place, starts=starts, **own)
    return bound


def _factors(expression: str) -> list[tuple[str, int]]:
    """Return the symbol and power of each factor of a product such as `u/v^2`."""
    factors, sign = [], 1
    for part in re.split(r"([/.])", expression):
        if part in ("/", "."):
            sign = -1 if part == "/" else 1
            continue
        match = UNIT_FACTOR.fullmatch(part)
        if match is None:
            raise ValueError(f"not a product of symbols: {expression!r}")
        factors.append((match["symbol"], sign * int(match["power"] or 1)))
    return factors


def unit_of(expression: str, units: Mapping[str, str]) -> str:
    """Return the unit of a product of symbols, such as `N.s/m` for `u/v`."""
    return unit_product([(units.get(symbol, symbol), power) for symbol, power in _factors(expression)])


def with_place(text: str) -> str:
    """Return a variable's name as part of a term's name: letters, digits and underscores only."""
    return re.sub(r"\W", "_", text, flags=re.ASCII)
