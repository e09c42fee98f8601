"""What an FMU of ours says of itself beside FMI, in its vendor annotations: other hosts pass it over."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from cosim.fmi.sampled import TOOL, own_annotation
from cosim.model.planar import PlanarFrame
from cosim.model.traits import Traits

FRAME = ("x", "y", "heading", "forward", "right")


def annotation(traits: Traits, state: str = "json") -> Element:
    """`VendorAnnotations`: in what form the state is ours to read; rates, limits, a motion in a plane."""
    root = Element("VendorAnnotations")
    node = SubElement(SubElement(root, "Tool", name=TOOL), "Traits", state=state)  # FMI allows one element
    if traits.static:
        node.set("static", "true")
    for name, rate in traits.rates.items():
        SubElement(node, "Rate", of=name, signal=rate)
    for name, (low, high) in traits.bounds.items():
        SubElement(node, "Limits", of=name, low=repr(low), high=repr(high))
    if traits.planar:
        SubElement(node, "PlanarFrame", {key: getattr(traits.planar, key) for key in FRAME})
    return root


def traits_of(fmu: Path) -> Traits | None:
    """What the FMU says of its signals; None where it is not one of ours."""
    node = own_annotation(fmu, "Traits")
    if node is None:
        return None
    frame = node.find("PlanarFrame")
    return Traits(
        {rate.attrib["of"]: rate.attrib["signal"] for rate in node.findall("Rate")},
        {n.attrib["of"]: (float(n.attrib["low"]), float(n.attrib["high"])) for n in node.findall("Limits")},
        None if frame is None else PlanarFrame(**{key: frame.attrib[key] for key in FRAME}),
        node.get("static") == "true",
    )
