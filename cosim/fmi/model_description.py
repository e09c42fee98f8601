"""Completion of pythonfmu's model descriptions: units, limits, dependencies, initial unknowns."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from cosim.base.units import DISPLAY, unit_definitions
from cosim.fmi.annotation import annotation
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, sampled_annotation
from cosim.model.traits import Traits

LICENCE = "MIT"


@dataclass(frozen=True)
class Description:
    """Content of a model description apart from names and start values of variables.

    Attributes:
        sampled: Parameter with the only accepted communication step [s]; "" accepts any step.
    """

    description: str
    ports: Sequence[Port]
    dependencies: Mapping[str, Sequence[str]]
    initial_dependencies: Mapping[str, Sequence[str]]
    step: float
    stop: float
    variable_step: bool
    traits: Traits | None = None
    sampled: str = ""

    @property
    def optional(self) -> tuple[str, ...]:
        """Return the inputs that may stay unconnected."""
        return tuple(port.name for port in self.ports if port.optional)


# FMI's structured names without quotes: names joined by dots, perhaps with indices, or the derivative of such a name
_PART = r"[A-Za-z_][A-Za-z0-9_]*(\[\d+(,\d+)*\])?"
STRUCTURED = re.compile(rf"{_PART}(\.{_PART})*|der\({_PART}(\.{_PART})*\)", re.ASCII)


def naming_convention(names: Iterable[str]) -> str:
    """Return FMI's naming convention, `structured` if possible, else `flat`."""
    return "structured" if all(STRUCTURED.fullmatch(name) for name in names) else "flat"


def complete(xml: bytes, about: Description, version: str, guid: str) -> bytes:
    """Return pythonfmu's model description with all missing content."""
    root = fromstring(xml)
    root.attrib.pop("generationDateAndTime", None)  # Equal sources must give equal bytes.
    root.attrib |= {
        "guid": guid,
        "description": about.description,
        "author": AUTHOR,
        "version": version,
        "license": LICENCE,
        "copyright": AUTHOR,
        "variableNamingConvention": naming_convention(port.name for port in about.ports),
    }
    capabilities = _child(root, "CoSimulation")
    capabilities.attrib |= {
        "canHandleVariableCommunicationStepSize": str(about.variable_step).lower(),
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    root.insert(list(root).index(capabilities) + 1, unit_definitions({p.unit for p in about.ports if p.unit}))
    more = [] if about.traits is None else [annotation(about.traits)]
    more += [sampled_annotation(about.sampled, about.optional)] if about.sampled else []
    for element in (default_experiment(about), *more):
        root.insert(list(root).index(_child(root, "ModelVariables")), element)
    for variable, port in zip(_child(root, "ModelVariables"), about.ports, strict=True):
        _complete_variable(variable, port)
    root.remove(_child(root, "ModelStructure"))
    root.append(_structure(about))
    return xml_bytes(root)


def xml_bytes(root: Element) -> bytes:
    """Return an indented XML file."""
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def default_experiment(about: Description) -> Element:
    """Return the default experiment."""
    times = {"startTime": "0", "stopTime": repr(about.stop), "stepSize": repr(about.step), "tolerance": "1e-6"}
    return Element("DefaultExperiment", times)


def set_unit(node: Element, unit: str) -> None:
    """Set unit and display unit of a variable, if it has a unit."""
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])


def set_limits(node: Element, port: Port) -> None:
    """Set the finite limits of a variable."""
    for name, limit in zip(("min", "max"), port.bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def _complete_variable(variable: Element, port: Port) -> None:
    """Set unit, display unit, limits and exact start value. pythonfmu prints only 16 of 17 digits."""
    node = variable[0]
    if port.kind != "Real":
        return
    set_unit(node, port.unit)
    set_limits(node, port)
    if "start" in node.attrib:
        node.set("start", repr(float(port.start)))


def _structure(about: Description) -> Element:
    """Return ModelStructure with real dependencies."""
    index = {port.name: str(k + 1) for k, port in enumerate(about.ports)}
    structure = Element("ModelStructure")
    for tag, dependencies in (("Outputs", about.dependencies), ("InitialUnknowns", about.initial_dependencies)):
        group = SubElement(structure, tag)
        for port in about.ports:
            if port.causality == "output":
                sources = sorted((index[name] for name in dependencies[port.name]), key=int)
                SubElement(group, "Unknown", index=index[port.name], dependencies=" ".join(sources))
    return structure


def _child(root: Element, tag: str) -> Element:
    node = root.find(tag)
    assert node is not None
    return node
