"""Flattening of nested systems to a list of FMUs, start values and connections."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import chain

from cosim.base.errors import FmuError, InputError
from cosim.blocks.component import Signal
from cosim.blocks.description import read_description, unit_definition, unit_of
from cosim.ssp.elements import Element
from cosim.ssp.levels import Flat, Level, Link, Part, directed, levels
from cosim.ssp.read import Reader
from cosim.ssp.structure import Component, Connection, Connector, Linear, Parameter, Structure, System, Units
from cosim.storage.yaml_file import did_you_mean, shown


def flatten(structure: Structure, reader: Reader) -> Flat:
    """Return the FMUs and connections; the reader gets faults and warnings."""
    return _Flattener(structure, reader).flat()


class _Flattener:
    def __init__(self, structure: Structure, reader: Reader) -> None:
        self.structure, self.reader = structure, reader
        self.parts: list[Part] = []
        self.taken: set[str] = set()

    def flat(self) -> Flat:
        root = self._level(directed(self.structure.system), None, ())
        self._check(root)
        self._parameters(root)
        links = [link for level in levels(root) for link in self._links(level)]
        return Flat(tuple(self.parts), tuple(links))

    def _level(self, system: System, parent: Level | None, path: tuple[str, ...]) -> Level:
        level = Level(system, parent)
        for name, element in system.elements.items():
            if isinstance(element, System):
                level.systems[name] = self._level(element, level, (*path, name))
            elif (part := self._part(element, (*path, name))) is not None:
                level.parts[name] = part
                self.parts.append(part)
        return level

    def _part(self, component: Component, path: tuple[str, ...]) -> Part | None:
        if not component.fmu.name:  # This fault has already been noted.
            return None
        try:
            description = read_description(component.fmu)
        except FmuError as error:
            fault = component.element.fault(str(error))
            self.reader.faults.append(type(fault)(fault.file, fault.line, fault.column, fault.message, error.exit_code))
            return None
        variables = {v.name: v for v in description.modelVariables}
        part = Part(self._name(path), ".".join(path), component, description, variables)
        for name, connector in component.connectors.items():
            if name not in variables and connector.kind in {"input", "output", "parameter"}:
                hint = did_you_mean(name, variables)
                self.reader.note(connector.element, f"{component.fmu.name} has no such variable{hint}")
        return part

    def _name(self, path: tuple[str, ...]) -> str:
        """Return a unique component name for scenarios."""
        name = re.sub(r"[^A-Za-z0-9_]", "_", "_".join(path))
        name = f"_{name}" if name[:1].isdigit() else name
        number = 2
        unique = name
        while unique in self.taken:
            unique, number = f"{name}_{number}", number + 1
        self.taken.add(unique)
        return unique

    # -- connections ----------------------------------------------------------------------------

    def _check(self, root: Level) -> None:
        """Note connections with unknown ends or several sources."""
        for level in levels(root):
            for connection in level.system.connections:
                for side, (name, connector) in (("start", connection.start), ("end", connection.end)):
                    self._check_end(level, connection.element, side, name, connector)
                if (first := level.into[connection.end]) is not connection:
                    ends = (connection.end, first.start, connection.start)
                    where, one, other = (".".join(filter(None, end)) for end in ends)
                    self.reader.note(connection.element, f"two sources for {where}: {one} and {other}; keep one")

    def _check_end(self, level: Level, element: Element, side: str, name: str | None, connector: str) -> None:
        elements = level.system.elements
        if name is not None and name not in elements:
            self.reader.note(element, f"{side}Element {shown(name)} is not in its system{did_you_mean(name, elements)}")
            return
        known = level.system.connectors if name is None else elements[name].connectors
        if connector not in known:
            what = f"{name or 'its system'} has no connector {shown(connector)}{did_you_mean(connector, known)}"
            self.reader.note(element, f"{side}Connector: {what}")

    def _links(self, level: Level) -> Iterator[Link]:
        """Yield connections to a level's FMUs, followed back to outputs."""
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
            linear = self._along(source, hops, connection.element)
            ends = f"{source.name}.{first.start[1]}", f"{part.name}.{connection.end[1]}"
            yield Link(*ends, linear, connection.element)

    def _hops(self, level: Level, last: Connection) -> list[tuple[Level, Connection]] | None:
        """Return the chain of connections from an FMU's output, if any."""
        hops: list[tuple[Level, Connection]] = [(level, last)]
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
            hops.insert(0, (outer, before))

    def _along(self, source: Part, hops: list[tuple[Level, Connection]], element: Element) -> Linear | None:
        """Return a chain's conversion; None if the FMUs' units suffice."""
        first = hops[0][1].start[1]
        now, factor, offset = self._signal(source, first, source.component.connectors.get(first)), 1.0, 0.0
        plain = source.component.connectors[first].unit is None if first in source.component.connectors else True
        for level, connection in hops:
            connector, wanted = self._end(level, connection)
            plain = plain and connection.linear == Linear() and (connector is None or connector.unit is None)
            step = self._converted(now, wanted, connection.linear, element)
            if step is None:
                return None
            factor, offset = factor * step[0], offset * step[0] + step[1]
            now = wanted if wanted.unit or connection.linear.exact else now
        return None if plain else Linear(factor, offset)

    def _end(self, level: Level, connection: Connection) -> tuple[Connector | None, Signal]:
        name, variable = connection.end
        part = level.parts.get(name or "")
        if part is not None:
            connector = part.component.connectors.get(variable)
            return connector, self._signal(part, variable, connector)
        holder = level.system if name is None else level.systems[name].system
        connector = holder.connectors.get(variable)
        unit = (connector.unit if connector else None) or ""
        return connector, Signal(variable, unit, self.structure.units.get(unit))

    def _outer(self, hop: tuple[Level, Connection]) -> Signal:
        """Return the connector from which a connection leads inside."""
        level, connection = hop
        connector = level.system.connectors[connection.start[1]]
        return Signal(connector.name, connector.unit or "", self.structure.units.get(connector.unit or ""))

    def _signal(self, part: Part, name: str, connector: Connector | None) -> Signal:
        """Return an FMU's signal in the connector's unit, else its own."""
        variable = part.variables.get(name)
        own = "" if variable is None else unit_of(variable)
        unit = own if connector is None or connector.unit is None else connector.unit
        definition = self.structure.units.get(unit) or unit_definition(part.description, unit)
        return Signal(name, unit, definition, relative=bool(getattr(variable, "relativeQuantity", False)))

    def _converted(self, now: Signal, wanted: Signal, linear: Linear, element: Element) -> tuple[float, float] | None:
        """Return factor and offset of a connection: unit, then transformation."""
        unit = (1.0, 0.0) if linear.exact else now.conversion(wanted)
        if unit is None:
            cure = 'where they are the same all the same, say so by suppressUnitConversion="true"'
            self.reader.note(element, f"unit mismatch: [{now.unit}] to [{wanted.unit}]; {cure}")
            return None
        return unit[0] * linear.factor, unit[1] * linear.factor + linear.offset

    # -- parameters -----------------------------------------------------------------------------

    def _parameters(self, level: Level) -> None:
        """Apply start values from inner to outer systems.

        Outer values override inner ones; in the same place the last wins.
        """
        for part in level.parts.values():
            for parameter in part.component.parameters:
                if parameter.name in part.variables:
                    self._give(part, parameter.name, parameter, ())
                else:
                    self._nothing(parameter, part.variables)
        for inner in level.systems.values():
            self._parameters(inner)
        for parameter in level.system.parameters:
            targets = list(self._targets(level, parameter.name, ()))
            for part, variable, hops in targets:
                self._give(part, variable, parameter, hops)
            if not targets:
                self._nothing(parameter, chain(level.system.connectors, self._names(level)), level)

    def _targets(
        self, level: Level, name: str, hops: tuple[tuple[Level, Connection], ...]
    ) -> Iterator[tuple[Part, str, tuple[tuple[Level, Connection], ...]]]:
        """Yield all variables for a hierarchical name in a system."""
        if name in level.system.connectors:
            yield from self._forward(level, name, hops)
        for element, part in level.parts.items():
            if name.startswith(f"{element}.") and (rest := name[len(element) + 1 :]) in part.variables:
                yield part, rest, hops
        for element, inner in level.systems.items():
            if name.startswith(f"{element}."):
                yield from self._targets(inner, name[len(element) + 1 :], hops)

    def _forward(
        self, level: Level, connector: str, hops: tuple[tuple[Level, Connection], ...]
    ) -> Iterator[tuple[Part, str, tuple[tuple[Level, Connection], ...]]]:
        """Yield the inner targets of a system's connector."""
        for connection in level.out_of.get((None, connector), ()):
            name, variable = connection.end
            if name is None or level.into[connection.end] is not connection:
                # With two sources, a noted fault, the first counts.
                continue
            further = (*hops, (level, connection))
            if name in level.parts and variable in level.parts[name].variables:
                yield level.parts[name], variable, further
            elif name in level.systems:
                yield from self._forward(level.systems[name], variable, further)

    def _give(
        self, part: Part, variable: str, parameter: Parameter, hops: tuple[tuple[Level, Connection], ...]
    ) -> None:
        """Set a start value in the unit of its variable."""
        value = parameter.value
        if isinstance(value, (bool, str)):
            part.start[variable] = value, parameter.element
            return
        stages = [(self._end(level, connection)[1], connection.linear) for level, connection in hops]
        first = self._outer(hops[0]) if hops else self._signal(part, variable, None)
        now, factor, offset = self._of(parameter), 1.0, 0.0
        for wanted, linear in ((first, parameter.linear), *stages):
            step = self._converted(now, wanted, linear, parameter.element)
            if step is None:
                return
            factor, offset = factor * step[0], offset * step[0] + step[1]
            now = wanted if wanted.unit or linear.exact else now
        plain = factor == 1.0 and offset == 0.0
        part.start[variable] = value if plain else value * factor + offset, parameter.element

    def _of(self, parameter: Parameter) -> Signal:
        unit = parameter.unit or ""
        units: Units = {**self.structure.units, **parameter.units}
        if unit not in units and unit.startswith("[") and unit.endswith("]"):  # some tools write units in brackets
            unit = unit[1:-1]
        return Signal(parameter.name, unit, units.get(unit))

    def _nothing(self, parameter: Parameter, known: Iterable[str], level: Level | None = None) -> None:
        leads = level is not None and parameter.name in level.system.connectors
        hint = "" if leads else did_you_mean(parameter.name, known)
        why = "leads to no FMU" if leads else "is of nothing here"
        self.reader.warn(parameter.element, f"parameter {shown(parameter.name)} {why}, and is left out{hint}")

    def _names(self, level: Level) -> Iterator[str]:
        """Yield the hierarchical names in a system."""
        for element, part in level.parts.items():
            yield from (f"{element}.{variable}" for variable in part.variables)
        for element, inner in level.systems.items():
            yield from (f"{element}.{name}" for name in self._names(inner))


def read(reader: Reader) -> tuple[Structure, Flat]:
    """Return a package flattened, without faulty parts; raise InputError if nothing remains."""
    structure = reader.structure()
    if structure is None:
        raise InputError(reader.faults)
    return structure, flatten(structure, reader)
