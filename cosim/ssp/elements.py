"""XML elements with their places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from cosim.base.errors import Fault
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
    """An element; `tag` has the standard's prefix of its namespace, regardless of the file's prefix."""

    file: Path
    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        """Yield the children with a tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, *tags: str) -> Element | None:
        """Return the first element at a path of tags, if any."""
        found: Element | None = self
        for tag in tags:
            found = next(found.all(tag), None) if found is not None else None
        return found

    def get(self, name: str) -> str | None:
        """Return an attribute, if present."""
        return self.attributes.get(name)

    def fault(self, message: str) -> Fault:
        """Return a fault of this element."""
        name = self.get("name")
        called = f'{self.tag} "{name[:60]}"' if name else self.tag
        return Fault(self.file, self.line, self.column, f"{called}: {message}")


def parse(file: Path, text: bytes) -> Element:
    """Return the root of a document; raise BadArchive if invalid or unsafe."""
    if len(text) > MOST_XML:
        raise BadArchive(f"it has more than the {MOST_XML / 1e6:.0f} MB that are read")
    check_xml(file.name, text, "SSP")
    prefixes: list[dict[str, str]] = [{}]
    open_: list[Element] = []
    roots: list[Element] = []

    def start(name: str, flat: list[str]) -> None:
        attributes = dict(zip(flat[::2], flat[1::2], strict=True))
        own = {key.removeprefix("xmlns").removeprefix(":"): v for key, v in attributes.items() if key[:5] == "xmlns"}
        prefixes.append({**prefixes[-1], **own})
        prefix, _, local = name.rpartition(":")
        known = prefixes[-1].get(prefix)
        # an undeclared prefix is taken as the standard's
        prefix = prefix if known is None else NAMESPACES.get(known, prefix or "?")
        element = Element(
            file, f"{prefix}:{local}", attributes, parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        )
        (open_[-1].children if open_ else roots).append(element)
        open_.append(element)

    def end(_: Any) -> None:
        open_.pop()
        prefixes.pop()

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return roots[0]
