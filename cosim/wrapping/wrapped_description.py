"""The model description of a wrapped FMU: that of the original with the parameters of the terms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from cosim.base.units import unit_definitions
from cosim.fmi.model_description import set_limits, set_unit
from cosim.fmi.ports import parameter_port
from cosim.model.quantities import Parameter

INTERFACES = ("ModelExchange", "CoSimulation", "ScheduledExecution")
SLOPES = ("providesDirectionalDerivative", "providesDirectionalDerivatives", "providesAdjointDerivatives")
INPUT_SLOPES = ("canInterpolateInputs", "recommendedIntermediateInputSmoothness")
OUTPUT_SLOPES = ("maxOutputDerivativeOrder",)
STEP_FLAGS = {2: ("completedIntegratorStepNotNeeded", "false"), 3: ("needsCompletedIntegratorStep", "true")}
NONE = {"false", "0"}  # values of an absent capability


class DescriptionEdit:
    """Edit of a modelDescription.xml. Everything that is not edited stays, comments and annotations included."""

    def __init__(self, text: bytes, fmi: int) -> None:
        from lxml import etree

        parser = etree.XMLParser(resolve_entities=False, no_network=True)
        self.root: Any = etree.fromstring(text, parser)
        self.fmi = fmi
        self.withdrawn: list[str] = []

    def bytes(self) -> bytes:
        """Return the edited file."""
        from lxml import etree

        text: bytes = etree.tostring(self.root.getroottree(), encoding="UTF-8", xml_declaration=True)
        return text + b"\n"

    @property
    def token(self) -> str:
        """Return the GUID or the instantiation token."""
        return str(self.root.get(self._token_name, ""))

    @token.setter
    def token(self, token: str) -> None:
        self.root.set(self._token_name, token)

    @property
    def _token_name(self) -> str:
        return "guid" if self.fmi == 2 else "instantiationToken"

    def keep_interfaces(self, names: Iterable[str]) -> None:
        """Remove all interfaces but these."""
        for interface in self._interfaces():
            if interface.tag not in names:
                self.root.remove(interface)
                self.withdrawn.append(interface.tag)
            for sources in interface.findall("SourceFiles"):  # the original's, of which the library is not made
                interface.remove(sources)

    def withdraw(self, attributes: Iterable[str]) -> None:
        """Remove capabilities."""
        for interface in self._interfaces():
            for name in attributes:
                value = interface.attrib.pop(name, None)
                if value is not None and value not in NONE and name not in self.withdrawn:
                    self.withdrawn.append(name)

    def require_completed_steps(self) -> None:
        """Demand of the host that it reports each step of its solver."""
        for interface in self.root.findall("ModelExchange"):
            interface.set(*STEP_FLAGS[self.fmi])

    def set_starts(self, values: Mapping[str, float]) -> list[str]:
        """Change start values; return the names of variables without a start value."""
        missing = []
        nodes = {node.get("name"): node for node in self.root.find("ModelVariables")}
        for name, value in values.items():
            node = nodes[name] if self.fmi == 3 else nodes[name].find("Real")
            if node.get("start") is None:
                missing.append(name)
            node.set("start", repr(float(value)))
        return missing

    def add_parameters(self, parameters: Sequence[Parameter], first: int, values: Mapping[str, float]) -> None:
        """Add fixed parameters with value references from `first` on, after all other variables."""
        from lxml import etree

        self._add_units({p.unit for p in parameters if p.unit})
        variables = self.root.find("ModelVariables")
        for k, p in enumerate(parameters):
            port = parameter_port(p, float(values.get(p.name, p.default)))
            head = {"name": p.name, "valueReference": str(first + k), "description": p.doc, "causality": "parameter"}
            head |= {"variability": "fixed", "initial": "exact"}
            node = ElementTree.Element("Real" if self.fmi == 2 else "Float64", {} if self.fmi == 2 else head)
            set_unit(node, p.unit)
            set_limits(node, port)
            node.set("start", repr(float(values.get(p.name, p.default))))
            if self.fmi == 2:
                outer = ElementTree.Element("ScalarVariable", head)
                outer.append(node)
                node = outer
            variables.append(etree.fromstring(ElementTree.tostring(node)))

    def _add_units(self, units: set[str]) -> None:
        from lxml import etree

        group = self.root.find("UnitDefinitions")
        if group is None and units:
            group = etree.Element("UnitDefinitions")
            self._interfaces()[-1].addnext(group)
        there = set() if group is None else {unit.get("name") for unit in group}
        for unit in unit_definitions(units - there) if units - there else ():
            group.append(etree.fromstring(ElementTree.tostring(unit)))

    def forget_dependencies(self, sources: Iterable[str]) -> None:
        """Remove dependencies that forces change: those of derivatives, and of outputs that depend on `sources`.

        Without dependencies, an unknown depends on everything.
        """
        numbers = self._numbers()
        changed = {numbers[name] for name in sources}
        for unknown in self._unknowns():
            dependencies = unknown.get("dependencies")
            is_rate = unknown.tag == "ContinuousStateDerivative" or unknown.getparent().tag == "Derivatives"
            if dependencies is not None and (is_rate or changed & set(dependencies.split())):
                for name in ("dependencies", "dependenciesKind"):
                    unknown.attrib.pop(name, None)

    def _unknowns(self) -> list[Any]:
        structure = self.root.find("ModelStructure")
        return [] if structure is None else [node for node in structure.iter() if node.get("dependencies") is not None]

    def _numbers(self) -> dict[str, str]:
        """Return variable → number in the structure: position in FMI 2.0, value reference in FMI 3.0."""
        nodes = [node for node in self.root.find("ModelVariables") if isinstance(node.tag, str)]
        key = "valueReference"
        return {n.get("name"): str(k) if self.fmi == 2 else n.get(key) for k, n in enumerate(nodes, 1)}

    def _interfaces(self) -> list[Any]:
        return [node for node in self.root if node.tag in INTERFACES]
