"""Common reading of SSP documents: numbers, units, transformations, faults and warnings."""

from __future__ import annotations

import math

from cosim.base.errors import Fault, InputError
from cosim.ssp.elements import Element
from cosim.ssp.ssp_package import Package
from cosim.ssp.structure import Definition, Linear, Units
from cosim.storage.yaml_file import MOST_FAULTS, shown

VERSIONS = ("1.0", "2.0")
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
OTHER_TRANSFORMATIONS = (
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)


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

    def _linear(self, element: Element, exact: bool) -> Linear:
        for other in OTHER_TRANSFORMATIONS:
            if (found := element.first(other)) is not None:
                self.note(found, "is not run here; ssc:LinearTransformation is, or let the FMU map it")
        found = element.first("ssc:LinearTransformation") or element.first("ssd:LinearTransformation")
        if found is None:
            return Linear(exact=exact)
        factor, offset = self._number(found, "factor", 1.0), self._number(found, "offset", 0.0)
        return Linear(1.0 if factor is None else factor, offset or 0.0, exact)

    def _units(self, listed: Element | None) -> Units:
        found: dict[str, Definition] = {}
        for unit in () if listed is None else listed.all("ssc:Unit"):
            base = unit.first("ssc:BaseUnit")
            name = unit.get("name")
            if name and base is not None:
                numbers = [self._number(base, n, 0.0) for n in BASE_UNITS]
                numbers += [self._number(base, "factor", 1.0), self._number(base, "offset", 0.0)]
                if numbers[-2] == 0.0:
                    self.note(base, "factor 0 is that of no unit")
                elif None not in numbers:
                    found[name] = tuple(n for n in numbers if n is not None)
        return found

    def _number(self, element: Element, name: str, default: float | None, needed: bool = False) -> float | None:
        text = element.get(name)
        if text is None:
            if needed:
                self.note(element, f"it has no {name}; add it")
            return default
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.note(element, f"{name} {shown(text)}: it is a finite number")
            return default
        return value

    def _version(self, root: Element) -> None:
        version = root.get("version")
        if version not in VERSIONS:
            self.note(root, f"version {shown(version)} is not known here; {' and '.join(VERSIONS)} are")
