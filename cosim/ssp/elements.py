"""XML elements with their line and column in the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from cosim.base.errors import Fault
from cosim.base.messages import with_prefix
from cosim.storage.archive import MOST_XML, BadArchive, check_xml

NAMESPACES = {
    "http://ssp-standard.org/SSP1/SystemStructureDescription": "ssd",
    "http://ssp-standard.org/SSP1/SystemStructureCommon": "ssc",
    "http://ssp-standard.org/SSP1/SystemStructureParameterValues": "ssv",
    "http://ssp-standard.org/SSP1/SystemStructureParameterMapping": "ssm",
    "http://ssp-standard.org/SSP1/SystemStructureSignalDictionary": "ssb",
}


@dataclass
class Element:
    """An XML element.

    Its `tag` has the standard's prefix of the namespace, whichever prefix the file uses.
    """

    file: Path
    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    children: list[Element] = field(default_factory=list)

    def all(self, *tags: str) -> Iterator[Element]:
        """Yield all elements at a path of tags; for each outer tag, only the first element is searched."""
        parent = self.first(*tags[:-1])
        return (child for child in (parent.children if parent else ()) if child.tag == tags[-1])

    def first(self, *tags: str) -> Element | None:
        """Return the first element at a path of tags, if any."""
        return next(self.all(*tags), None) if tags else self

    def get(self, name: str) -> str | None:
        """Return an attribute, if present."""
        return self.attributes.get(name)

    def fault(self, message: str) -> Fault:
        """Return a fault of this element."""
        name = self.get("name")
        label = f'{self.tag} "{name[:60]}"' if name else self.tag
        message = with_prefix(f"{label}: ", message)
        return Fault(self.file, self.line, self.column, message)


def parse(file: Path, text: bytes) -> Element:
    """Return the root of a document; raise BadArchive if invalid or unsafe."""
    if len(text) > MOST_XML:
        raise BadArchive(f"it has more than the {MOST_XML / 1e6:.0f} MB that are read; split it")
    check_xml(file.name, text, "SSP")
    prefixes: list[dict[str, str]] = [{}]
    document = Element(file, "", {}, 0, 0)
    ancestors = [document]

    def start(name: str, flat: list[str]) -> None:
        attributes = dict(zip(flat[::2], flat[1::2], strict=True))
        own = {key.removeprefix("xmlns").removeprefix(":"): v for key, v in attributes.items() if key[:5] == "xmlns"}
        prefixes.append({**prefixes[-1], **own})
        prefix, _, local = name.rpartition(":")
        uri = prefixes[-1].get(prefix)
        # an undeclared prefix is taken as the standard's
        prefix = prefix if uri is None else NAMESPACES.get(uri, prefix or "?")
        place = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        element = Element(file, f"{prefix}:{local}", attributes, *place)
        ancestors[-1].children.append(element)
        ancestors.append(element)

    def end(_: Any) -> None:
        ancestors.pop()
        prefixes.pop()

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return document.children[0]
