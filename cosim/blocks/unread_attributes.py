"""Attributes of a model description that FMPy does not read: negated aliases, differences, inverse display units."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from fmpy.model_description import DisplayUnit, ModelVariable

from cosim.storage.archive import DESCRIPTION

TRUE = {"true", "1"}


class NegatedAlias(ModelVariable):  # type: ignore[misc]
    """A variable of FMI 1.0 whose value is minus that of its value reference; of a Boolean, the other value."""

    __slots__ = ()
    negated = True


class InverseDisplayUnit(DisplayUnit):  # type: ignore[misc]
    """A display unit of FMI 3.0 with display value = factor / value."""

    __slots__ = ()
    inverse = True


def add_unread_attributes(path: Path, description: Any) -> None:
    """Mark negated aliases, differences and inverse display units of a description."""
    with zipfile.ZipFile(path) as archive:
        content = archive.read(DESCRIPTION)
    words = b"negatedAlias", b"relativeQuantity", b"inverse", b"\0"  # the last one in UTF-16
    if not any(word in content for word in words):
        return
    root = ElementTree.fromstring(content)
    nodes = {node.get("name"): node for node in root.iterfind("ModelVariables/*")}
    for variable in description.modelVariables:
        if (node := nodes.get(variable.name)) is None:
            continue
        if description.fmiVersion == "1.0" and node.get("alias") == "negatedAlias":
            variable.__class__ = NegatedAlias
        for part in (node, *node):
            if (relative := part.get("relativeQuantity")) is not None:
                variable.relativeQuantity = relative in TRUE
    inverse = {
        (unit.get("name"), display.get("name"))
        for unit in root.iterfind("UnitDefinitions/Unit")
        for display in unit.iterfind("DisplayUnit")
        if display.get("inverse") in TRUE
    }
    for unit in description.unitDefinitions:
        for display in unit.displayUnits:
            if (unit.name, display.name) in inverse:
                display.__class__ = InverseDisplayUnit
