"""Violations of the SSP schema shipped with FMPy, reported because other tools may reject them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault
from cosim.ssp.elements import NAMESPACES

SCHEMAS = {
    "SystemStructureDescription": "SystemStructureDescription.xsd",
    "ParameterSet": "SystemStructureParameterValues.xsd",
    "ParameterMapping": "SystemStructureParameterMapping.xsd",
}
MAX_FAULTS = 5  # per file


@cache
def _schema(name: str) -> Any:
    from fmpy import ssp
    from lxml import etree

    return etree.XMLSchema(file=str(Path(ssp.__file__).with_name("schema") / name))


def slips(label: Path, text: bytes) -> list[Fault]:
    """Return the first violations of the SSP 1.0 schema in a document that has been checked as safe XML."""
    from lxml import etree

    try:
        root = etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        return [Fault(label, error.lineno or 0, 1, f"breaks the rules of XML: {error.msg}")]
    name = SCHEMAS.get(etree.QName(root).localname)
    if name is None or root.get("version") != "1.0":
        return []
    schema = _schema(name)
    schema.validate(root)
    faults = []
    for slip in list(schema.error_log)[:MAX_FAULTS]:
        reason = slip.message
        for uri, prefix in NAMESPACES.items():
            reason = reason.replace(f"{{{uri}}}", f"{prefix}:")
        faults.append(Fault(label, slip.line, 1, f"breaks the schema of SSP: {reason}"))
    return faults
