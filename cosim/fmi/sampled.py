"""What sampled FMUs of ours say in their vendor annotations: their only step, optional inputs, their control law."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring

from cosim.storage.archive import BadArchive, description_of

TOOL, AUTHOR = "cosim", "The cosim authors"


def sampled(parameter: str, optional: Iterable[str] = (), law: str = "") -> Element:
    """`VendorAnnotations` of an FMU that takes no communication step but the one this parameter states [s].

    optional: inputs that may stay unconnected
    law:      the control law its start values are designed for, where it is not the designer's first
    """
    root = Element("VendorAnnotations")
    node = SubElement(SubElement(root, "Tool", name=TOOL), "Sampled", parameter=parameter)
    if names := " ".join(optional):
        node.set("optional", names)
    if law:
        node.set("law", law)
    return root


def law_of(fmu: Path) -> str:
    """The control law that the start values of an FMU are designed for, "" where it says none."""
    node = own_annotation(fmu, "Sampled")
    return "" if node is None else node.get("law", "")


def sampled_by(fmu: Path) -> str | None:
    """The parameter that states the only communication step an FMU of ours takes; None where there is none."""
    node = own_annotation(fmu, "Sampled")
    return None if node is None else node.get("parameter")


def optional_inputs(fmu: Path) -> frozenset[str]:
    """Inputs that an FMU of ours lets stay unconnected."""
    node = own_annotation(fmu, "Sampled")
    return frozenset() if node is None else frozenset(node.get("optional", "").split())


def own_annotation(fmu: Path, tag: str) -> Element | None:
    """What stands under this tag in the vendor annotations of an FMU of ours."""
    try:
        root = fromstring(description_of(fmu))
    except (OSError, BadArchive, ParseError):
        return None
    return root.find(f"VendorAnnotations/Tool[@name='{TOOL}']/{tag}")
