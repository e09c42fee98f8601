"""Reading an SSD with the parameter sets and mappings that it names; every fault is collected with its place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.errors import Fault, InputError
from cosim.ssp.elements import Element
from cosim.ssp.package import Package
from cosim.ssp.structure import (
    Component,
    Connection,
    Connector,
    Definition,
    Linear,
    Parameter,
    Structure,
    System,
    Units,
)
from cosim.yaml_file import MOST_FAULTS, did_you_mean, shown

FMU, SET, MAPPING = (
    "application/x-fmu-sharedlibrary",
    "application/x-ssp-parameter-set",
    "application/x-ssp-parameter-mapping",
)
VERSIONS = ("1.0", "2.0")
WAYS = {"any": None, "CoSimulation": "co-simulation", "ModelExchange": "model-exchange"}
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
REALS = ("Real", "Float64", "Float32")
WHOLE = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
TRUTH = {"true": True, "1": True, "false": False, "0": False}
STEPS = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}  # of OSP, of OMSimulator
OTHER_TRANSFORMATIONS = (
    "ssc:BooleanMappingTransformation",
    "ssc:IntegerMappingTransformation",
    "ssc:EnumerationMappingTransformation",
)


class Reader:
    """Reads one description; `faults` and `warnings` are what it found."""

    def __init__(self, package: Package) -> None:
        self.package = package
        self.faults: list[Fault] = []
        self.warnings: list[str] = []

    def note(self, element: Element, message: str) -> None:
        """Note a fault of an element; of very many the first are enough, and InputError ends the rest."""
        self.faults.append(element.fault(message))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError(self.faults)

    def warn(self, element: Element, message: str) -> None:
        """Warn of an element."""
        self.warnings.append(str(Fault(element.file, element.line, element.column, message)))

    def structure(self) -> Structure | None:
        """The description; None where it is none, which is noted."""
        root = self.package.element(self.package.structure)
        if root.tag != "ssd:SystemStructureDescription":
            self.note(root, "it should be ssd:SystemStructureDescription")
            return None
        self._version(root)
        system = root.first("ssd:System")
        if system is None:
            self.note(root, "it has no ssd:System; add one")
            return None
        experiment = root.first("ssd:DefaultExperiment")
        times = {
            n: None if experiment is None else self._number(experiment, n, None) for n in ("startTime", "stopTime")
        }
        return Structure(
            root.get("name") or "system",
            system.get("description") or root.get("description") or "",
            self._system(system),
            self._units(root.first("ssd:Units")),
            times["startTime"],
            times["stopTime"],
            self._step(root, system, experiment),
            root if experiment is None else experiment,
            self.warnings,
        )

    # -- systems --------------------------------------------------------------------------------

    def _system(self, element: Element) -> System:
        elements: dict[str, System | Component] = {}
        inner = element.first("ssd:Elements")
        for child in () if inner is None else inner.children:
            if (found := self._element(child)) is not None:
                if found.name in elements:
                    self.note(child, "another element has this name; rename one of them")
                elements[found.name] = found
        listed = element.first("ssd:Connections")
        connections = () if listed is None else tuple(self._connection(c) for c in listed.all("ssd:Connection"))
        if (dictionaries := element.first("ssd:SignalDictionaries")) is not None and dictionaries.children:
            self.note(dictionaries, "signal dictionaries are not read here; connect outputs to inputs")
        return System(
            element.get("name") or "",
            self._connectors(element),
            tuple(self._parameters(element)),
            elements,
            tuple(c for c in connections if c is not None),
            element,
        )

    def _element(self, child: Element) -> System | Component | None:
        if child.tag == "ssd:Annotations":
            return None
        if child.tag == "ssd:SignalDictionaryReference":
            self.note(child, "signal dictionaries are not read here; connect outputs to inputs")
            return None
        if child.tag not in {"ssd:Component", "ssd:System"}:
            self.note(child, "is no element of a system; ssd:Component and ssd:System are")
            return None
        if not child.get("name"):
            self.note(child, "it has no name; add one")
            return None
        return self._system(child) if child.tag == "ssd:System" else self._component(child)

    def _component(self, element: Element) -> Component | None:
        kind, source = element.get("type") or FMU, element.get("source")
        path: Path | str = ""
        if kind != FMU:
            cure = (
                "put its systems into this file" if kind == "application/x-ssp-definition" else f"components are {FMU}"
            )
            self.note(element, f"type {shown(kind)} is not read here; {cure}")
        elif not source:
            self.note(element, "it has no source, so there is nothing to run; name its FMU")
        elif isinstance(path := self.package.resolve(source), str):
            self.note(element, path)
        way = element.get("implementation") or "any"
        if way not in WAYS:
            self.note(element, f"implementation {shown(way)} is not run here; {', '.join(WAYS)} are")
        connectors, parameters = self._connectors(element), tuple(self._parameters(element))
        if isinstance(path, str):
            return Component(element.get("name") or "", Path(), None, connectors, parameters, element)
        return Component(element.get("name") or "", path, WAYS.get(way), connectors, parameters, element)

    def _connectors(self, element: Element) -> dict[str, Connector]:
        found: dict[str, Connector] = {}
        listed = element.first("ssd:Connectors")
        for each in () if listed is None else listed.all("ssd:Connector"):
            name = each.get("name")
            if not name:
                self.note(each, "it has no name; add one")
                continue
            if name in found:
                self.note(each, "another connector has this name; keep one of them")
            kinds = [child for child in each.children if child.tag.startswith("ssc:")]
            unit = next((u for child in kinds if (u := child.get("unit"))), None)
            found[name] = Connector(name, each.get("kind") or "", unit, each)
        return found

    def _connection(self, element: Element) -> Connection | None:
        start, end = (element.get(f"{side}Connector") for side in ("start", "end"))
        if not start or not end:
            self.note(element, f"it has no {'startConnector' if not start else 'endConnector'}; add it")
            return None
        exact = element.get("suppressUnitConversion") in {"true", "1"}
        # an empty name is what OMSimulator writes of the system itself
        ends = (element.get("startElement") or None, start), (element.get("endElement") or None, end)
        return Connection(*ends, self._linear(element, exact), element)

    # -- parameters -----------------------------------------------------------------------------

    def _parameters(self, element: Element) -> Iterator[Parameter]:
        """Of the bindings of an element, in their order, under the names that mappings and prefixes give them."""
        listed = element.first("ssd:ParameterBindings")
        for binding in () if listed is None else listed.all("ssd:ParameterBinding"):
            if (kind := binding.get("type") or SET) != SET:
                self.note(binding, f"type {shown(kind)} is not read here; {SET} is")
                continue
            holder = self._referred(
                binding, binding.first("ssd:ParameterValues", "ssv:ParameterSet"), "ssv:ParameterSet"
            )
            if holder is None:
                continue
            prefix = binding.get("prefix") or ""
            values = [replace(p, name=prefix + p.name) for p in self._set(holder)]
            mapping = binding.first("ssd:ParameterMapping")
            yield from values if mapping is None else self._mapped(mapping, values)

    def _referred(self, element: Element, inline: Element | None, tag: str) -> Element | None:
        """What an element holds, or the root of the file that it names."""
        source = element.get("source")
        if source is None:
            if inline is None:
                self.note(element, f"it has neither a source nor {tag} in it; add one")
            return inline
        if (base := element.get("sourceBase") or "SSD") != "SSD":
            self.note(element, f"sourceBase {shown(base)} is not read here; take the file out of the FMU")
            return None
        path = self.package.resolve(source)
        if isinstance(path, str):
            self.note(element, path)
            return None
        try:
            root = self.package.element(path)
        except InputError as error:
            self.faults += error.faults
            return None
        if root.tag != tag:
            self.note(root, f"it should be {tag}")
            return None
        self._version(root)
        return root

    def _set(self, holder: Element) -> Iterator[Parameter]:
        units = self._units(holder.first("ssv:Units"))
        listed = holder.first("ssv:Parameters")
        for each in () if listed is None else listed.all("ssv:Parameter"):
            name = each.get("name")
            typed = next((c for c in each.children if c.tag.startswith("ssv:")), None)
            if not name or typed is None:
                self.note(each, "it has no name; add one" if not name else "it has no value; add one such as ssv:Real")
                continue
            value = self._value(typed)
            if value is not None:
                yield Parameter(name, value, typed.get("unit"), units, each)

    def _value(self, typed: Element) -> Any:
        """A value in the type that its element says; None where it is none, which is noted."""
        kind, text = typed.tag.partition(":")[2], typed.get("value")
        if text is None and (entries := list(typed.all("ssv:Item")) or list(typed.all("ssv:Value"))):
            self.note(typed, f"{len(entries)} values; arrays are not read here, bind their elements by name")
            return None
        if kind in REALS:
            return self._number(typed, "value", None, needed=True)
        if kind in WHOLE:
            value = self._number(typed, "value", None, needed=True)
            if value is not None and value != int(value):
                self.note(typed, f"value {shown(text)}: it is a whole number")
                return None
            return None if value is None else int(text) if text and text.strip().lstrip("+-").isdigit() else int(value)
        if kind == "Boolean":
            if text not in TRUTH:
                self.note(typed, f"value {shown(text)}: it is true or false")
            return TRUTH.get(text or "")
        if kind in {"String", "Enumeration", "Binary"}:
            if text is None:
                self.note(typed, "it has no value; add it")
            return text
        self.note(
            typed, f"is no type of a value{did_you_mean(kind, (*REALS, *WHOLE, 'Boolean', 'String', 'Enumeration'))}"
        )
        return None

    def _mapped(self, mapping: Element, values: list[Parameter]) -> Iterator[Parameter]:
        """Parameters under the names that a mapping gives them; those that it does not name are not applied."""
        holder = self._referred(mapping, mapping.first("ssm:ParameterMapping"), "ssm:ParameterMapping")
        if holder is None:
            return
        known: dict[str, list[Parameter]] = {}
        for value in values:
            known.setdefault(value.name, []).append(value)
        for entry in holder.all("ssm:MappingEntry"):
            source, target = entry.get("source"), entry.get("target")
            if source == "" and target:  # prepared, of nothing
                continue
            if not source or not target:
                self.note(entry, f"it has no {'target' if source else 'source'}; add it")
                continue
            if source not in known:
                hint = did_you_mean(source, known)
                self.warn(entry, f"the parameter set has no {shown(source)}{hint}")
            linear = self._linear(entry, entry.get("suppressUnitConversion") in {"true", "1"})
            for value in known.get(source, ()):
                if linear != Linear(exact=linear.exact) and isinstance(value.value, (bool, str)):
                    self.note(entry, f"a linear transformation of {shown(value.value)}; it takes numbers")
                    continue
                yield replace(value, name=target, linear=linear)

    # -- parts ----------------------------------------------------------------------------------

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

    def _step(self, root: Element, system: Element, experiment: Element | None) -> float | None:
        """The communication step that an annotation of another tool names."""
        for holder in (experiment, system, root):
            annotations = None if holder is None else holder.first("ssd:Annotations")
            for element in () if annotations is None else _within(annotations):
                attribute = STEPS.get(element.tag.rpartition(":")[2])
                if attribute and element.get(attribute) is not None:
                    return self._number(element, attribute, None)
        return None

    def _version(self, root: Element) -> None:
        version = root.get("version")
        if version not in VERSIONS:
            self.note(root, f"version {shown(version)} is not known here; {' and '.join(VERSIONS)} are")


def _within(element: Element) -> Iterator[Element]:
    """All elements in one."""
    for child in element.children:
        yield child
        yield from _within(child)
