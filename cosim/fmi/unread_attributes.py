"""What FMPy does not read of a description: dependencies and negated aliases of FMI 1.0, differences, display units."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from fmpy.model_description import DisplayUnit, ModelVariable, Unknown

from cosim.files.archive import DESCRIPTION

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
    """Mark negated aliases, differences and inverse display units; add the dependencies of the outputs of FMI 1.0."""
    with zipfile.ZipFile(path) as archive:
        content = archive.read(DESCRIPTION)
    words = b"relativeQuantity", b"inverse", b"\0"  # the last one in UTF-16
    if description.fmiVersion != "1.0" and not any(word in content for word in words):
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
    if description.fmiVersion == "1.0":
        # `dependencies` is None without the element `DirectDependency`.
        variables = {variable.name: variable for variable in description.modelVariables}
        outputs = []
        for variable in description.modelVariables:
            if variable.causality == "output" and (node := nodes.get(variable.name)) is not None:
                direct = node.find("DirectDependency")
                names = None if direct is None else [(name.text or "").strip() for name in direct.iterfind("Name")]
                known = names is not None and all(name in variables for name in names)
                dependencies = [variables[name] for name in names or ()] if known else None
                outputs.append(Unknown(variable=variable, dependencies=dependencies))
        description.outputs = outputs
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
