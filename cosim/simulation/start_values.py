"""Start values of a scenario in the type and unit of their FMU variable."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from cosim.blocks.fmu import unit_of

QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d.]\S*)\s*")


@dataclass(frozen=True)
class Misfit:
    """Why a value does not fit its variable."""

    reason: str


def settable(variable: Any) -> bool:
    """FMI lets a host give this variable a start value."""
    return variable.variability != "constant" and (
        variable.causality == "input" or variable.initial in {"exact", "approx"}
    )


def kind_of(variable: Any) -> str:
    """What a variable is that takes none."""
    return {"output": "an output", "calculatedParameter": "calculated", "independent": "the time"}.get(
        variable.causality, variable.variability or "not settable"
    )


def typed(description: Any, variable: Any, given: Any) -> Any:
    """The value as FMI takes it, or why it does not fit."""
    if variable.type == "Boolean":
        return given if isinstance(given, bool) else Misfit("it is true or false")
    if variable.type == "String":
        return given if isinstance(given, str) else Misfit("it is text")
    if isinstance(given, str):
        given = _converted(description, variable, given)
        if isinstance(given, Misfit):
            return given
    if isinstance(given, bool):
        return Misfit(f"it is a number [{unit_of(variable) or '1'}]")
    if variable.type in {"Integer", "Enumeration"} and given != int(given):
        return Misfit("it is a whole number")
    low, high = (float(v) if v is not None else s * math.inf for v, s in ((variable.min, -1), (variable.max, 1)))
    if not low <= given <= high:
        return Misfit(f"it lies in [{low:g}, {high:g}] {unit_of(variable)}".rstrip())
    return int(given) if variable.type in {"Integer", "Enumeration"} else float(given)


def _converted(description: Any, variable: Any, text: str) -> float | Misfit:
    """`12 deg` in the unit of the variable."""
    unit = unit_of(variable)
    displays: list[Any] = next((d.displayUnits for d in description.unitDefinitions if d.name == unit), [])
    known = {unit: (1.0, 0.0), **{d.name: (float(d.factor), float(d.offset)) for d in displays}}
    match = QUANTITY.fullmatch(text)
    if match is None or match[2] not in known:
        return Misfit(f"it is a number [{unit or '1'}], or text with a unit: {', '.join(f'3 {u}' for u in known if u)}")
    factor, offset = known[match[2]]
    return (float(match[1]) - offset) / factor
