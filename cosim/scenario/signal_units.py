"""Unit conversion of scenario values that are in the unit of a signal, before validation.

Quantities with a fixed unit, such as `duration`, are converted by `cosim.storage.yaml_file.InUnit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cosim.base.errors import FmuError, InputError
from cosim.base.units import allowed_quantity, computed_in, has_unit, read_quantity, split_quantity, square_unit
from cosim.blocks.description import read_description, unit_of
from cosim.blocks.sources import playback
from cosim.scenario.start_values import convert_quantity
from cosim.storage.yaml_file import format_value, wrong_value
from cosim.storage.yaml_nodes import Location

STAND_IN = 1.0  # replaces a faulty quantity, so that checks can go on
Resolve = Callable[[str], Path]
Note = Callable[[Location, str], None]


class Measure(NamedTuple):
    """Unit of a signal, and a function from (text, is difference) to a number in this unit.

    The function may raise ValueError.
    """

    unit: str
    number: Callable[[str, bool], float]

    def of_kind(self, kind: str, text: str) -> float:
        """Return the number of a text.

        Args:
            kind: `value`, `difference`, `square`, `rate` (per second) or `integral` (over time).
        """
        if not has_unit(text):
            raise ValueError(allowed_quantity(self.unit))
        if kind in {"value", "difference"}:
            return self.number(text, kind == "difference")
        units = {
            "square": square_unit(self.unit),
            "rate": f"{self.unit or '1'}/s",
            "integral": f"{self.unit}.s".lstrip("."),
        }
        return read_quantity(text, units[kind], difference=True)


def convert_quantities(data: dict[str, Any], resolve: Resolve, note: Note) -> None:
    """Convert text such as `2 deg` to the signal's unit, in place.

    Args:
        note: Called with place and message of each fault.
    """
    measures: dict[str, Measure | None] = {}
    for location, of, kind in _places(data):
        *path, last = location
        text = _part(data, *location)
        if not isinstance(text, str) or not isinstance(of, (str, Measure)):
            continue
        parent, name = _part(data, *path), ".".join(map(str, location))
        parent[last] = STAND_IN
        if isinstance(of, str) and of not in measures:
            measures[of] = _measure(data, of, resolve)
        measure = measures[of] if isinstance(of, str) else of
        if measure is None:
            unknown = f"{name} is {format_value(text)}: the unit of {of} is not known"
            note(location, f"{unknown}; write a number alone")
            continue
        try:
            parent[last] = measure.of_kind(kind, text)
        except ValueError as error:
            note(location, wrong_value(name, text, str(error)))


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
            return Measure(unit_of(variable), partial(convert_quantity, description, variable))
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
    return Measure(unit, lambda text, difference: read_quantity(text, unit, difference=difference))


def _places(data: dict[str, Any]) -> Iterator[tuple[Location, Any, str]]:
    """Yield quantities in the unit of a signal: place, the signal or the measure itself, and kind of `Measure.of_kind`.

    Values and signals may be of any type.
    """
    for k, connection in _entries(data.get("connections")):
        at, to = ("connections", k), connection.get("to")
        yield (*at, "offset"), to, "difference"
        yield (*at, "noise", "bias"), to, "difference"
        yield (*at, "noise", "variance"), to, "square"
    for k, fault in _entries(data.get("faults")):
        of = _measure_in("1") if fault.get("kind") == "scale" else fault.get("on")
        yield ("faults", k, "value"), of, "value" if fault.get("kind") == "stuck" else "difference"
    for kind, content in _items(data.get("criteria")):
        single: list[tuple[Location, Any]] = [((), content)]
        for within, criterion in single if isinstance(content, dict) else [((k,), c) for k, c in _entries(content)]:
            place: Location = ("criteria", kind, *within)
            of, to = criterion.get("of"), criterion.get("to")
            if isinstance(to, str) and split_quantity(to) is not None:
                yield (*place, "to"), of, "value"
            yield (*place, "band"), of, "difference"
            if kind == "settling_time":
                yield (*place, "max"), _measure_in("s"), "value"
            elif kind == "effort":
                yield (*place, "max"), of, "integral"
            else:  # A peak without a target is a value: at most 80 degC.
                yield (*place, "max"), of, "value" if kind == "peak" and not to else "difference"
    for name, component in _items(data.get("components")):
        for signal, about in _items(_part(component, "signals")):
            unit = about.get("unit", "") if isinstance(about, dict) else None
            if not isinstance(unit, str):
                continue
            place, measure = ("components", name, "signals", signal), _measure_in(unit)  # Degrees become radians later.
            yield (*place, "start"), measure, "value"
            for k, _ in _entries(about.get("changes")):
                yield (*place, "changes", k, "to"), measure, "value"
                yield (*place, "changes", k, "rate"), measure, "rate"
            yield (*place, "noise", "bias"), measure, "difference"
            yield (*place, "noise", "variance"), measure, "square"


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
