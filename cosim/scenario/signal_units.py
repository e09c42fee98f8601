"""Unit conversion of scenario values that are in the unit of a signal, before validation.

Quantities with a fixed unit, such as `duration`, are converted by `cosim.files.yaml_file.InUnit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cosim.blocks.sources import playback
from cosim.core.errors import FmuError, InputError
from cosim.core.units import allowed_quantity, computed_in, has_unit, read_quantity, split_quantity, square_unit
from cosim.files.yaml_file import format_value, wrong_value
from cosim.files.yaml_nodes import Location
from cosim.fmi.description import read_description, unit_of
from cosim.scenario.start_values import convert_quantity

STAND_IN = 1.0  # replaces a faulty quantity, so that checks can go on
Resolve = Callable[[str], Path]
# unit of a signal, and a function from (text, is difference) to a number in this unit, which may raise ValueError
Measure = tuple[str, Callable[[str, bool], float]]


def convert_quantities(data: dict[str, Any], resolve: Resolve, note: Callable[[Location, str], None]) -> None:
    """Convert text such as `2 deg` to the signal's unit, in place. Values and signals may be of any type.

    Args:
        note: Called with place and message of each fault.
    """
    measures: dict[str, Measure | None] = {}

    def convert(kind: str, of: Any, *location: str | int) -> None:
        """Convert a text, if there is one.

        Args:
            kind: `value`, `difference`, `square`, `rate` (per second) or `integral` (over time).
            of: The signal or its measure.
        """
        text, parent, name = _part(data, *location), _part(data, *location[:-1]), ".".join(map(str, location))
        if not isinstance(text, str) or not isinstance(of, (str, tuple)):
            return
        parent[location[-1]] = STAND_IN
        if isinstance(of, str) and of not in measures:
            measures[of] = _measure(data, of, resolve)
        measure = measures[of] if isinstance(of, str) else of
        if measure is None:
            unknown = f"{name} is {format_value(text)}: the unit of {of} is not known"
            note(location, f"{unknown}; write a number alone")
            return
        unit, number = measure
        units = {"rate": f"{unit or '1'}/s", "integral": f"{unit}.s".lstrip(".")}
        try:
            if not has_unit(text):
                raise ValueError(allowed_quantity(unit))
            if kind in {"value", "difference"}:
                parent[location[-1]] = number(text, kind == "difference")
            else:
                target = square_unit(unit) if kind == "square" else units[kind]
                parent[location[-1]] = read_quantity(text, target, difference=True)
        except ValueError as error:
            note(location, wrong_value(name, text, str(error)))

    for k, connection in _entries(data.get("connections")):
        at, to = ("connections", k), connection.get("to")
        convert("difference", to, *at, "offset")
        convert("difference", to, *at, "noise", "bias")
        convert("square", to, *at, "noise", "variance")
    for k, fault in _entries(data.get("faults")):
        of = _measure_in("1") if fault.get("kind") == "scale" else fault.get("on")
        convert("value" if fault.get("kind") == "stuck" else "difference", of, "faults", k, "value")
    for kind, content in _items(data.get("criteria")):
        single: list[tuple[Location, Any]] = [((), content)]
        for within, criterion in single if isinstance(content, dict) else [((k,), c) for k, c in _entries(content)]:
            place: Location = ("criteria", kind, *within)
            of, to = criterion.get("of"), criterion.get("to")
            if isinstance(to, str) and split_quantity(to) is not None:
                convert("value", of, *place, "to")
            convert("difference", of, *place, "band")
            if kind == "settling_time":
                convert("value", _measure_in("s"), *place, "max")
            elif kind == "effort":
                convert("integral", of, *place, "max")
            else:  # A peak without a target is a value: at most 80 degC.
                convert("value" if kind == "peak" and not to else "difference", of, *place, "max")
    for name, component in _items(data.get("components")):
        for signal, about in _items(_part(component, "signals")):
            unit = about.get("unit", "") if isinstance(about, dict) else None
            if not isinstance(unit, str):
                continue
            place, measure = ("components", name, "signals", signal), _measure_in(unit)  # Degrees become radians later.
            convert("value", measure, *place, "start")
            for k, _ in _entries(about.get("changes")):
                convert("value", measure, *place, "changes", k, "to")
                convert("rate", measure, *place, "changes", k, "rate")
            convert("difference", measure, *place, "noise", "bias")
            convert("square", measure, *place, "noise", "variance")


def _measure(data: Mapping[str, Any], signal: str, resolve: Resolve) -> Measure | None:
    """Return the unit of a signal and its reader of texts; None if unknown.

    Other checks report unknown signals.
    """
    owner, _, name = signal.partition(".")
    component = _part(data, "components", owner)
    if not isinstance(component, dict):
        return None
    try:
        if isinstance(file := component.get("fmu"), str):
            description = read_description(resolve(file))
            names = {v.name: v for v in description.modelVariables}
            variable = names.get(name) or names.get(name.rpartition("[")[0])
            if variable is None:
                return None
            return unit_of(variable), partial(convert_quantity, description, variable)
        if component.get("block") == "playback" and isinstance(file := component.get("file"), str):
            units = {s.name: s.unit for s in playback(owner, resolve(file), (name,)).outputs}
            return _measure_in(units[name]) if name in units else None
    except (FmuError, InputError, OSError, ValueError):
        return None
    about = _part(component, "signals", name) or _part(component, "signals", name.removesuffix("_meas"))
    unit = about.get("unit", "") if isinstance(about, dict) else None
    is_reference = component.get("block") == "reference"
    return _measure_in(computed_in(unit)[0] if is_reference else unit) if isinstance(unit, str) else None


def _measure_in(unit: str) -> Measure:
    return unit, lambda text, difference: read_quantity(text, unit, difference=difference)


def _items(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the entries of a mapping, none of other data."""
    yield from content.items() if isinstance(content, dict) else ()


def _entries(content: Any) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the mappings of a list with their indices."""
    for k, entry in enumerate(content if isinstance(content, list) else ()):
        if isinstance(entry, dict):
            yield k, entry


def _part(data: Any, *location: str | int) -> Any:
    """Return the data at a location, if any."""
    try:
        for step in location:
            data = data[step]
    except (KeyError, IndexError, TypeError):
        return None
    return data
