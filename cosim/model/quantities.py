"""Quantities with units, and parameter declarations."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any
from weakref import WeakKeyDictionary

INFINITY = math.inf


@dataclass(frozen=True)
class Quantity:
    """A state, input, output or stored value: name, SI unit, meaning, start value and bounds."""

    name: str
    unit: str
    doc: str
    start: float = 0.0
    bounds: tuple[float, float] = (-INFINITY, INFINITY)


@dataclass(frozen=True)
class Parameter:
    """Declaration of a parameter.

    Attributes:
        neutral: Value at which the effect vanishes; None if no value of this parameter removes the effect.
        typical: Size of a clearly visible effect, used as start value and step scale of a fit.
        tolerance: Half-width of the 95 % interval of the stated value, as a share of the value.
    """

    name: str
    default: float | bool
    unit: str
    doc: str
    bounds: tuple[float, float] = (-INFINITY, INFINITY)
    neutral: float | None = None
    typical: float | None = None
    tolerance: float | None = None

    def fault(self, value: object) -> str | None:
        """Return a sentence that says why a value is not allowed; None for an allowed value.

        Arrays and symbols are always allowed.
        """
        if isinstance(self.default, bool):
            return None if isinstance(value, bool) else f"{self.name} is {value!r}; allowed: true or false"
        if isinstance(value, (bool, str)) or value is None:
            return f"{self.name} is {value!r}; use a number [{self.unit}]"
        if not isinstance(value, (int, float)):
            return None
        low, high = self.bounds
        if not (math.isfinite(value) and low <= value <= high):
            return f"{self.name} is {value!r}; allowed range: [{low:g}, {high:g}] {self.unit}".rstrip()
        return None


def parameter(
    default: float | bool,
    *,
    unit: str,
    doc: str,
    bounds: tuple[float, float] = (-INFINITY, INFINITY),
    neutral: float | None = None,
    typical: float | None = None,
    tolerance: float | None = None,
) -> Any:
    """Declare a dataclass field as a parameter: `friction: float = parameter(0.25, unit="N.s/m", doc=…)`."""
    declaration = Parameter("", default, unit, doc, bounds, neutral, typical, tolerance)
    return field(default=default, metadata={"parameter": declaration})


def size(unit: str, bounds: tuple[float, float], typical: float, doc: str) -> Any:
    """Declare a parameter of an effect; default and neutral value are 0, where the effect is dormant."""
    return parameter(0.0, unit=unit, bounds=bounds, neutral=0.0, typical=typical, doc=doc)


def parameters_of(owner: Any) -> tuple[Parameter, ...]:
    """Return the declared parameters of a dataclass in order."""
    kind = owner if isinstance(owner, type) else type(owner)
    parameters = _parameters.get(kind)
    if parameters is None:
        parameters = _parameters[kind] = tuple(
            replace(f.metadata["parameter"], name=f.name) for f in fields(kind) if "parameter" in f.metadata
        )
    return parameters


# Cached, because a fit reads the parameters thousands of times.
_parameters: WeakKeyDictionary[type, tuple[Parameter, ...]] = WeakKeyDictionary()
