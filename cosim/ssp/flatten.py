"""Flattening of nested systems to a list of FMUs, start values and connections."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, count

from cosim.base.errors import FmuError, InputError
from cosim.blocks.component import Signal
from cosim.blocks.description import is_difference, read_description, unit_definition, unit_of
from cosim.ssp.elements import Element
from cosim.ssp.levels import Flat, FmuPart, Level, SignalLink, direct_connections, levels
from cosim.ssp.read import Reader
from cosim.ssp.structure import (
    Connector,
    LinearTransformation,
    SspComponent,
    SspConnection,
    SspParameter,
    SspStructure,
    SspSystem,
    Units,
)
from cosim.storage.yaml_file import did_you_mean, format_value

Hops = tuple[tuple[Level, SspConnection], ...]  # successive connections with their levels, from the source
Target = tuple[FmuPart, str, Hops]  # a variable of an FMU and the connections to it


def read(reader: Reader) -> tuple[SspStructure, Flat]:
    """Return the structure of an SSP and its flat system without faulty parts; raise InputError without one."""
    structure = reader.structure()
    if structure is None:
        raise InputError(reader.faults)
    return structure, _Flattener(structure, reader).flat()


class _Flattener:
    def __init__(self, structure: SspStructure, reader: Reader) -> None:
        self.structure, self.reader = structure, reader
        self.parts: dict[str, FmuPart] = {}  # by name

    def flat(self) -> Flat:
        root = self._level(direct_connections(self.structure.system), None, ())
        self._check(root)
        self._parameters(root)
        links = [link for level in levels(root) for link in self._links(level)]
        return Flat(tuple(self.parts.values()), tuple(links))

    def _level(self, system: SspSystem, parent: Level | None, path: tuple[str, ...]) -> Level:
        level = Level(system, parent)
        for name, element in system.elements.items():
            if isinstance(element, SspSystem):
                level.systems[name] = self._level(element, level, (*path, name))
            elif (part := self._part(element, (*path, name))) is not None:
                level.parts[name] = self.parts[part.name] = part
        return level

    def _part(self, component: SspComponent, path: tuple[str, ...]) -> FmuPart | None:
        if not component.fmu.name:  # This fault has already been noted.
            return None
        try:
            description = read_description(component.fmu)
        except FmuError as error:
            self.reader.faults.append(replace(component.element.fault(str(error)), exit_code=error.exit_code))
            return None
        variables = {v.name: v for v in description.modelVariables}
        part = FmuPart(self._name(path), ".".join(path), component, description, variables)
        for name, connector in component.connectors.items():
            if name not in variables and connector.kind in {"input", "output", "parameter"}:
                hint = did_you_mean(name, variables)
                self.reader.note(connector.element, f"{component.fmu.name} has no such variable{hint}")
        return part

    def _name(self, path: tuple[str, ...]) -> str:
        """Return a unique component name for scenarios."""
        name = re.sub(r"[^A-Za-z0-9_]", "_", "_".join(path))
        name = f"_{name}" if name[:1].isdigit() else name
        numbered = (f"{name}_{number}" for number in count(2))
        return next(unique for unique in chain([name], numbered) if unique not in self.parts)

    # -- connections ----------------------------------------------------------------------------

    def _check(self, root: Level) -> None:
        """Note a fault for each connection with an unknown end, and for each input with several sources."""
        for level in levels(root):
            for connection in level.system.connections:
                for side, (name, connector) in (("start", connection.start), ("end", connection.end)):
                    self._check_end(level, connection.element, side, name, connector)
                if (first := level.into[connection.end]) is not connection:
                    ends = (connection.end, first.start, connection.start)
                    target, one, other = (".".join(filter(None, end)) for end in ends)
                    message = f"two sources for {target}: {one} and {other}; keep one"
                    self.reader.note(connection.element, message)

    def _check_end(self, level: Level, element: Element, side: str, name: str | None, connector: str) -> None:
        elements = level.system.elements
        if name is not None and name not in elements:
            hint = did_you_mean(name, elements)
            self.reader.note(element, f"{side}Element {format_value(name)} is not in its system{hint}")
            return
        connectors = level.system.connectors if name is None else elements[name].connectors
        if connector not in connectors:
            owner, hint = name or "its system", did_you_mean(connector, connectors)
            message = f"{side}Connector: {owner} has no connector {format_value(connector)}{hint}"
            self.reader.note(element, message)

    def _links(self, level: Level) -> Iterator[SignalLink]:
        """Yield the connections to the FMUs of a level, each followed back to the output of an FMU."""
        for connection in level.system.connections:
            part = level.parts.get(connection.end[0] or "")
            if part is None or connection.end[1] not in part.component.connectors:
                continue
            if level.into[connection.end] is not connection:  # With two sources, a noted fault, the first counts.
                continue
            hops = self._hops(level, connection)
            if hops is None:
                continue
            first_level, first = hops[0]
            source = first_level.parts[first.start[0] or ""]
            ends = f"{source.name}.{first.start[1]}", f"{part.name}.{connection.end[1]}"
            yield SignalLink(*ends, self._along(source, hops, connection.element), connection.element)

    def _hops(self, level: Level, last: SspConnection) -> Hops | None:
        """Return the chain of connections from an FMU's output to `last`; None without output."""
        hops: Hops = ((level, last),)
        while True:
            at, connection = hops[0]
            name, connector = connection.start
            if name in at.parts:
                return hops
            outer = at.parent if name is None else at.systems.get(name)  # from outside, or from inside
            if outer is None:
                return None
            before = outer.into.get((at.system.name if name is None else None, connector))
            if before is None or any(before is hop for _, hop in hops):
                return None
            hops = ((outer, before), *hops)

    def _along(self, source: FmuPart, hops: Hops, element: Element) -> LinearTransformation | None:
        """Return the conversion of a value along a chain of connections; None if the FMUs' units suffice."""
        output = hops[0][1].start[1]
        first = source.component.connectors.get(output)
        ends = [self._end(*hop) for hop in hops]
        stages = [(signal, connection.linear) for (_, signal), (_, connection) in zip(ends, hops, strict=True)]
        factors = self._chain(self._signal(source, output, first), stages, element)
        has_units = any(connector and connector.unit is not None for connector in (first, *(c for c, _ in ends)))
        if factors is None or not (has_units or any(linear != LinearTransformation() for _, linear in stages)):
            return None
        return LinearTransformation(*factors)

    def _end(self, level: Level, connection: SspConnection) -> tuple[Connector | None, Signal]:
        name, variable = connection.end
        part = level.parts.get(name or "")
        if part is not None:
            connector = part.component.connectors.get(variable)
            return connector, self._signal(part, variable, connector)
        return self._boundary(level.system if name is None else level.systems[name].system, variable)

    def _boundary(self, system: SspSystem, name: str) -> tuple[Connector | None, Signal]:
        """Return a system's own connector and its signal."""
        connector = system.connectors.get(name)
        unit = (connector.unit if connector else None) or ""
        # Whether a value is a difference is known from the variables at the ends.
        return connector, Signal(name, unit, self.structure.units.get(unit), relative=True)

    def _signal(self, part: FmuPart, name: str, connector: Connector | None) -> Signal:
        """Return a variable of an FMU as a signal, in the unit of its connector or else in its own unit."""
        variable = part.variables.get(name)
        own = "" if variable is None else unit_of(variable)
        unit = own if connector is None or connector.unit is None else connector.unit
        definitions = self.structure.units.get(unit), unit_definition(part.description, unit)
        is_own = connector is None or connector.unit is None  # The units of a file are defined in this file.
        definition = definitions[is_own] or definitions[not is_own]
        return Signal(name, unit, definition, relative=variable is not None and is_difference(variable))

    def _chain(
        self, signal: Signal, stages: Iterable[tuple[Signal, LinearTransformation]], element: Element
    ) -> tuple[float, float] | None:
        """Return factor and offset of successive unit conversions, each followed by its transformation."""
        factor, offset = 1.0, 0.0
        for target, linear in stages:
            unit = (1.0, 0.0) if linear.exact else signal.conversion(target)
            if unit is None:
                self.reader.note(
                    element,
                    (
                        f"unit mismatch: [{signal.unit}] to [{target.unit}]; where they are the same all the same, "
                        'say so by suppressUnitConversion="true"'
                    ),
                )
                return None
            factor *= unit[0] * linear.factor
            offset = offset * (unit[0] * linear.factor) + (unit[1] * linear.factor + linear.offset)
            signal = target if target.unit or linear.exact else signal
        return factor, offset

    # -- parameters -----------------------------------------------------------------------------

    def _parameters(self, level: Level) -> None:
        """Apply start values from inner to outer systems.

        Outer values override inner ones; in the same place the last wins.
        """
        for part in level.parts.values():
            for parameter in part.component.parameters:
                if parameter.name in part.variables:
                    self._set_start(part, parameter.name, parameter, ())
                else:
                    self._warn_of_name(parameter, part.variables)
        for inner in level.systems.values():
            self._parameters(inner)
        for parameter in level.system.parameters:
            targets = list(self._targets(level, parameter.name))
            for part, variable, hops in targets:
                self._set_start(part, variable, parameter, hops)
            if not targets and parameter.name in level.system.connectors:
                self.reader.warn(
                    parameter.element, f"parameter {format_value(parameter.name)} leads to no FMU, and is left out"
                )
            elif not targets:
                self._warn_of_name(parameter, chain(level.system.connectors, self._names(level)))

    def _targets(self, level: Level, name: str) -> Iterator[Target]:
        """Yield the FMU variables of a hierarchical name."""
        if name in level.system.connectors:
            yield from self._forward(level, name, ())
        for element, part in level.parts.items():
            if name.startswith(f"{element}.") and (rest := name[len(element) + 1 :]) in part.variables:
                yield part, rest, ()
        for element, inner in level.systems.items():
            if name.startswith(f"{element}."):
                yield from self._targets(inner, name[len(element) + 1 :])

    def _forward(self, level: Level, connector: str, hops: Hops) -> Iterator[Target]:
        """Yield the FMU inputs inside a system that are connected to a connector of the system."""
        for connection in level.system.connections:
            # With two sources, a noted fault, the first counts.
            if connection.start != (None, connector) or level.into[connection.end] is not connection:
                continue
            name, variable = connection.end
            further = (*hops, (level, connection))
            if name in level.parts and variable in level.parts[name].variables:
                yield level.parts[name], variable, further
            elif name in level.systems:
                yield from self._forward(level.systems[name], variable, further)

    def _set_start(self, part: FmuPart, variable: str, parameter: SspParameter, hops: Hops) -> None:
        """Set a start value of an FMU, converted to the unit of its variable."""
        value = parameter.value
        if not isinstance(value, (bool, str)):
            first = self._signal(part, variable, None)
            if hops:  # The parameter is of the connector of a system, from which connections lead inside.
                first = self._boundary(hops[0][0].system, hops[0][1].start[1])[1]
            stages = [(self._end(level, connection)[1], connection.linear) for level, connection in hops]
            factors = self._chain(self._of(parameter), [(first, parameter.linear), *stages], parameter.element)
            if factors is None:
                return
            value = value if factors == (1.0, 0.0) else value * factors[0] + factors[1]
        part.start[variable] = value, parameter.element

    def _of(self, parameter: SspParameter) -> Signal:
        unit = parameter.unit or ""
        units: Units = {**self.structure.units, **parameter.units}
        if unit not in units and unit.startswith("[") and unit.endswith("]"):  # some tools write units in brackets
            unit = unit[1:-1]
        return Signal(parameter.name, unit, units.get(unit), relative=True)

    def _warn_of_name(self, parameter: SspParameter, names: Iterable[str]) -> None:
        hint = did_you_mean(parameter.name, names)
        message = f"parameter {format_value(parameter.name)} is of nothing here, and is left out{hint}"
        self.reader.warn(parameter.element, message)

    def _names(self, level: Level) -> Iterator[str]:
        """Yield the hierarchical names in a system."""
        for element, part in level.parts.items():
            yield from (f"{element}.{variable}" for variable in part.variables)
        for element, inner in level.systems.items():
            yield from (f"{element}.{name}" for name in self._names(inner))
