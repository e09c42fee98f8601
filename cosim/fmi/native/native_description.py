"""Variables of native FMUs and their model descriptions for FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, SubElement

from cosim.core.units import unit_definitions
from cosim.fmi.model_description import (
    LICENCE,
    Description,
    Local,
    default_experiment,
    model_structure,
    model_variables,
    naming_convention,
    vendor_annotations,
    xml_bytes,
)
from cosim.fmi.ports import Port
from cosim.fmi.sampled import AUTHOR, TOOL

LOG = {"logStatusWarning": "what the model was not made for", "logStatusError": "why a call was refused"}


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
    variables: list[Port | Local] = [*about.ports, *native.locals]
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
        "variableNamingConvention": naming_convention(v.name for v in variables),
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
    root.append(unit_definitions({v.unit for v in variables if v.unit}))
    categories = SubElement(root, "LogCategories")
    for category, meaning in LOG.items():
        SubElement(categories, "Category", name=category, description=meaning)
    root.append(default_experiment(about))
    vendors = vendor_annotations(about, "doubles")
    if is2:
        root.extend(vendors)
    root.append(model_variables(about, fmi, native.locals))
    root.append(model_structure(about, fmi, native.locals, native.dependencies))
    if vendors and not is2:
        annotations = SubElement(root, "Annotations")
        for vendor in vendors:
            (tool,) = vendor
            SubElement(annotations, "Annotation", type=TOOL).extend(tool)
    return xml_bytes(root)
