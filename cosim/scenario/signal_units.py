"""Unit conversion of scenario values that are in the unit of a signal, before validation.

Quantities with a fixed unit, such as `duration`, are converted by `cosim.storage.yaml_file.InUnit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cosim.base.errors import FmuError, InputError
from cosim.base.units import allowed_quantity, computed_in, has_unit, read_quantity, split_quantity, square_unit
from cosim.blocks.description import read_description, unit_of
from cosim.blocks.sources import playback
from cosim.scenario.start_values import Misfit, convert_quantity
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


@dataclass(frozen=True)
class Place:
    """A value in a scenario whose unit depends on a signal.

    Attributes:
        location: Place in the file.
        of: Signal as `component.variable`, or the measure itself.
        kind: Relation to the signal, see `Measure.of_kind`.
    """

    location: Location
    of: str | Measure
    kind: str


def convert_quantities(data: dict[str, Any], resolve: Resolve, note: Note) -> None:
    """Convert text such as `2 deg` to the signal's unit, in place.

    Args:
        note: Called with place and message of each fault.
    """
    measures: dict[str, Measure | None] = {}
    for place in _places(data):
        *path, last = place.location
        parent = _part(data, *path)
        text, parent[last] = parent[last], STAND_IN
        name = ".".join(map(str, place.location))
        measure: str | Measure | None = place.of
        if isinstance(measure, str):
            if measure not in measures:
                measures[measure] = _measure(data, measure, resolve)
            measure = measures[measure]
        if measure is None:
            note(
                place.location,
                f"{name} is {format_value(text)}: the unit of {place.of} is not known; write a number alone",
            )
            continue
        try:
            parent[last] = measure.of_kind(place.kind, text)
        except ValueError as error:
            note(place.location, wrong_value(name, text, str(error)))


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
            return _of_fmu(resolve(file), name)
        if component.get("block") == "playback" and isinstance(file := component.get("file"), str):
            units = {s.name: s.unit for s in playback(owner, resolve(file), (name,)).outputs}
            return _measure_in(units[name]) if name in units else None
    except (FmuError, InputError, OSError, ValueError):
        return None
    about = _part(component, "signals", name) or _part(component, "signals", name.removesuffix("_meas"))
    unit = about.get("unit", "") if isinstance(about, dict) else None
    is_reference = component.get("block") == "reference"
    return _measure_in(computed_in(unit)[0] if is_reference else unit) if isinstance(unit, str) else None


def _of_fmu(path: Path, name: str) -> Measure | None:
    description = read_description(path)
    names = {v.name: v for v in description.modelVariables}
    variable = names.get(name) or names.get(name.rpartition("[")[0])
    if variable is None:
        return None

    def number(text: str, difference: bool) -> float:
        value = convert_quantity(description, variable, text, difference=difference)
        if isinstance(value, Misfit):
            raise ValueError(value.reason)
        return value

    return Measure(unit_of(variable), number)


def _measure_in(unit: str) -> Measure:
    return Measure(unit, lambda text, difference: read_quantity(text, unit, difference=difference))


def _places(data: dict[str, Any]) -> Iterator[Place]:
    """Yield the places of all quantities written as text."""
    for place in (*_of_connections(data), *_of_faults(data), *_of_criteria(data), *_of_components(data)):
        if isinstance(_part(data, *place.location), str):
            yield place


def _of_connections(data: Mapping[str, Any]) -> Iterator[Place]:
    for k, connection in _entries(data.get("connections")):
        if isinstance(target := connection.get("to"), str):
            yield Place(("connections", k, "offset"), target, "difference")
            yield Place(("connections", k, "noise", "bias"), target, "difference")
            yield Place(("connections", k, "noise", "variance"), target, "square")


def _of_faults(data: Mapping[str, Any]) -> Iterator[Place]:
    for k, fault in _entries(data.get("faults")):
        if isinstance(target := fault.get("on"), str):
            at = ("faults", k, "value")
            kind = "value" if fault.get("kind") == "stuck" else "difference"
            yield Place(at, _measure_in("1") if fault.get("kind") == "scale" else target, kind)


def _of_criteria(data: Mapping[str, Any]) -> Iterator[Place]:
    criteria = data.get("criteria")
    for kind, content in criteria.items() if isinstance(criteria, dict) else ():
        single: list[tuple[Location, Any]] = [((), content)]
        for within, criterion in single if isinstance(content, dict) else [((k,), c) for k, c in _entries(content)]:
            at: Location = ("criteria", kind, *within)
            signal = criterion.get("of")
            if not isinstance(signal, str):
                continue
            if isinstance(to := criterion.get("to"), str) and split_quantity(to) is not None:
                yield Place((*at, "to"), signal, "value")
            yield Place((*at, "band"), signal, "difference")
            if kind == "settling_time":
                yield Place((*at, "max"), _measure_in("s"), "value")
            elif kind == "effort":
                yield Place((*at, "max"), signal, "integral")
            else:  # A peak without a target is a value: at most 80 degC.
                yield Place((*at, "max"), signal, "value" if kind == "peak" and not to else "difference")


def _of_components(data: Mapping[str, Any]) -> Iterator[Place]:
    components = data.get("components")
    for name, component in components.items() if isinstance(components, dict) else ():
        signals = component.get("signals") if isinstance(component, dict) else None
        for signal, about in signals.items() if isinstance(signals, dict) else ():
            unit = about.get("unit", "") if isinstance(about, dict) else None
            if not isinstance(unit, str):
                continue
            at: Location = ("components", name, "signals", signal)
            measure = _measure_in(unit)  # The written unit; degrees become radians later.
            yield Place((*at, "start"), measure, "value")
            for k, _ in _entries(about.get("changes")):
                yield Place((*at, "changes", k, "to"), measure, "value")
                yield Place((*at, "changes", k, "rate"), measure, "rate")
            yield Place((*at, "noise", "bias"), measure, "difference")
            yield Place((*at, "noise", "variance"), measure, "square")


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
