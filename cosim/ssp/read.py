"""Reading of an SSD (system structure description) with its parameter sets and mappings; all faults have places."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from cosim.ssp import messages
from cosim.ssp.elements import Element
from cosim.ssp.parameter_sets import ParameterReader
from cosim.ssp.structure import Connector, SspComponent, SspConnection, SspStructure, SspSystem
from cosim.storage.yaml_file import format_value

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
            self.note(root, messages.WRONG_ELEMENT(tag="ssd:SystemStructureDescription"))
            return None
        self._version(root)
        system = root.first("ssd:System")
        if system is None:
            self.note(root, messages.MISSING_ELEMENT(tag="ssd:System"))
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
                    self.note(child, messages.DOUBLED_ELEMENT())
                elements[inner.name] = inner
        connections = [self._connection(c) for c in element.all("ssd:Connections", "ssd:Connection")]
        if (dictionaries := element.first("ssd:SignalDictionaries")) is not None and dictionaries.children:
            self.note(dictionaries, messages.SIGNAL_DICTIONARY())
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
            self.note(child, messages.SIGNAL_DICTIONARY())
        elif child.tag not in {"ssd:Component", "ssd:System", "ssd:Annotations"}:
            self.note(child, messages.NOT_AN_ELEMENT())
        elif child.tag != "ssd:Annotations" and not child.get("name"):
            self.note(child, messages.NO_NAME())
        elif child.tag == "ssd:System":
            return self._system(child)
        elif child.tag == "ssd:Component":
            return self._component(child)
        return None

    def _component(self, element: Element) -> SspComponent:
        kind, source = element.get("type") or FMU, element.get("source")
        fmu: Path | str
        if kind == NESTED:
            fmu = messages.COMPONENT_AN_SSP(type=format_value(kind))
        elif kind != FMU:
            fmu = messages.COMPONENT_NOT_AN_FMU(type=format_value(kind), fmu=FMU)
        else:
            fmu = self.package.resolve(source) if source else messages.NO_FMU_NAMED()
        if isinstance(fmu, str):
            self.note(element, fmu)
            fmu = Path()
        interface = element.get("implementation") or "any"
        if interface not in INTERFACES:
            names = ", ".join(INTERFACES)
            self.note(element, messages.INTERFACE_NOT_RUN(interface=format_value(interface), interfaces=names))
        connectors, parameters = self._connectors(element), tuple(self._parameters(element))
        name = element.get("name") or ""
        return SspComponent(name, fmu, INTERFACES.get(interface), connectors, parameters, element)

    def _connectors(self, element: Element) -> dict[str, Connector]:
        connectors: dict[str, Connector] = {}
        for each in element.all("ssd:Connectors", "ssd:Connector"):
            name = each.get("name")
            if not name:
                self.note(each, messages.NO_NAME())
                continue
            if name in connectors:
                self.note(each, messages.DOUBLED_CONNECTOR())
            units = (child.get("unit") for child in each.children if child.tag.startswith("ssc:"))
            connectors[name] = Connector(name, each.get("kind") or "", next(filter(None, units), None), each)
        return connectors

    def _connection(self, element: Element) -> SspConnection | None:
        start, end = (element.get(f"{side}Connector") for side in ("start", "end"))
        if not start or not end:
            self.note(element, messages.MISSING_ATTRIBUTE(name="endConnector" if start else "startConnector"))
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
                    self.note(element, messages.STEP_NOT_POSITIVE(name=attribute, step=step))
                    return None
                return step
        return None

    def _times(self, experiment: Element | None) -> tuple[float | None, float | None]:
        """Return the default experiment's start and stop time [s]."""
        if experiment is None:
            return None, None
        start, stop = (self._number(experiment, name, None) for name in ("startTime", "stopTime"))
        if stop is not None and stop <= (start or 0.0):
            self.note(experiment, messages.STOP_BEFORE_START(stop=stop, start=start or 0.0))
            return start, None
        return start, stop


def _descendants(element: Element) -> Iterator[Element]:
    """Yield all nested elements."""
    for child in element.children:
        yield child
        yield from _descendants(child)
