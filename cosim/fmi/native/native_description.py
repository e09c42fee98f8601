"""Model descriptions of native FMUs for FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal
from xml.etree.ElementTree import Element, SubElement

from cosim.base.units import unit_definitions
from cosim.fmi.annotation import annotation
from cosim.fmi.model_description import (
    LICENCE,
    default_experiment,
    naming_convention,
    set_limits,
    set_unit,
    xml_bytes,
)
from cosim.fmi.native.layout import Local, VariableLayout
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, sampled_annotation

TOOL = "cosim"
KINDS3 = {"Real": "Float64", "Boolean": "Boolean", "String": "String"}
LOG = {"logStatusWarning": "what the model was not made for", "logStatusError": "why a call was refused"}
Version = Literal[2, 3]  # of FMI


def description2(layout: VariableLayout, name: str, identifier: str, version: str, guid: str) -> bytes:
    """Return modelDescription.xml of FMI 2.0; sources are in `all.c`."""
    head = {"fmiVersion": "2.0", "modelName": name, "guid": guid, **_head(layout, version)}
    head |= {"numberOfEventIndicators": str(layout.indicators)}
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {"canNotUseMemoryManagementFunctions": "true", "canGetAndSetFMUstate": "true"}
    common |= {"canSerializeFMUstate": "true"}
    root = _root(layout, head, common, "providesDirectionalDerivative")
    for tag in ("ModelExchange", "CoSimulation"):
        for interface in root.iterfind(tag):
            SubElement(SubElement(interface, "SourceFiles"), "File", name="all.c")
    root.extend(_annotations(layout))
    root.append(_variables(layout, [v for v in layout.locals if v.role != "indicator"], 2))
    root.append(_structure(layout, 2))
    return xml_bytes(root)


def description3(layout: VariableLayout, name: str, identifier: str, version: str, guid: str) -> bytes:
    """Return modelDescription.xml of FMI 3.0, without the sources."""
    head = {"fmiVersion": "3.0", "modelName": name, "instantiationToken": guid, **_head(layout, version)}
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
    root = _root(layout, head, common, "providesDirectionalDerivatives")
    variables = _variables(layout, layout.locals, 3)
    time = {"name": "time", "valueReference": str(len(layout.variables))}  # required by FMI 3.0
    variables.insert(0, Element("Float64", time | {"causality": "independent", "variability": "continuous"}))
    root.append(variables)
    root.append(_structure(layout, 3))
    if vendors := _annotations(layout):
        annotations = SubElement(root, "Annotations")
        for vendor in vendors:
            (tool,) = vendor
            SubElement(annotations, "Annotation", type=TOOL).extend(tool)
    return xml_bytes(root)


def _head(layout: VariableLayout, version: str) -> dict[str, str]:
    return {
        "description": layout.about.description,
        "author": AUTHOR,
        "version": version,
        "copyright": AUTHOR,
        "license": LICENCE,
        "generationTool": f"{TOOL} {version}",
        "variableNamingConvention": naming_convention(v.name for v in layout.variables),
    }


def _root(layout: VariableLayout, head: dict[str, str], common: dict[str, str], slopes: str) -> Element:
    """Return a description up to its default experiment.

    Args:
        common: Attributes of both interfaces.
        slopes: Name of the capability of directional derivatives.
    """
    root = Element("fmiModelDescription", head)
    if layout.of("state"):
        common |= {slopes: "true"}
        SubElement(root, "ModelExchange", common)
    steps = {"canHandleVariableCommunicationStepSize": str(layout.about.variable_step).lower()}
    SubElement(root, "CoSimulation", common | steps)
    root.append(unit_definitions({v.unit for v in layout.variables if v.unit}))
    categories = SubElement(root, "LogCategories")
    for category, meaning in LOG.items():
        SubElement(categories, "Category", name=category, description=meaning)
    root.append(default_experiment(layout.about))
    return root


def _annotations(layout: VariableLayout) -> list[Element]:
    about = layout.about
    traits = [] if about.traits is None else [annotation(about.traits, "doubles")]
    return traits + ([sampled_annotation(about.sampled, about.optional)] if about.sampled else [])


def _variables(layout: VariableLayout, local: Sequence[Local], fmi: Version) -> Element:
    """Return the XML of the ports and of the variables in `local`."""
    states = {v.state: k for k, v in layout.of("state")}
    variables = Element("ModelVariables")
    variables.extend(_port(k, port, fmi) for k, port in enumerate(layout.ports))
    variables.extend(_local(k, v, states, fmi) for k, v in enumerate(local, len(layout.ports)))
    return variables


def _variable(kind: str, attributes: dict[str, str], fmi: Version) -> tuple[Element, Element]:
    """Return the XML element of a variable, and the element that carries the attributes of its type."""
    if fmi == 3:
        node = Element(KINDS3[kind], attributes)
        return node, node
    variable = Element("ScalarVariable", attributes)
    return variable, SubElement(variable, kind)


def _port(k: int, port: Port, fmi: Version) -> Element:
    head = {"name": port.name, "valueReference": str(k), "description": port.doc}
    variable, node = _variable(port.kind, {n: v for n, v in head.items() if v} | _roles(port), fmi)
    if port.kind == "Real":
        set_unit(node, port.unit)
        set_limits(node, port)
    if port.causality != "output" and port.kind == "String" and fmi == 3:
        SubElement(node, "Start", value=_start(port))
    elif port.causality != "output":
        node.set("start", _start(port))
    return variable


def _start(port: Port) -> str:
    if isinstance(port.start, bool):
        return str(port.start).lower()
    return port.start if isinstance(port.start, str) else repr(float(port.start))


def _roles(port: Port) -> dict[str, str]:
    """Return causality, variability and initial."""
    if port.causality == "parameter":
        return {"causality": "parameter", "variability": "fixed", "initial": "exact"}
    variability = "continuous" if port.kind == "Real" else "discrete"
    initial = {"initial": "calculated"} if port.causality == "output" else {}
    return {"causality": port.causality, "variability": variability, **initial}


def _local(k: int, v: Local, states: Mapping[int, int], fmi: Version) -> Element:
    variability = "discrete" if v.role == "memory" else "continuous"
    head = {"name": v.name, "valueReference": str(k), "description": v.doc, "causality": "local"}
    variable, node = _variable("Real", head | {"variability": variability, "initial": "calculated"}, fmi)
    set_unit(node, v.unit)
    if v.role == "derivative":
        node.set("derivative", str(states[v.state] + (fmi == 2)))  # FMI 2.0 counts variables from 1.
    return variable


def _structure(layout: VariableLayout, fmi: Version) -> Element:
    """Return ModelStructure with dependencies."""
    numbers = {v.name: k + (fmi == 2) for k, v in enumerate(layout.variables)}
    states, rates, indicators = ([v.name for _, v in layout.of(r)] for r in ("state", "derivative", "indicator"))
    outputs = [p.name for p in layout.ports if p.causality == "output"]
    dependencies, starting = layout.dependencies or layout.about.dependencies, layout.about.initial_dependencies
    initial = {**{n: starting[n] for n in outputs}, **dict.fromkeys((*states, *rates))}
    structure = Element("ModelStructure")

    def add(parent: Element, tag: str, unknowns: Mapping[str, Sequence[str] | None]) -> None:
        for name, sources in unknowns.items():
            node = SubElement(parent, tag, {"index" if fmi == 2 else "valueReference": str(numbers[name])})
            if sources is not None:
                node.set("dependencies", " ".join(map(str, sorted(numbers[n] for n in sources))))

    if fmi == 2:
        add(SubElement(structure, "Outputs"), "Unknown", {n: dependencies[n] for n in outputs})
        if rates:
            add(SubElement(structure, "Derivatives"), "Unknown", {n: dependencies[n] for n in rates})
        add(SubElement(structure, "InitialUnknowns"), "Unknown", initial)
    else:
        add(structure, "Output", {n: dependencies[n] for n in outputs})
        add(structure, "ContinuousStateDerivative", {n: dependencies[n] for n in rates})
        add(structure, "InitialUnknown", initial)
        add(structure, "EventIndicator", dict.fromkeys(indicators))
    return structure
