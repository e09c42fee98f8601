"""The model description of a wrapped FMU: that of the original with the parameters of the terms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any
from xml.etree import ElementTree

from cosim.core.units import unit_definitions
from cosim.fmi.model_description import set_unit_and_limits
from cosim.terms.code import TermCode

INTERFACES = ("ModelExchange", "CoSimulation", "ScheduledExecution")
SLOPES = ("providesDirectionalDerivative", "providesDirectionalDerivatives", "providesAdjointDerivatives")
INPUT_SLOPES = ("canInterpolateInputs", "recommendedIntermediateInputSmoothness")
OUTPUT_SLOPES = ("maxOutputDerivativeOrder",)
STEP_FLAGS = {2: ("completedIntegratorStepNotNeeded", "false"), 3: ("needsCompletedIntegratorStep", "true")}
NONE = {"false", "0"}  # values of an absent capability


class CannotWrap(ValueError):
    """Error: terms cannot be added to an FMU."""


def xml_of(root: Any) -> bytes:
    """Return the XML file of a root element of lxml."""
    from lxml import etree

    text: bytes = etree.tostring(root.getroottree(), encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def parsed(text: bytes) -> Any:
    """Return the root element of a model description, with its comments and annotations."""
    from lxml import etree

    return etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True))


def set_starts(root: Any, values: Mapping[str, float], file: str) -> None:
    """Set the start values of variables in a model description.

    Raises:
        CannotWrap: A variable has no start value in the file.
    """
    nodes = {node.get("name"): node for node in root.find("ModelVariables")}
    for name, value in values.items():
        node = nodes[name] if root.get("fmiVersion").startswith("3") else nodes[name].find("Real")
        if node.get("start") is None:
            raise CannotWrap(f"{name} of {file} has no start value; only variables with one take another")
        node.set("start", repr(float(value)))


def describe_wrapped(
    text: bytes, file: str, kept: Iterable[str], terms: TermCode, values: Mapping[str, float], first: int
) -> tuple[Any, list[str]]:
    """Return the root of a wrapped FMU's description, with the original's token, and what the wrapper withdraws.

    Everything that is not edited stays, comments and annotations included.

    Args:
        kept: Interfaces in which the terms act.
        first: Value reference of the first parameter of the terms.
    """
    from lxml import etree

    root = parsed(text)
    fmi, parameters = int(root.get("fmiVersion")[0]), terms.parameters
    withdrawn: list[str] = []
    for interface in [node for node in root if node.tag in INTERFACES]:
        if interface.tag not in kept:
            root.remove(interface)
            withdrawn.append(interface.tag)
        for sources in interface.findall("SourceFiles"):  # the original's, of which the library is not made
            interface.remove(sources)
    interfaces = [node for node in root if node.tag in INTERFACES]
    lost: list[str] = []
    if any(values.get(p.name, p.default) != p.neutral for p in parameters if p.neutral is not None):
        lost += SLOPES
    if "shape_all" in terms.hooks or "port_inputs" in terms.hooks or terms.delay:
        lost += INPUT_SLOPES
    if "readings" in terms.hooks:
        lost += OUTPUT_SLOPES
    for interface in interfaces:
        for name in lost:
            value = interface.attrib.pop(name, None)
            if value is not None and value not in NONE and name not in withdrawn:
                withdrawn.append(name)
        if interface.tag == "ModelExchange" and (terms.memory or terms.delay):
            interface.set(*STEP_FLAGS[fmi])  # the host reports each step of its solver
    variables, structure = root.find("ModelVariables"), root.find("ModelStructure")
    if structure is not None and ("port_inputs" in terms.hooks or "added_rates" in terms.hooks):
        # Forces change dependencies of derivatives, and of outputs that depend on inputs; without them, an unknown
        # depends on everything. A variable is numbered by its position in FMI 2.0, by its value reference in FMI 3.0.
        declared = [node for node in variables if isinstance(node.tag, str)]
        numbers = {n.get("name"): str(k) if fmi == 2 else n.get("valueReference") for k, n in enumerate(declared, 1)}
        changed = {numbers[name] for name in terms.inputs}
        for unknown in structure.iter():
            dependencies = unknown.get("dependencies")
            is_rate = unknown.tag == "ContinuousStateDerivative" or unknown.getparent().tag == "Derivatives"
            if dependencies is not None and (is_rate or changed & set(dependencies.split())):
                for name in ("dependencies", "dependenciesKind"):
                    unknown.attrib.pop(name, None)
    ours = {p.name for p in parameters}
    set_starts(root, {name: value for name, value in values.items() if name not in ours}, file)
    units, group = {p.unit for p in parameters if p.unit}, root.find("UnitDefinitions")
    if group is None and units:
        group = etree.Element("UnitDefinitions")
        interfaces[-1].addnext(group)
    new = units - (set() if group is None else {unit.get("name") for unit in group})
    for unit in unit_definitions(new) if new else ():
        group.append(etree.fromstring(ElementTree.tostring(unit)))
    for k, p in enumerate(parameters):
        head = {"name": p.name, "valueReference": str(first + k), "description": p.doc, "causality": "parameter"}
        head |= {"variability": "fixed", "initial": "exact"}
        start = float(values.get(p.name, p.default))
        node = ElementTree.Element("Real" if fmi == 2 else "Float64", {} if fmi == 2 else head)
        set_unit_and_limits(node, p.unit, p.bounds)
        node.set("start", repr(start))
        if fmi == 2:
            outer = ElementTree.Element("ScalarVariable", head)
            outer.append(node)
            node = outer
        variables.append(etree.fromstring(ElementTree.tostring(node)))
    return root, withdrawn
