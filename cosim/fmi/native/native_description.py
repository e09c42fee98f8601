"""Variables of native FMUs and their model descriptions for FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal
from xml.etree.ElementTree import Element, SubElement

from cosim.base.units import unit_definitions
from cosim.fmi.model_description import (
    LICENCE,
    Description,
    default_experiment,
    naming_convention,
    set_unit_and_limits,
    vendor_annotations,
    xml_bytes,
)
from cosim.fmi.sampled import AUTHOR, TOOL

KINDS3 = {"Real": "Float64", "Boolean": "Boolean", "String": "String"}
LOG = {"logStatusWarning": "what the model was not made for", "logStatusError": "why a call was refused"}


@dataclass(frozen=True)
class Local:
    """A variable of native FMUs only."""

    name: str
    role: Literal["state", "derivative", "memory", "indicator"]
    unit: str
    doc: str


@dataclass(frozen=True)
class Native:
    """Everything needed for a native FMU.

    Value references are those of the ports of `about`, then those of the local variables.

    Attributes:
        body: Generated C code, `model.c`.
        sizes: Definitions of `config.h`.
        parts: C files to follow `model.c`.
        text: Documentation in HTML.
        locals: States, their derivatives in the same order, memory, event indicators.
        dependencies: Output or derivative → names of the inputs and states on which it depends.
    """

    name: str
    about: Description
    body: str
    sizes: Mapping[str, object]
    parts: Mapping[str, bytes]
    text: str
    locals: tuple[Local, ...] = ()
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def named(self, role: str) -> list[str]:
        """Return the names of the local variables of a role."""
        return [v.name for v in self.locals if v.role == role]


def describe_native(native: Native, fmi: int, identifier: str, version: str, guid: str) -> bytes:
    """Return modelDescription.xml of FMI 2.0 or 3.0; that of 2.0 names the sources in `all.c`."""
    about, is2 = native.about, fmi == 2
    names = [v.name for v in (*about.ports, *native.locals)]
    states = native.named("state")
    root = Element("fmiModelDescription", {"fmiVersion": f"{fmi}.0", "modelName": native.name})
    root.attrib |= {
        "guid" if is2 else "instantiationToken": guid,
        "description": about.description,
        "author": AUTHOR,
        "version": version,
        "copyright": AUTHOR,
        "license": LICENCE,
        "generationTool": f"{TOOL} {version}",
        "variableNamingConvention": naming_convention(names),
    }
    state = "FMUstate" if is2 else "FMUState"
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    if is2:
        root.set("numberOfEventIndicators", str(len(native.named("indicator"))))
        common["canNotUseMemoryManagementFunctions"] = "true"
    if states:
        common["providesDirectionalDerivative" if is2 else "providesDirectionalDerivatives"] = "true"
        SubElement(root, "ModelExchange", common)
    steps = {"canHandleVariableCommunicationStepSize": str(about.variable_step).lower()}
    SubElement(root, "CoSimulation", common | steps)
    for interface in root if is2 else ():
        SubElement(SubElement(interface, "SourceFiles"), "File", name="all.c")
    root.append(unit_definitions({v.unit for v in (*about.ports, *native.locals) if v.unit}))
    categories = SubElement(root, "LogCategories")
    for category, meaning in LOG.items():
        SubElement(categories, "Category", name=category, description=meaning)
    root.append(default_experiment(about))
    vendors = vendor_annotations(about, "doubles")
    if is2:
        root.extend(vendors)
    root.append(_variables(native, fmi))
    root.append(_structure(native, fmi, names))
    if vendors and not is2:
        annotations = SubElement(root, "Annotations")
        for vendor in vendors:
            (tool,) = vendor
            SubElement(annotations, "Annotation", type=TOOL).extend(tool)
    return xml_bytes(root)


def _variables(native: Native, fmi: int) -> Element:
    """Return ModelVariables: the ports and the local variables, without event indicators in FMI 2.0."""
    ports = native.about.ports
    variables = Element("ModelVariables")
    if fmi == 3:  # FMI 3.0 requires the time.
        reference = str(len(ports) + len(native.locals))
        head = {"name": "time", "valueReference": reference, "causality": "independent", "variability": "continuous"}
        SubElement(variables, "Float64", head)

    def add(kind: str, reference: int, name: str, doc: str, more: dict[str, str]) -> Element:
        """Add a variable and return the element with the attributes of its type."""
        head = {"name": name, "valueReference": str(reference), **({"description": doc} if doc else {}), **more}
        if fmi == 3:
            return SubElement(variables, KINDS3[kind], head)
        return SubElement(SubElement(variables, "ScalarVariable", head), kind)

    for k, port in enumerate(ports):
        more = {"causality": port.causality, "variability": "continuous" if port.kind == "Real" else "discrete"}
        if port.causality == "parameter":
            more |= {"variability": "fixed", "initial": "exact"}
        elif port.causality == "output":
            more["initial"] = "calculated"
        node = add(port.kind, k, port.name, port.doc, more)
        if port.kind == "Real":
            set_unit_and_limits(node, port.unit, port.bounds)
        if port.causality == "output":
            continue
        if isinstance(port.start, str):
            start = port.start
        else:
            start = str(port.start).lower() if isinstance(port.start, bool) else repr(float(port.start))
        if port.kind == "String" and fmi == 3:
            SubElement(node, "Start", value=start)
        else:
            node.set("start", start)
    rates = native.named("derivative")
    for k, v in enumerate(native.locals, len(ports)):
        if v.role == "indicator" and fmi == 2:
            continue
        variability = "discrete" if v.role == "memory" else "continuous"
        node = add(
            "Real", k, v.name, v.doc, {"causality": "local", "variability": variability, "initial": "calculated"}
        )
        set_unit_and_limits(node, v.unit)
        if v.role == "derivative":
            # States come first. FMI 2.0 counts variables from 1.
            node.set("derivative", str(len(ports) + rates.index(v.name) + (fmi == 2)))
    return variables


def _structure(native: Native, fmi: int, names: Sequence[str]) -> Element:
    """Return ModelStructure with dependencies."""
    numbers = {name: k + (fmi == 2) for k, name in enumerate(names)}
    states, rates = native.named("state"), native.named("derivative")
    outputs = [p.name for p in native.about.ports if p.causality == "output"]
    dependencies, starting = native.dependencies or native.about.dependencies, native.about.initial_dependencies
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
        add(structure, "EventIndicator", dict.fromkeys(native.named("indicator")))
    return structure
