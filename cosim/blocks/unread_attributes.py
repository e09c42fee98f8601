"""Attributes of a model description that FMPy does not read: negated aliases and inverse display units."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from fmpy.model_description import DisplayUnit, ModelVariable

from cosim.storage.archive import DESCRIPTION


class NegatedAlias(ModelVariable):  # type: ignore[misc]
    """A variable of FMI 1.0 whose value is minus that of its value reference; of a Boolean, the other value."""

    __slots__ = ()
    negated = True


class InverseDisplayUnit(DisplayUnit):  # type: ignore[misc]
    """A display unit of FMI 3.0 with display value = factor / value."""

    __slots__ = ()
    inverse = True


def add_unread_attributes(path: Path, description: Any) -> None:
    """Mark the negated aliases and the inverse display units of a description."""
    if description.fmiVersion == "1.0":
        with zipfile.ZipFile(path) as archive:
            root = ElementTree.fromstring(archive.read(DESCRIPTION))
        negated = {v.get("name") for v in root.iter("ScalarVariable") if v.get("alias") == "negatedAlias"}
        for variable in description.modelVariables:
            if variable.name in negated:
                variable.__class__ = NegatedAlias
    elif any(unit.displayUnits for unit in description.unitDefinitions) and description.fmiVersion.startswith("3"):
        with zipfile.ZipFile(path) as archive, archive.open(DESCRIPTION) as stream:
            nodes = next(e for _, e in ElementTree.iterparse(stream) if e.tag == "UnitDefinitions")
        for unit, node in zip(description.unitDefinitions, nodes.findall("Unit"), strict=True):
            for display, about in zip(unit.displayUnits, node.findall("DisplayUnit"), strict=True):
                if about.get("inverse") in {"true", "1"}:
                    display.__class__ = InverseDisplayUnit
