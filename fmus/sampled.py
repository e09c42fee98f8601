"""FMUs of ours that take one communication step only say so in their vendor annotations, which are read here."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring

from fmus.archive import BadArchive, description_of

TOOL = "cosim"


def sampled(parameter: str) -> Element:
    """`VendorAnnotations` of an FMU that takes no communication step but the one this parameter states [s]."""
    root = Element("VendorAnnotations")
    SubElement(SubElement(root, "Tool", name=TOOL), "Sampled", parameter=parameter)
    return root


def sampled_by(fmu: Path) -> str | None:
    """The parameter that states the only communication step an FMU of ours takes; None where there is none."""
    node = own_annotation(fmu, "Sampled")
    return None if node is None else node.get("parameter")


def own_annotation(fmu: Path, tag: str) -> Element | None:
    """What stands under this tag in the vendor annotations of an FMU of ours."""
    try:
        root = fromstring(description_of(fmu))
    except (OSError, BadArchive, ParseError):
        return None
    return root.find(f"VendorAnnotations/Tool[@name='{TOOL}']/{tag}")
