"""Writing of SSP files for other importing tools.

libcosim and ecos identify elements by prefix, accept no nested systems, and read only inline parameter sets of
components; FMPy requires a connection to each input connector. The written system therefore has no connectors of its
own, components have their outputs and connected inputs, and each component has an inline set of start values. For
FMPy's `simulate_ssp`, pass `resources/start.ssv` as `parameter_set`; its names are prefixed by the component.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from cosim.core.drafts import draft_of
from cosim.core.units import SI, definition_of
from cosim.core.version import __version__
from cosim.files.archive import ARCHIVE_DATE, STRUCTURE
from cosim.fmi.description import unit_definition
from cosim.ssp.read import FMU_TYPE, SSP_NAMESPACES, Units

START_FILE, RESOURCES_FOLDER = "start", "resources"
OSP = "http://opensimulationplatform.com/SSP/OSPAnnotations"
OSP_TYPE = "com.opensimulationplatform"  # annotation from which libcosim reads the communication step
Value = float | int | bool | str


@dataclass(frozen=True)
class SspConnector:
    """A connector to write, with its kind and SSP type."""

    name: str
    kind: str
    type: str
    unit: str = ""


@dataclass(frozen=True)
class SspFmu:
    """An FMU of the system, with start values: name → (type, value)."""

    name: str
    fmu: Path
    ports: Sequence[SspConnector]
    start: Mapping[str, tuple[str, Value]] = field(default_factory=dict)


Connection = tuple[tuple[str, str], tuple[str, str], tuple[float, float]]  # of output and input, factor and offset


def defined_units(used: Iterable[tuple[Any, str]]) -> Units:
    """Return the SI definition of each unit: exponents of the base units, factor and offset.

    Args:
        used: Model description, or None, and unit of each connector.
    """
    units: dict[str, tuple[float, ...]] = {}
    for description, name in used:
        definition = (None if description is None else unit_definition(description, name)) or definition_of(name)
        if name and definition is not None:
            units.setdefault(name, definition)
    return units


def write_ssp(
    path: Path,
    models: Sequence[SspFmu],
    connections: Sequence[Connection],
    units: Units,
    times: tuple[float, float, float],
    *,
    name: str,
    description: str,
) -> Path:
    """Write an SSP completely or not at all; equal systems give equal bytes.

    Args:
        times: Start, stop and communication step [s].
    """
    files = {model.name: f"{RESOURCES_FOLDER}/{model.name}.fmu" for model in models}
    attributes = {"xmlns:osp": OSP, "name": name, "version": "1.0", "generationTool": f"cosim {__version__}"}
    root = Element("ssd:SystemStructureDescription", _namespaces("ssd", "ssc", "ssv") | attributes)
    system = SubElement(root, "ssd:System", name="system", description=description)
    elements = SubElement(system, "ssd:Elements")
    for model in models:
        about = {"name": model.name, "type": FMU_TYPE, "source": files[model.name], "implementation": "CoSimulation"}
        element = SubElement(elements, "ssd:Component", about)
        connectors = SubElement(element, "ssd:Connectors") if model.ports else element
        for port in model.ports:
            connector = SubElement(connectors, "ssd:Connector", name=port.name, kind=port.kind)
            SubElement(connector, f"ssc:{port.type}", {"unit": port.unit} if port.unit else {})
        if model.start:
            binding = SubElement(SubElement(element, "ssd:ParameterBindings"), "ssd:ParameterBinding")
            SubElement(binding, "ssd:ParameterValues").append(_parameter_set(model.start.items()))
    listed = SubElement(system, "ssd:Connections") if connections else system
    for (begin, output), (end, target), (factor, offset) in connections:
        ends = {"startElement": begin, "startConnector": output, "endElement": end, "endConnector": target}
        if (factor, offset) == (1.0, 0.0):
            SubElement(listed, "ssd:Connection", ends)
            continue
        # the transformation includes the conversion of units
        connection = SubElement(listed, "ssd:Connection", {**ends, "suppressUnitConversion": "true"})
        SubElement(connection, "ssc:LinearTransformation", factor=repr(factor), offset=repr(offset))
    _write_units(root, "ssd:Units", units)
    experiment = SubElement(root, "ssd:DefaultExperiment", startTime=repr(times[0]), stopTime=repr(times[1]))
    annotation = SubElement(SubElement(experiment, "ssd:Annotations"), "ssc:Annotation", type=OSP_TYPE)
    SubElement(SubElement(annotation, "osp:Algorithm"), "osp:FixedStepAlgorithm", baseStepSize=repr(times[2]))
    members = {STRUCTURE: _xml(root)}
    if any(model.start for model in models):
        start = _parameter_set((f"{m.name}.{parameter}", value) for m in models for parameter, value in m.start.items())
        start.attrib |= _namespaces("ssv")
        members[f"{RESOURCES_FOLDER}/{START_FILE}.ssv"] = _xml(start)
    members |= {files[model.name]: model.fmu.read_bytes() for model in models}
    with draft_of(path) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(zipfile.ZipInfo(member, ARCHIVE_DATE), data, zipfile.ZIP_DEFLATED)
    return path


def write_parameter_set(path: Path, name: str, values: Mapping[str, tuple[float, str]], units: Units) -> Path:
    """Write an SSV file of real parameters completely or not at all.

    Args:
        values: Parameter → value and unit, "" without one.
        units: Definitions of the units.
    """
    root = _parameter_set(((parameter, ("Real", value)) for parameter, (value, _) in values.items()), name)
    root.attrib |= _namespaces("ssv", "ssc")
    for real, (_, unit) in zip(root.iter("ssv:Real"), values.values(), strict=True):
        if unit in units:
            real.set("unit", unit)
    _write_units(root, "ssv:Units", units)
    with draft_of(path) as draft:
        draft.write_bytes(_xml(root))
    return path


def _xml(root: Element) -> bytes:
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True))


def _namespaces(*prefixes: str) -> dict[str, str]:
    """Return the XML attributes that declare namespaces."""
    return {f"xmlns:{prefix}": uri for uri, prefix in SSP_NAMESPACES.items() if prefix in prefixes}


def _write_units(root: Element, tag: str, definitions: Units) -> None:
    """Add the definitions of units, if there are any."""
    if not definitions:
        return
    units = SubElement(root, tag)
    for name, definition in sorted(definitions.items()):
        base = SubElement(SubElement(units, "ssc:Unit", name=name), "ssc:BaseUnit")
        for unit, exponent in zip(SI, definition, strict=False):
            if exponent:
                base.set(unit, str(int(exponent)))
        if definition[-2] != 1.0:
            base.set("factor", repr(definition[-2]))
        if definition[-1] != 0.0:
            base.set("offset", repr(definition[-1]))


def _parameter_set(values: Iterable[tuple[str, tuple[str, Value]]], name: str = START_FILE) -> Element:
    element = Element("ssv:ParameterSet", version="1.0", name=name)
    parameters = SubElement(element, "ssv:Parameters")
    for parameter, (kind, value) in values:
        text = str(value).lower() if isinstance(value, bool) else value if isinstance(value, str) else repr(value)
        SubElement(SubElement(parameters, "ssv:Parameter", name=parameter), f"ssv:{kind}", value=text)
    return element
