"""Quantities of a scenario in the unit of a signal, whose texts such as `2 deg` wait until the scenario is known.

Quantities with a fixed unit, such as `duration`, are converted by `cosim.files.yaml_file.InUnit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

from cosim.blocks.sources import playback
from cosim.core.errors import FmuError, InputError
from cosim.core.units import computed_in, has_unit, read_quantity, square_unit
from cosim.files.yaml_nodes import Location
from cosim.fmi.description import read_description, unit_of
from cosim.scenario.scenario import FmuComponent, Noise, PlaybackComponent, ReferenceComponent, Scenario, Variable
from cosim.scenario.start_values import convert_quantity

STAND_IN = 1.0  # replaces a faulty quantity, so that checks can go on
Resolve = Callable[[str], Path]
# unit of a signal, and a function from (text, difference=) to a number in this unit, which may raise ValueError
Measure = tuple[str, Callable[..., float]]
# place, number or text, kind (value, difference, square, rate per second, integral over time), signal or its measure
Quantity = tuple[Location, float | str | None, str, Variable | Measure]


def waiting_texts(
    scenario: Scenario, places: Mapping[str, Sequence[int]], resolve: Resolve
) -> Iterator[tuple[Location, str, Callable[[str], float]]]:
    """Yield place, text and reader of each text in the unit of a signal; a reader may raise ValueError.

    Args:
        places: Indices in the file of connections and faults.
    """
    measure = cache(partial(_measure, scenario, resolve))
    for at, text, kind, of in _quantities(scenario, places):
        if isinstance(text, str):
            yield at, text, partial(_read, kind, measure, of)


def _quantities(scenario: Scenario, places: Mapping[str, Sequence[int]]) -> Iterator[Quantity]:
    for k, connection in zip(places["connections"], scenario.connections, strict=True):
        yield ("connections", k, "offset"), connection.offset, "difference", connection.target
        yield from _of_noise(("connections", k, "noise"), connection.noise, connection.target)
    for k, fault in zip(places["faults"], scenario.faults, strict=True):
        of = _measure_in("1") if fault.kind == "scale" else fault.on
        yield ("faults", k, "value"), fault.value, "value" if fault.kind == "stuck" else "difference", of
    for goal, index, criterion in scenario.goals:
        at: Location = ("criteria", goal) if index is None else ("criteria", goal, index)
        if isinstance(criterion.to, str) and has_unit(criterion.to):  # other text names a signal
            yield (*at, "to"), criterion.to, "value", criterion.of
        yield (*at, "band"), criterion.band, "difference", criterion.of
        if goal == "settling_time":
            yield (*at, "max"), criterion.max, "value", _measure_in("s")
        else:  # A peak without a target is a value: at most 80 degC.
            is_value = goal == "peak" and not criterion.to
            kind = "integral" if goal == "effort" else "value" if is_value else "difference"
            yield (*at, "max"), criterion.max, kind, criterion.of
    for name, component in scenario.components.items():
        if isinstance(component, FmuComponent | PlaybackComponent):
            continue
        for signal, about in component.signals.items():
            at, measure = ("components", name, "signals", signal), _measure_in(about.unit)
            if not isinstance(component, ReferenceComponent):
                yield from _of_noise((*at, "noise"), about.noise, measure)
                continue
            yield (*at, "start"), about.start, "value", measure  # Degrees become radians later.
            for k, change in enumerate(about.changes):
                yield (*at, "changes", k, "to"), change.to, "value", measure
                yield (*at, "changes", k, "rate"), change.rate, "rate", measure


def _of_noise(at: Location, noise: Noise | None, of: Variable | Measure) -> Iterator[Quantity]:
    if noise is not None:
        yield (*at, "bias"), noise.bias, "difference", of
        yield (*at, "variance"), noise.variance, "square", of


def _measure(scenario: Scenario, resolve: Resolve, signal: str) -> Measure | None:
    """Return the unit of a signal and its reader of texts; None if its component has a fault, reported elsewhere."""
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
    except (FmuError, InputError, OSError, ValueError, KeyError):
        raise ValueError(f"the unit of {signal} is not known; write a number alone") from None
    return _measure_in(computed_in(unit)[0] if isinstance(component, ReferenceComponent) else unit)


def _measure_in(unit: str) -> Measure:
    return unit, partial(read_quantity, unit=unit)


def _read(kind: str, measure: Callable[[str], Measure | None], of: Variable | Measure, text: str) -> float:
    if (unit_and_reader := measure(of) if isinstance(of, str) else of) is None:
        return STAND_IN
    unit, number = unit_and_reader
    if kind in {"value", "difference"}:
        return number(text, difference=kind == "difference")
    compound = {"square": square_unit(unit), "rate": f"{unit or '1'}/s", "integral": f"{unit}.s".lstrip(".")}
    return read_quantity(text, compound[kind], difference=True)
