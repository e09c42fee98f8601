"""Model descriptions of native FMUs for FMI 2.0 and 3.0."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.base.units import DISPLAY, unit_definitions
from cosim.fmi.annotation import annotation
from cosim.fmi.model_description import LICENCE, naming_convention
from cosim.fmi.native.layout import Layout, Local
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, sampled

TOOL = "cosim"
KINDS3 = {"Real": "Float64", "Boolean": "Boolean", "String": "String"}
LOG = {"logStatusWarning": "what the model was not made for", "logStatusError": "why a call was refused"}


def description2(layout: Layout, name: str, identifier: str, version: str, guid: str) -> bytes:
    """Return modelDescription.xml of FMI 2.0; sources are in `all.c`."""
    about = layout.about
    root = Element("fmiModelDescription", fmiVersion="2.0", modelName=name, guid=guid)
    root.attrib |= _head(layout, version) | {"numberOfEventIndicators": str(layout.indicators)}
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {"canNotUseMemoryManagementFunctions": "true", "canGetAndSetFMUstate": "true"}
    common |= {"canSerializeFMUstate": "true"}
    states = layout.of("state")
    if states:
        common |= {"providesDirectionalDerivative": "true"}
        _sources2(SubElement(root, "ModelExchange", common))
    steps = {"canHandleVariableCommunicationStepSize": str(about.variable_step).lower()}
    _sources2(SubElement(root, "CoSimulation", common | steps))
    root.append(_units(layout))
    categories = SubElement(root, "LogCategories")
    for category, meaning in LOG.items():
        SubElement(categories, "Category", name=category, description=meaning)
    root.append(_experiment(layout))
    for more in _annotations(layout):
        root.append(more)
    variables = SubElement(root, "ModelVariables")
    for k, port in enumerate(layout.ports):
        variables.append(_port2(k, port))
    derivatives = {v.state: k for k, v in states}
    shown = [v for v in layout.locals if v.role != "indicator"]
    for k, v in enumerate(shown, len(layout.ports)):
        variables.append(_local2(k, v, derivatives))
    root.append(_structure2(layout))
    return _text(root)


def _head(layout: Layout, version: str) -> dict[str, str]:
    return {
        "description": layout.about.description,
        "author": AUTHOR,
        "version": version,
        "copyright": AUTHOR,
        "license": LICENCE,
        "generationTool": f"{TOOL} {version}",
        "variableNamingConvention": naming_convention(
            [*(p.name for p in layout.ports), *(v.name for v in layout.locals)]
        ),
    }


def _sources2(way: Element) -> None:
    SubElement(SubElement(way, "SourceFiles"), "File", name="all.c")


def _units(layout: Layout) -> Element:
    return unit_definitions(
        {unit for unit in (*(p.unit for p in layout.ports), *(v.unit for v in layout.locals)) if unit}
    )


def _experiment(layout: Layout) -> Element:
    about = layout.about
    times = {"startTime": "0", "stopTime": repr(about.stop), "stepSize": repr(about.step), "tolerance": "1e-6"}
    return Element("DefaultExperiment", times)


def _annotations(layout: Layout) -> list[Element]:
    about = layout.about
    found = [] if about.traits is None else [annotation(about.traits, "doubles")]
    return found + ([sampled(about.sampled, about.optional)] if about.sampled else [])


def _of_real(node: Element, unit: str) -> None:
    if unit:
        node.set("unit", unit)
        if display := DISPLAY.get(unit):
            node.set("displayUnit", display[0])


def _limits(node: Element, port: Port) -> None:
    for name, limit in zip(("min", "max"), port.bounds, strict=True):
        if math.isfinite(limit):
            node.set(name, repr(float(limit)))


def _start(port: Port) -> str:
    if isinstance(port.start, bool):
        return str(port.start).lower()
    return port.start if isinstance(port.start, str) else repr(float(port.start))


def _roles(port: Port) -> dict[str, str]:
    """Return causality, variability and initial."""
    if port.causality == "parameter":
        return {"causality": "parameter", "variability": "fixed", "initial": "exact"}
    variability = "continuous" if port.kind == "Real" else "discrete"
    more = {"initial": "calculated"} if port.causality == "output" else {}
    return {"causality": port.causality, "variability": variability, **more}


def _port2(k: int, port: Port) -> Element:
    head = {"name": port.name, "valueReference": str(k), "description": port.doc}
    variable = Element("ScalarVariable", {n: v for n, v in head.items() if v} | _roles(port))
    node = SubElement(variable, port.kind)
    if port.kind == "Real":
        _of_real(node, port.unit)
        _limits(node, port)
    if port.causality != "output":
        node.set("start", _start(port))
    return variable


def _local2(k: int, v: Local, states: dict[int, int]) -> Element:
    discrete = "discrete" if v.role == "memory" else "continuous"
    head = {"name": v.name, "valueReference": str(k), "description": v.doc, "causality": "local"}
    variable = Element("ScalarVariable", head | {"variability": discrete, "initial": "calculated"})
    node = SubElement(variable, "Real")
    _of_real(node, v.unit)
    if v.role == "derivative":
        node.set("derivative", str(states[v.state] + 1))
    return variable


def _structure2(layout: Layout) -> Element:
    """Return ModelStructure with dependencies."""
    names = [*(p.name for p in layout.ports), *(v.name for v in layout.locals)]
    index = {name: k + 1 for k, name in enumerate(names)}
    structure = Element("ModelStructure")
    outputs = [p.name for p in layout.ports if p.causality == "output"]
    rates = [v.name for _, v in layout.of("derivative")]
    starting = layout.about.initial_dependencies

    def unknowns(tag: str, listed: Iterable[tuple[str, Sequence[str] | None]]) -> None:
        group = SubElement(structure, tag)
        for name, known in sorted(listed, key=lambda pair: index[pair[0]]):
            node = SubElement(group, "Unknown", index=str(index[name]))
            if known is not None:
                node.set("dependencies", " ".join(map(str, sorted(index[n] for n in known))))

    given = layout.dependencies or layout.about.dependencies
    unknowns("Outputs", ((name, given[name]) for name in outputs))
    if rates:
        unknowns("Derivatives", ((name, given[name]) for name in rates))
    calculated = [(name, None) for name in (*(v.name for _, v in layout.of("state")), *rates)]
    unknowns("InitialUnknowns", [*((name, starting[name]) for name in outputs), *calculated])
    return structure


def _text(root: Element) -> bytes:
    indent(root)
    text: bytes = tostring(root, encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


# -- FMI 3.0 ------------------------------------------------------------------------------------


def description3(layout: Layout, name: str, identifier: str, version: str, guid: str) -> bytes:
    """Return modelDescription.xml of FMI 3.0. `sources/buildDescription.xml` describes the sources."""
    about = layout.about
    root = Element("fmiModelDescription", fmiVersion="3.0", modelName=name, instantiationToken=guid)
    root.attrib |= _head(layout, version)
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
    states = layout.of("state")
    if states:
        common |= {"providesDirectionalDerivatives": "true"}
        SubElement(root, "ModelExchange", common)
    steps = {"canHandleVariableCommunicationStepSize": str(about.variable_step).lower()}
    SubElement(root, "CoSimulation", common | steps)
    root.append(_units(layout))
    categories = SubElement(root, "LogCategories")
    for category, meaning in LOG.items():
        SubElement(categories, "Category", name=category, description=meaning)
    root.append(_experiment(layout))
    variables = Element("ModelVariables")
    variables.append(
        Element(
            "Float64", name="time", valueReference=str(_time(layout)), causality="independent", variability="continuous"
        )
    )
    for k, port in enumerate(layout.ports):
        variables.append(_port3(k, port))
    derivatives = {v.state: k for k, v in states}
    for k, v in enumerate(layout.locals, len(layout.ports)):
        variables.append(_local3(k, v, derivatives))
    root.append(variables)
    root.append(_structure3(layout))
    if noted := _annotations(layout):
        annotations = SubElement(root, "Annotations")
        for more in noted:
            (tool,) = more
            own = SubElement(annotations, "Annotation", type=TOOL)
            own.extend(tool)
    return _text(root)


def _time(layout: Layout) -> int:
    """Return the value reference of time, required by FMI 3.0."""
    return len(layout.ports) + len(layout.locals)


def _port3(k: int, port: Port) -> Element:
    head = {"name": port.name, "valueReference": str(k), "description": port.doc}
    node = Element(KINDS3[port.kind], {n: v for n, v in head.items() if v} | _roles(port))
    if port.kind == "Real":
        _of_real(node, port.unit)
        _limits(node, port)
    if port.causality != "output":
        if port.kind == "String":
            SubElement(node, "Start", value=_start(port))
        else:
            node.set("start", _start(port))
    return node


def _local3(k: int, v: Local, states: dict[int, int]) -> Element:
    discrete = "discrete" if v.role == "memory" else "continuous"
    head = {"name": v.name, "valueReference": str(k), "description": v.doc, "causality": "local"}
    node = Element("Float64", head | {"variability": discrete, "initial": "calculated"})
    _of_real(node, v.unit)
    if v.role == "derivative":
        node.set("derivative", str(states[v.state]))
    return node


def _structure3(layout: Layout) -> Element:
    reference = {p.name: k for k, p in enumerate(layout.ports)}
    reference |= {v.name: k for k, v in enumerate(layout.locals, len(layout.ports))}
    structure = Element("ModelStructure")
    outputs = [p.name for p in layout.ports if p.causality == "output"]
    rates = [v.name for _, v in layout.of("derivative")]
    given, starting = layout.dependencies or layout.about.dependencies, layout.about.initial_dependencies

    def unknown(tag: str, name: str, known: Sequence[str] | None) -> None:
        node = SubElement(structure, tag, valueReference=str(reference[name]))
        if known is not None:
            node.set("dependencies", " ".join(map(str, sorted(reference[n] for n in known))))

    for name in outputs:
        unknown("Output", name, given[name])
    for name in rates:
        unknown("ContinuousStateDerivative", name, given[name])
    for name in outputs:
        unknown("InitialUnknown", name, starting[name])
    for _, v in layout.of("state"):
        unknown("InitialUnknown", v.name, None)
    for name in rates:
        unknown("InitialUnknown", name, None)
    for _, v in layout.of("indicator"):
        unknown("EventIndicator", v.name, None)
    return structure
