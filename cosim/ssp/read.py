"""Reading of an SSD with its parameter sets and mappings; all faults have places."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cosim.ssp.elements import Element
from cosim.ssp.parameter_sets import ParameterReader
from cosim.ssp.structure import Component, Connection, Connector, Structure, System
from cosim.storage.yaml_file import shown

FMU = "application/x-fmu-sharedlibrary"
WAYS = {"any": None, "CoSimulation": "co-simulation", "ModelExchange": "model-exchange"}
STEPS = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}  # annotations of OSP and of OMSimulator


class Reader(ParameterReader):
    """Reader of a system description."""

    def structure(self) -> Structure | None:
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
        return Structure(
            root.get("name") or "system",
            system.get("description") or root.get("description") or "",
            self._system(system),
            self._units(root.first("ssd:Units")),
            start,
            stop,
            self._step(root, system, experiment),
            root if experiment is None else experiment,
            self.warnings,
        )

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
        # OMSimulator writes an empty name for the system itself.
        ends = (element.get("startElement") or None, start), (element.get("endElement") or None, end)
        return Connection(*ends, self._linear(element, exact), element)

    def _step(self, root: Element, system: Element, experiment: Element | None) -> float | None:
        """Return the communication step of another tool's annotation, if any."""
        for holder in (experiment, system, root):
            annotations = None if holder is None else holder.first("ssd:Annotations")
            for element in () if annotations is None else _within(annotations):
                attribute = STEPS.get(element.tag.rpartition(":")[2])
                if attribute and element.get(attribute) is not None:
                    step = self._number(element, attribute, None)
                    if step is not None and step <= 0.0:
                        self.note(element, f"{attribute} {step:g} s: a communication step is more than 0 s")
                        return None
                    return step
        return None

    def _times(self, experiment: Element | None) -> tuple[float | None, float | None]:
        """Return start and stop time of the default experiment [s]."""
        if experiment is None:
            return None, None
        start, stop = (self._number(experiment, name, None) for name in ("startTime", "stopTime"))
        if stop is not None and stop <= (start or 0.0):
            self.note(experiment, f"stopTime {stop:g} s is not after startTime {start or 0.0:g} s")
            return start, None
        return start, stop


def _within(element: Element) -> Iterator[Element]:
    """Yield all nested elements."""
    for child in element.children:
        yield child
        yield from _within(child)
