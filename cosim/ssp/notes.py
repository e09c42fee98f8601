"""Common reading of SSP documents: numbers, units, transformations, faults and warnings."""

from __future__ import annotations

import math
from typing import TypeVar

from cosim.base.errors import Fault, InputError
from cosim.base.units import SI
from cosim.ssp.elements import Element
from cosim.ssp.ssp_package import Package
from cosim.ssp.structure import Definition, LinearTransformation, Units
from cosim.storage.yaml_file import MOST_FAULTS, format_value

VERSIONS = ("1.0", "2.0")
OTHER_TRANSFORMATIONS = (
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)
Default = TypeVar("Default", float, None)


class Notes:
    """Faults and warnings of a package's documents."""

    def __init__(self, package: Package) -> None:
        self.package = package
        self.faults: list[Fault] = []
        self.warnings: list[str] = []

    def note(self, element: Element, message: str) -> None:
        """Note a fault of an element; raise InputError at the limit of faults."""
        self.faults.append(element.fault(message))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError(self.faults)

    def warn(self, element: Element, message: str) -> None:
        """Note a warning on an element."""
        self.warnings.append(str(Fault(element.file, element.line, element.column, message)))

    def _linear(self, element: Element) -> LinearTransformation:
        """Return the transformation of a connection or a mapping."""
        exact = element.get("suppressUnitConversion") in {"true", "1"}
        for other in filter(None, map(element.first, OTHER_TRANSFORMATIONS)):
            self.note(other, "is not run here; ssc:LinearTransformation is, or let the FMU map the value")
        linear = element.first("ssc:LinearTransformation") or element.first("ssd:LinearTransformation")
        if linear is None:
            return LinearTransformation(exact=exact)
        return LinearTransformation(self._number(linear, "factor", 1.0), self._number(linear, "offset", 0.0), exact)

    def _units(self, element: Element, tag: str) -> Units:
        """Return the units in a child of an element."""
        units: dict[str, Definition] = {}
        for unit in element.all(tag, "ssc:Unit"):
            base, name = unit.first("ssc:BaseUnit"), unit.get("name")
            if name and base is not None:
                numbers = [self._number(base, n, 0.0) for n in SI]
                numbers += [self._number(base, "factor", 1.0), self._number(base, "offset", 0.0)]
                if numbers[-2] == 0.0:
                    self.note(base, "factor 0 is that of no unit; give another")
                else:
                    units[name] = tuple(numbers)
        return units

    def _number(self, element: Element, name: str, default: Default) -> float | Default:
        """Return the number in an attribute, the default for a missing or faulty number; note the fault."""
        text = element.get(name)
        if text is None:
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.note(element, f"{name} {format_value(text)}: it is a finite number")
            return default
        return value

    def _version(self, root: Element) -> None:
        version = root.get("version")
        if version not in VERSIONS:
            self.note(root, f"version {format_value(version)} is not known here; {' and '.join(VERSIONS)} are")
