"""Completion of pythonfmu's model descriptions: units, limits, dependencies, initial unknowns, annotations."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from cosim.base.units import DISPLAY, unit_definitions
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, FRAME, TOOL
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


# FMI's structured names without quotes: names joined by dots, perhaps with indices, or the derivative of such a name
_PART = r"[A-Za-z_][A-Za-z0-9_]*(\[\d+(,\d+)*\])?"
STRUCTURED = re.compile(rf"{_PART}(\.{_PART})*|der\({_PART}(\.{_PART})*\)", re.ASCII)


def naming_convention(names: Iterable[str]) -> str:
    """Return FMI's naming convention, `structured` if possible, else `flat`."""
    return "structured" if all(STRUCTURED.fullmatch(name) for name in names) else "flat"


def complete(xml: bytes, about: Description, version: str, guid: str) -> bytes:
    """Return pythonfmu's model description with all missing content."""
    root: Any = fromstring(xml)
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
    capabilities, variables = root.find("CoSimulation"), root.find("ModelVariables")
    capabilities.attrib |= {
        "canHandleVariableCommunicationStepSize": str(about.variable_step).lower(),
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    root.insert(list(root).index(capabilities) + 1, unit_definitions({p.unit for p in about.ports if p.unit}))
    for element in (default_experiment(about), *vendor_annotations(about, "json")):
        root.insert(list(root).index(variables), element)
    for variable, port in zip(variables, about.ports, strict=True):
        if port.kind == "Real":
            set_unit_and_limits(variable[0], port.unit, port.bounds)
            if "start" in variable[0].attrib:  # pythonfmu prints only 16 of 17 digits.
                variable[0].set("start", repr(float(port.start)))
    root.remove(root.find("ModelStructure"))
    index = {port.name: str(k + 1) for k, port in enumerate(about.ports)}
    structure = SubElement(root, "ModelStructure")
    for tag, dependencies in (("Outputs", about.dependencies), ("InitialUnknowns", about.initial_dependencies)):
        group = SubElement(structure, tag)
        for port in about.ports:
            if port.causality == "output":
                sources = sorted((index[name] for name in dependencies[port.name]), key=int)
                SubElement(group, "Unknown", index=index[port.name], dependencies=" ".join(sources))
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


def set_unit_and_limits(node: Element, unit: str, bounds: tuple[float, float] = (-math.inf, math.inf)) -> None:
    """Set unit, display unit and finite limits of a variable."""
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])
    for name, limit in zip(("min", "max"), bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def vendor_annotations(about: Description, state: str) -> list[Element]:
    """Return `VendorAnnotations`, each with a single element as FMI demands: of traits, and of the accepted step.

    Args:
        state: Format of the serialized FMU state.
    """
    annotations = []

    def add(tag: str, **attributes: str) -> Element:
        annotations.append(Element("VendorAnnotations"))
        return SubElement(SubElement(annotations[-1], "Tool", name=TOOL), tag, attributes)

    if traits := about.traits:
        node = add("Traits", state=state)
        for name, rate in traits.rates.items():
            SubElement(node, "Rate", of=name, signal=rate)
        for name, (low, high) in traits.bounds.items():
            SubElement(node, "Limits", of=name, low=repr(low), high=repr(high))
        if traits.planar:
            SubElement(node, "PlanarFrame", {key: getattr(traits.planar, key) for key in FRAME})
    if about.sampled:
        node = add("Sampled", parameter=about.sampled)
        if optional := " ".join(port.name for port in about.ports if port.optional):
            node.set("optional", optional)
    return annotations
