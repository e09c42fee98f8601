"""Vendor annotations of cosim's own FMUs; importing tools ignore them."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from cosim.fmi.sampled import TOOL, own_annotation
from cosim.model.planar import PlanarFrame
from cosim.model.traits import Traits

FRAME = ("x", "y", "heading", "forward", "right")


def annotation(traits: Traits, state: str = "json") -> Element:
    """Return `VendorAnnotations` with rates, limits and planar motion.

    Args:
        state: Format of the serialized FMU state.
    """
    root = Element("VendorAnnotations")
    node = SubElement(SubElement(root, "Tool", name=TOOL), "Traits", state=state)  # FMI allows a single element here.
    for name, rate in traits.rates.items():
        SubElement(node, "Rate", of=name, signal=rate)
    for name, (low, high) in traits.bounds.items():
        SubElement(node, "Limits", of=name, low=repr(low), high=repr(high))
    if traits.planar:
        SubElement(node, "PlanarFrame", {key: getattr(traits.planar, key) for key in FRAME})
    return root


def traits_of(fmu: Path) -> Traits | None:
    """Return the traits (rates, limits, planar frame) that cosim has stored in an FMU; None for FMUs of other tools."""
    node = own_annotation(fmu, "Traits")
    if node is None:
        return None
    frame = node.find("PlanarFrame")
    return Traits(
        {rate.attrib["of"]: rate.attrib["signal"] for rate in node.findall("Rate")},
        {n.attrib["of"]: (float(n.attrib["low"]), float(n.attrib["high"])) for n in node.findall("Limits")},
        None if frame is None else PlanarFrame(**{key: frame.attrib[key] for key in FRAME}),
    )
