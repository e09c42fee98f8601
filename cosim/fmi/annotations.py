"""Vendor annotations of the FMUs that cosim builds; other tools ignore them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element, ParseError, fromstring

from cosim.files.archive import BadArchive, description_of

if TYPE_CHECKING:
    from cosim.model.traits import Traits

TOOL, AUTHOR = "cosim", "The cosim authors"


def sampled_by(fmu: Path) -> str | None:
    """Return the name of the parameter whose value is the only accepted communication step; None for any step."""
    node = _own_annotation(fmu, "Sampled")
    return None if node is None else node.get("parameter")


def optional_inputs(fmu: Path) -> frozenset[str]:
    """Return the inputs of an FMU built by cosim that may stay unconnected without a warning."""
    node = _own_annotation(fmu, "Sampled")
    return frozenset() if node is None else frozenset(node.get("optional", "").split())


def traits_of(fmu: Path) -> Traits | None:
    """Return the traits (rates, limits, planar frame) that cosim has stored in an FMU; None for FMUs of other tools."""
    node = _own_annotation(fmu, "Traits")
    if node is None:
        return None
    from cosim.model.planar import PlanarFrame
    from cosim.model.traits import Traits

    frame = node.find("PlanarFrame")
    return Traits(
        {rate.attrib["of"]: rate.attrib["signal"] for rate in node.findall("Rate")},
        {n.attrib["of"]: (float(n.attrib["low"]), float(n.attrib["high"])) for n in node.findall("Limits")},
        None if frame is None else PlanarFrame(**frame.attrib),
    )


def _own_annotation(fmu: Path, tag: str) -> Element | None:
    try:
        root = fromstring(description_of(fmu))
    except (OSError, BadArchive, ParseError):
        return None
    return root.find(f"VendorAnnotations/Tool[@name='{TOOL}']/{tag}")
