"""Vendor annotations of sampled cosim FMUs: accepted step, optional inputs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring

from cosim.storage.archive import BadArchive, description_of

TOOL, AUTHOR = "cosim", "The cosim authors"


def sampled_annotation(parameter: str, optional: Iterable[str] = ()) -> Element:
    """Return `VendorAnnotations` of an FMU with a single accepted step.

    Args:
        parameter: Parameter with the accepted communication step [s].
        optional: Inputs that may stay unconnected.
    """
    root = Element("VendorAnnotations")
    node = SubElement(SubElement(root, "Tool", name=TOOL), "Sampled", parameter=parameter)
    if names := " ".join(optional):
        node.set("optional", names)
    return root


def sampled_by(fmu: Path) -> str | None:
    """Return an FMU's parameter of its accepted step, if any."""
    node = own_annotation(fmu, "Sampled")
    return None if node is None else node.get("parameter")


def optional_inputs(fmu: Path) -> frozenset[str]:
    """Return the inputs of a cosim FMU that may stay unconnected."""
    node = own_annotation(fmu, "Sampled")
    return frozenset() if node is None else frozenset(node.get("optional", "").split())


def own_annotation(fmu: Path, tag: str) -> Element | None:
    """Return an element of a cosim FMU's vendor annotations."""
    try:
        root = fromstring(description_of(fmu))
    except (OSError, BadArchive, ParseError):
        return None
    return root.find(f"VendorAnnotations/Tool[@name='{TOOL}']/{tag}")
