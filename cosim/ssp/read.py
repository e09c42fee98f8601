"""Reading of an SSD (system structure description) with its parameter sets and mappings; all faults have places."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from cosim.ssp.elements import Element
from cosim.ssp.parameter_sets import ParameterReader
from cosim.ssp.structure import Connector, SspComponent, SspConnection, SspStructure, SspSystem
from cosim.storage.yaml_file import format_value

SIGNAL_DICTIONARY = "signal dictionaries are not read here; connect outputs to inputs"

FMU = "application/x-fmu-sharedlibrary"
NESTED = "application/x-ssp-definition"
INTERFACES = {"any": None, "CoSimulation": "co-simulation", "ModelExchange": "model-exchange"}
STEPS = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}  # annotations of OSP and of OMSimulator


class Reader(ParameterReader):
    """Reader of a system description."""

    def structure(self) -> SspStructure | None:
        """Return the description; None after noting a fault."""
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
        start, stop = self._times(experiment)
        return SspStructure(
            root.get("name") or "system",
            system.get("description") or root.get("description") or "",
            self._system(system),
            self._units(root, "ssd:Units"),
            start,
            stop,
            self._step(root, system, experiment),
            experiment or root,
        )

    def _system(self, element: Element) -> SspSystem:
        elements: dict[str, SspSystem | SspComponent] = {}
        listed = element.first("ssd:Elements")
        for child in listed.children if listed else ():
            if (inner := self._element(child)) is not None:
                if inner.name in elements:
                    self.note(child, "another element has this name; rename one of them")
                elements[inner.name] = inner
        connections = [self._connection(c) for c in element.all("ssd:Connections", "ssd:Connection")]
        if (dictionaries := element.first("ssd:SignalDictionaries")) is not None and dictionaries.children:
            self.note(dictionaries, SIGNAL_DICTIONARY)
        return SspSystem(
            element.get("name") or "",
            self._connectors(element),
            tuple(self._parameters(element)),
            elements,
            tuple(filter(None, connections)),
            element,
        )

    def _element(self, child: Element) -> SspSystem | SspComponent | None:
        if child.tag == "ssd:SignalDictionaryReference":
            self.note(child, SIGNAL_DICTIONARY)
        elif child.tag not in {"ssd:Component", "ssd:System", "ssd:Annotations"}:
            self.note(child, "is no element of a system; ssd:Component and ssd:System are")
        elif child.tag != "ssd:Annotations" and not child.get("name"):
            self.note(child, "it has no name; add one")
        elif child.tag == "ssd:System":
            return self._system(child)
        elif child.tag == "ssd:Component":
            return self._component(child)
        return None

    def _component(self, element: Element) -> SspComponent:
        kind, source = element.get("type") or FMU, element.get("source")
        fmu: Path | str
        if kind == NESTED:
            fmu = f"type {format_value(kind)} is not read here; put its systems into this file"
        elif kind != FMU:
            fmu = f"type {format_value(kind)} is not read here; components are {FMU}"
        else:
            fmu = (
                self.package.resolve(source) if source else "it has no source, so there is nothing to run; name its FMU"
            )
        if isinstance(fmu, str):
            self.note(element, fmu)
            fmu = Path()
        interface = element.get("implementation") or "any"
        if interface not in INTERFACES:
            names = ", ".join(INTERFACES)
            self.note(element, f"implementation {format_value(interface)} is not run here; {names} are")
        connectors, parameters = self._connectors(element), tuple(self._parameters(element))
        name = element.get("name") or ""
        return SspComponent(name, fmu, INTERFACES.get(interface), connectors, parameters, element)

    def _connectors(self, element: Element) -> dict[str, Connector]:
        connectors: dict[str, Connector] = {}
        for each in element.all("ssd:Connectors", "ssd:Connector"):
            name = each.get("name")
            if not name:
                self.note(each, "it has no name; add one")
                continue
            if name in connectors:
                self.note(each, "another connector has this name; keep one of them")
            units = (child.get("unit") for child in each.children if child.tag.startswith("ssc:"))
            connectors[name] = Connector(name, each.get("kind") or "", next(filter(None, units), None), each)
        return connectors

    def _connection(self, element: Element) -> SspConnection | None:
        start, end = (element.get(f"{side}Connector") for side in ("start", "end"))
        if not start or not end:
            self.note(element, f"it has no {'endConnector' if start else 'startConnector'}; add it")
            return None
        # OMSimulator writes an empty name for the system itself.
        ends = (element.get("startElement") or None, start), (element.get("endElement") or None, end)
        return SspConnection(*ends, self._linear(element), element)

    def _step(self, root: Element, system: Element, experiment: Element | None) -> float | None:
        """Return the communication step of another tool's annotation, if any."""
        annotations = (holder.first("ssd:Annotations") for holder in (experiment, system, root) if holder)
        for element in chain.from_iterable(_descendants(each) for each in annotations if each):
            attribute = STEPS.get(element.tag.rpartition(":")[2])
            if attribute and element.get(attribute) is not None:
                step = self._number(element, attribute, None)
                if step is not None and step <= 0.0:
                    self.note(element, f"{attribute} {step:g} s: a communication step is more than 0 s")
                    return None
                return step
        return None

    def _times(self, experiment: Element | None) -> tuple[float | None, float | None]:
        """Return the default experiment's start and stop time [s]."""
        if experiment is None:
            return None, None
        start, stop = (self._number(experiment, name, None) for name in ("startTime", "stopTime"))
        if stop is not None and stop <= (start or 0.0):
            self.note(
                experiment, f"stopTime {stop:g} s is not after startTime {start or 0.0:g} s; give a later stopTime"
            )
            return start, None
        return start, stop


def _descendants(element: Element) -> Iterator[Element]:
    """Yield all nested elements."""
    for child in element.children:
        yield child
        yield from _descendants(child)
