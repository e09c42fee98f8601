"""Attributes that FMPy ignores: dependencies and negated aliases of FMI 1.0, differences, inverse display units."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from fmpy.model_description import DisplayUnit, ModelVariable, Unknown

from cosim.files.archive import description_of

TRUE = {"true", "1"}


class NegatedAlias(ModelVariable):  # type: ignore[misc]
    """A variable of FMI 1.0 with the negative value of its value reference; for a Boolean, the complement."""

    __slots__ = ()
    negated = True


class InverseDisplayUnit(DisplayUnit):  # type: ignore[misc]
    """A display unit of FMI 3.0 with display value = factor / value."""

    __slots__ = ()
    inverse = True


def add_unread_attributes(path: Path, description: Any) -> None:
    """Mark negated aliases, differences and inverse display units; add the dependencies of the outputs of FMI 1.0."""
    content, is_first = description_of(path), description.fmiVersion == "1.0"
    words = b"relativeQuantity", b"inverse", b"\0"  # zero bytes occur in UTF-16
    if not is_first and not any(word in content for word in words):
        return
    root, outputs = ElementTree.fromstring(content), []
    variables = {variable.name: variable for variable in description.modelVariables}
    for node in root.iterfind("ModelVariables/*"):
        if (variable := variables.get(node.get("name"))) is None:
            continue
        for part in (node, *node):
            if (relative := part.get("relativeQuantity")) is not None:
                variable.relativeQuantity = relative in TRUE
        if is_first and node.get("alias") == "negatedAlias":
            variable.__class__ = NegatedAlias
        if is_first and variable.causality == "output":
            direct = node.find("DirectDependency")  # if absent, the dependencies are unknown
            names = [None] if direct is None else [(name.text or "").strip() for name in direct.iterfind("Name")]
            dependencies = [variables[name] for name in names] if variables.keys() >= {*names} else None
            outputs.append(Unknown(variable=variable, dependencies=dependencies))
    if is_first:
        description.outputs = outputs
    displays = {
        (unit.name, display.name): display for unit in description.unitDefinitions for display in unit.displayUnits
    }
    for unit in root.iterfind("UnitDefinitions/Unit"):
        for node in unit.iterfind("DisplayUnit"):
            display = displays.get((unit.get("name"), node.get("name")))
            if display is not None and node.get("inverse") in TRUE:
                display.__class__ = InverseDisplayUnit
