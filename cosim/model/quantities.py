"""What the equations speak of: quantities with a unit, and parameters declared once."""

from __future__ import annotations

import math
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any
from weakref import WeakKeyDictionary

INFINITY = math.inf


@dataclass(frozen=True)
class Quantity:
    """A state, input, output or remembered value: name, SI unit, meaning, start value, and what values it can have."""

    name: str
    unit: str
    doc: str
    start: float = 0.0
    bounds: tuple[float, float] = (-INFINITY, INFINITY)

    @property
    def bounded(self) -> bool:
        """Whether it has a limit on one side at least."""
        return any(map(math.isfinite, self.bounds))


@dataclass(frozen=True)
class Parameter:
    """A declared parameter: everything there is to know of it but its value.

    `neutral` is the value at which an effect is dormant (None: the parameter only shapes the effect); `typical` a
    size at which it is plainly seen, from which a fit starts and by which it measures its steps. `tolerance` is how far
    the true value may be from the stated one, as a share of it: the half-width that holds 95 %.
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
        """Say what is wrong with `value`, or None. Arrays and symbols are taken as they are."""
        if isinstance(self.default, bool):
            return None if isinstance(value, bool) else f"{self.name} is {value!r}; it is true or false"
        if isinstance(value, (bool, str)) or value is None:
            return f"{self.name} is {value!r}; it is a number [{self.unit}]"
        if not isinstance(value, (int, float)):
            return None
        low, high = self.bounds
        if not (math.isfinite(value) and low <= value <= high):
            return f"{self.name} is {value!r}; it lies in [{low:g}, {high:g}] {self.unit}".rstrip()
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
    declared = Parameter("", default, unit, doc, bounds, neutral, typical, tolerance)
    return field(default=default, metadata={"parameter": declared})


def parameters_of(owner: Any) -> tuple[Parameter, ...]:
    """Parameters declared by a dataclass or an instance of one, in order."""
    kind = owner if isinstance(owner, type) else type(owner)
    found = _declared.get(kind)
    if found is None:
        found = _declared[kind] = tuple(_named(f) for f in fields(kind) if "parameter" in f.metadata)
    return found


_declared: WeakKeyDictionary[type, tuple[Parameter, ...]] = WeakKeyDictionary()  # asked for thousands of times a fit


def _named(declared: Field[Any]) -> Parameter:
    p: Parameter = declared.metadata["parameter"]
    return replace(p, name=declared.name)
