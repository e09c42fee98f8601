"""Start values of a scenario, converted to the type and unit of the FMU variable or signal.

Texts whose unit must fit a signal, such as `2 deg`, are converted after the model descriptions are read. Quantities
with a fixed unit, such as `duration`, are converted by `cosim.files.yaml_file.InUnit`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosim.blocks.component import Signal
from cosim.blocks.sources import playback
from cosim.core.errors import FmuError, InputError
from cosim.core.text import did_you_mean
from cosim.core.units import (
    allowed_quantity,
    computed_in,
    has_unit,
    read_quantity,
    split_quantity,
    unit_product,
)
from cosim.files.yaml_file import Location
from cosim.fmi.description import enumeration_items, is_difference, read_description, unit_definition, unit_of
from cosim.fmi.fmi_types import element_names, kinds_of
from cosim.scenario.scenario import FmuComponent, PlaybackComponent, ReferenceComponent, Scenario

STAND_IN = 1.0  # replaces a faulty number, so that other checks can continue
Resolve = Callable[[str], Path]
# unit of a signal, and a function of (text, difference=) that returns a number in this unit or raises ValueError
Measure = tuple[str, Callable[..., float]]
HEX = re.compile(r"(?:[0-9A-Fa-f]{2})*")


def settable(variable: Any) -> bool:
    """Return True if FMI allows setting a start value of a variable."""
    if variable.variability == "constant" or variable.causality in {"independent", "structuralParameter"}:
        return False
    has_start = variable.initial is None and variable.start is not None  # FMI 1.0 has no attribute `initial`
    return variable.causality == "input" or variable.initial in {"exact", "approx"} or has_start


def with_elements(start: Mapping[str, Any], variables: Mapping[str, Any]) -> dict[str, Any]:
    """Return start values in which values of single array elements are merged into values of arrays.

    An element is written `A[1,2]: 3`. Other elements have the value that `start` sets for the array, otherwise the
    array's start value in the FMU.
    """
    merged = dict(start)
    for name, value in start.items():
        array = variables.get(name.rpartition("[")[0])
        if name in variables or array is None or not array.shape or name not in (names := element_names(array)):
            continue
        values = merged.get(array.name, array.start)
        values = [values or 0.0] if values is None or isinstance(values, (int, float)) else values
        values = values.split() if isinstance(values, str) else values
        if isinstance(values, (list, tuple)) and len(values) in {1, len(names)}:  # other lengths are reported elsewhere
            values = [*map(_number, values)] * (len(names) // len(values))
            del merged[name]
            merged[array.name] = [value if each == name else v for each, v in zip(names, values, strict=True)]
    return merged


def _number(text: Any) -> Any:
    """Return a start value from XML as a number if it is numeric, otherwise unchanged."""
    if not isinstance(text, str):
        return text
    try:
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        return {"true": True, "false": False}.get(text, text)


def start_value(description: Any, variables: Mapping[str, Any], name: str, value: Any, component: str = "") -> Any:
    """Return a start value in the FMI type of the variable; raise ValueError for an unknown name or invalid value."""
    variable, full_name = variables.get(name), f"{component}.{name}".lstrip(".")
    if variable is None:
        hint = did_you_mean(name, [n for n, v in variables.items() if settable(v)])
        raise ValueError(f'{component or "the FMU"} has no variable "{name}"{hint}')
    if not settable(variable):
        kind = f"{variable.variability or ''} {variable.causality}".strip()
        raise ValueError(f"{full_name} is a variable of the kind {kind}; its start value cannot be set")
    try:
        return convert_value(description, variable, value)
    except ValueError as error:
        raise ValueError(f"{full_name} is {value!r}; {error}") from None


def convert_value(description: Any, variable: Any, value: Any) -> Any:
    """Return a start value in the variable's FMI type; raise ValueError with the reason if it does not fit.

    The value of an array is a list.
    """
    if not variable.shape:
        return _scalar(description, variable, value)
    count = math.prod(variable.shape)
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"use a list of {count} values")
    return [_scalar(description, variable, each) for each in value]


def _scalar(description: Any, variable: Any, value: Any) -> Any:
    """Return a scalar value in the FMI type; raise ValueError with the reason if it does not fit."""
    kind, unit = kinds_of(description.fmiVersion).get(variable.type), unit_of(variable)
    if kind is None:
        raise ValueError(f"the type {variable.type} is not supported")
    if variable.type in NOT_NUMBERS:
        fits, reason = NOT_NUMBERS[variable.type]
        if not fits(value):
            raise ValueError(reason)
        return value
    items = enumeration_items(variable) if variable.type == "Enumeration" else {}
    if isinstance(value, str) and variable.type == "Enumeration":
        if value not in items:
            raise ValueError(f"allowed: {', '.join(items)}{did_you_mean(value, items)}")
        value = items[value]
    elif isinstance(value, str):
        value = convert_quantity(description, variable, value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"use a number [{unit or '1'}]")
    if kind.is_whole and not float(value).is_integer():
        raise ValueError("use a whole number")
    if items and int(value) not in items.values():
        raise ValueError(f"allowed: {', '.join(f'{n} ({k})' for n, k in items.items())}")
    low, high = bounds_of(description, variable)
    if not low <= value <= high:
        raise ValueError(f"allowed range: [{low:g}, {high:g}] {unit}".removesuffix(" 1").rstrip())
    return int(value) if kind.is_whole else float(value)


NOT_NUMBERS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "Boolean": (lambda v: isinstance(v, bool), "use true or false"),
    "String": (lambda v: isinstance(v, str), "use text"),
    "Binary": (lambda v: isinstance(v, str) and HEX.fullmatch(v) is not None, "use text of hexadecimal digits"),
}


def bounds_of(description: Any, variable: Any) -> tuple[float, float]:
    """Return the bounds of a variable; infinite for text.

    Bounds of the variable replace bounds of its declared type. The range of the FMI type applies in addition.
    """
    kind = kinds_of(description.fmiVersion).get(variable.type)
    if kind is None or variable.type in NOT_NUMBERS:
        return -math.inf, math.inf

    def bound(end: str, default: float) -> float:
        ends = getattr(variable, end), getattr(variable.declaredType, end, None)
        return next((float(v) for v in ends if v is not None), default)

    return max(kind.low, bound("min", -math.inf)), min(kind.high, bound("max", math.inf))


def convert_quantity(description: Any, variable: Any, text: str, difference: bool = False) -> float:
    """Return text such as `12 deg` in the unit of the variable; raise ValueError with the reason if that is impossible.

    Args:
        difference: True for a difference, so that the unit's offset is not added.
    """
    unit, relative = unit_of(variable), difference or is_difference(variable)
    units: list[Any] = next((d.displayUnits for d in description.unitDefinitions if d.name == unit), [])
    displays, quantity = {d.name: d for d in units}, split_quantity(text)
    if not unit or quantity is None:
        raise ValueError(allowed_quantity(unit, displays))
    number, written = quantity
    if (display := displays.get(written)) is not None:
        factor, offset = float(display.factor), 0.0 if relative else float(display.offset)
        if not getattr(display, "inverse", False):
            return (number - offset) / factor
        if relative or number == offset:
            raise ValueError(f"{display.name} is the inverse of {unit}; give the value in {unit}")
        return factor / (number - offset)
    source, target = (Signal("", u, unit_definition(description, u), relative=relative) for u in (written, unit))
    if not written or not (by := source.conversion(target)):
        raise ValueError(allowed_quantity(unit, displays))
    return by[0] * number + by[1]


# -- texts whose unit must fit a signal ------------------------------------------------------------------

NUMBER_KINDS = {  # key of a part → kind of its number
    **dict.fromkeys(("offset", "bias", "band"), "difference"),
    **dict.fromkeys(("start", "to"), "value"),
    **{"variance": "square", "rate": "rate"},
}
KIND_UNITS = {"time": "s", "share": "1"}  # kind → unit, whatever the signal


def waiting_texts(
    scenario: Scenario, places: Mapping[str, Sequence[int]], resolve: Resolve
) -> Iterator[tuple[Location, str, Callable[[str], float]]]:
    """Yield location, text and converter of each text whose unit must fit a signal; a converter may raise ValueError.

    Args:
        places: Key (connections, faults, …) → indices in the file of the entries in the scenario.
    """
    parts: list[tuple[Location, BaseModel, str | Measure, dict[str, str]]] = []
    for k, connection in zip(places["connections"], scenario.connections, strict=True):
        parts.append((("connections", k), connection, connection.target, {}))
    for k, fault in zip(places["faults"], scenario.faults, strict=True):
        kind = {"stuck": "value", "scale": "share"}.get(fault.kind, "difference")
        parts.append((("faults", k), fault, fault.on, {"value": kind}))
    for goal, at, criterion in scenario.goals:
        of_peak = "value" if goal == "peak" and not criterion.to else "difference"  # a limit such as "at most 80 degC"
        kind = {"settling_time": "time", "effort": "integral"}.get(goal, of_peak)
        parts.append((at, criterion, criterion.of, {"max": kind}))
    for name, component in scenario.components.items():
        if not isinstance(component, FmuComponent | PlaybackComponent):
            for signal, about in component.signals.items():
                parts.append((("components", name, "signals", signal), about, _measure_in(about.unit), {}))
    measure = cache(partial(_measure, scenario, resolve))
    for place, part, of, kinds in parts:
        for at, text, kind in _texts(place, part, kinds):
            yield at, text, partial(_read, kind, measure, of)


def _texts(at: Location, part: BaseModel, kinds: Mapping[str, str]) -> Iterator[tuple[Location, str, str]]:
    """Yield location, text and kind of number of each text with a unit in a part of the scenario.

    Args:
        kinds: Key of the part → kind of its number (value, difference, square, rate per second, integral over time,
            time, share), in addition to NUMBER_KINDS.
    """
    for name, value in part:
        kind = kinds.get(name) or NUMBER_KINDS.get(name)
        if kind and isinstance(value, str) and has_unit(value):  # other text is the name of a signal
            yield (*at, name), value, kind
        for k, each in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(each, BaseModel):
                yield from _texts((*at, name) if k is None else (*at, name, k), each, {})


def _measure(scenario: Scenario, resolve: Resolve, signal: str) -> Measure | None:
    """Return the unit of a signal and its converter of texts; None if the signal's component has a fault."""
    owner, _, name = signal.partition(".")
    component = scenario.components.get(owner)
    try:
        if component is None:
            return None
        if isinstance(component, FmuComponent):
            description = read_description(resolve(component.fmu))
            names = {v.name: v for v in description.modelVariables}
            variable = names.get(name) or names[name.rpartition("[")[0]]
            return unit_of(variable), partial(convert_quantity, description, variable)
        if isinstance(component, PlaybackComponent):
            outputs = playback(owner, resolve(component.file), (name,)).outputs
            return _measure_in({s.name: s.unit for s in outputs}[name])
        unit = (component.signals.get(name) or component.signals[name.removesuffix("_meas")]).unit
    except (FmuError, InputError, OSError):
        return None
    except (ValueError, KeyError):
        raise ValueError(f"the unit of {signal} is unknown; write a number without unit") from None
    return _measure_in(computed_in(unit)[0] if isinstance(component, ReferenceComponent) else unit)


def _measure_in(unit: str) -> Measure:
    return unit, partial(read_quantity, unit=unit)


def _read(kind: str, measure: Callable[[str], Measure | None], of: str | Measure, text: str) -> float:
    if kind in KIND_UNITS:
        return read_quantity(text, KIND_UNITS[kind])
    if (unit_and_reader := measure(of) if isinstance(of, str) else of) is None:
        return STAND_IN
    unit, number = unit_and_reader
    if kind in {"value", "difference"}:
        return number(text, difference=kind == "difference")
    factors = {"square": [(unit, 2)], "rate": [(unit, 1), ("s", -1)], "integral": [(unit, 1), ("s", 1)]}
    return read_quantity(text, unit_product(factors[kind]), difference=True)
