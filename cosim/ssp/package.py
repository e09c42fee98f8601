"""Files of a system: an SSP archive, or an SSD in a folder, with the line and column of each XML element."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.parsers import expat

from cosim.core.errors import Fault, InputError
from cosim.core.messages import with_prefix
from cosim.core.scratch import temporary_folder
from cosim.files.archive import MOST_XML, SSP, STRUCTURE, BadArchive, check_xml, unpack
from cosim.files.artefact import SSP as SSP_FILE
from cosim.files.kinds import check_form

NAMESPACES = {
    "http://ssp-standard.org/SSP1/SystemStructureDescription": "ssd",
    "http://ssp-standard.org/SSP1/SystemStructureCommon": "ssc",
    "http://ssp-standard.org/SSP1/SystemStructureParameterValues": "ssv",
    "http://ssp-standard.org/SSP1/SystemStructureParameterMapping": "ssm",
    "http://ssp-standard.org/SSP1/SystemStructureSignalDictionary": "ssb",
}
SCHEMAS = {
    "SystemStructureDescription": "SystemStructureDescription.xsd",
    "ParameterSet": "SystemStructureParameterValues.xsd",
    "ParameterMapping": "SystemStructureParameterMapping.xsd",
}
MAX_SLIPS = 5  # reported violations of the schema per file


@dataclass
class Element:
    """An XML element.

    In its `tag`, the namespace has the prefix used by the SSP standard, whatever prefix the file uses.
    """

    file: Path
    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    children: list[Element] = field(default_factory=list)

    def all(self, *tags: str) -> Iterator[Element]:
        """Yield all elements at a path of tags; outer tags match their first element only."""
        parent = self.first(*tags[:-1])
        return (child for child in (parent.children if parent else ()) if child.tag == tags[-1])

    def first(self, *tags: str) -> Element | None:
        """Return the first element at a path of tags, if any."""
        return next(self.all(*tags), None) if tags else self

    def descendants(self) -> Iterator[Element]:
        """Yield all nested elements at any depth."""
        for child in self.children:
            yield child
            yield from child.descendants()

    def get(self, name: str) -> str | None:
        """Return an attribute, if present."""
        return self.attributes.get(name)

    def fault(self, message: str) -> Fault:
        """Return a fault at the place of this element."""
        name = self.get("name")
        label = f'{self.tag} "{name[:60]}"' if name else self.tag
        return Fault(self.file, self.line, self.column, with_prefix(f"{label}: ", message))


@dataclass(frozen=True)
class Package:
    """Files of a package.

    Attributes:
        shown: File named by the user.
        folder: Base folder of relative names; with `packed`, names must stay inside.
        slips: Violations of the schema found while reading.
    """

    shown: Path
    folder: Path
    structure: Path
    packed: bool
    slips: list[Fault] = field(default_factory=list)

    def resolve(self, source: str) -> Path | str:
        """Return the file of a relative URI in the SSP, or a message on a URI that is not allowed."""
        name, cure = source[:80], "put the file into resources/ and use that path"
        try:
            uri = urlsplit(source)
            within = self.folder.resolve()
            path = (within / unquote(uri.path)).resolve()
            if uri.scheme not in {"", "file"} or uri.netloc:
                return f'"{name}" is not in the package; {cure}'
            if self.packed and not path.is_relative_to(within):
                return f'"{name}" is outside the package; {cure}'
            return path if path.is_file() else f'no file "{name}" in it'
        except (OSError, ValueError):  # an impossible file name
            return f'"{name}" is not a file name'

    def element(self, path: Path) -> Element:
        """Return the root element of a file; raise InputError."""
        label = path
        if self.packed:
            label = self.shown if path == self.structure else self.shown / path.relative_to(self.folder)
        try:
            text = path.read_bytes()
            root = _parse(label, text)
        except BadArchive as error:
            raise InputError.at(label, str(error)) from None
        except OSError as error:
            raise InputError.at(label, f"cannot be read: {error.strerror}") from None
        self.slips.extend(_slips(label, text))
        return root


@contextmanager
def open_package(path: Path) -> Iterator[Package]:
    """Yield an unpacked package; raise InputError if it is invalid or unsafe."""
    check_form(path, SSP_FILE)
    if path.suffix.lower() == ".ssd":
        yield Package(path, path.parent, path, packed=False)
        return
    with temporary_folder("ssp") as scratch:
        folder = scratch.resolve()
        try:
            unpack(path, folder, SSP)
        except BadArchive as error:
            raise InputError.at(path, f"is not an SSP: {error}") from None
        except OSError as error:
            raise InputError.at(path, f"cannot be unpacked: {error.strerror}") from None
        yield Package(path, folder, folder / STRUCTURE, packed=True)


def _parse(file: Path, text: bytes) -> Element:
    """Return the root of a document; raise BadArchive if invalid or unsafe."""
    if len(text) > MOST_XML:
        raise BadArchive(f"it exceeds the limit of {MOST_XML / 1e6:.0f} MB; split it")
    check_xml(file.name, text, "SSP")
    prefixes: list[dict[str, str]] = [{}]
    document = Element(file, "", {}, 0, 0)
    ancestors = [document]

    def start(name: str, attributes: dict[str, str]) -> None:
        own = {key.removeprefix("xmlns").removeprefix(":"): v for key, v in attributes.items() if key[:5] == "xmlns"}
        prefixes.append({**prefixes[-1], **own})
        prefix, _, local = name.rpartition(":")
        uri = prefixes[-1].get(prefix)
        # an undeclared prefix is assumed to be the standard's
        prefix = prefix if uri is None else NAMESPACES.get(uri, prefix or "?")
        place = parser.CurrentLineNumber, parser.CurrentColumnNumber + 1
        element = Element(file, f"{prefix}:{local}", attributes, *place)
        ancestors[-1].children.append(element)
        ancestors.append(element)

    def end(_: Any) -> None:
        ancestors.pop()
        prefixes.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(text, True)
    return document.children[0]


@cache
def _schema(name: str) -> Any:
    from fmpy import ssp
    from lxml import etree

    return etree.XMLSchema(file=str(Path(ssp.__file__).with_name("schema") / name))


def _slips(label: Path, text: bytes) -> list[Fault]:
    """Return the first violations of the SSP 1.0 schema shipped with FMPy, for which other tools may reject a file."""
    from lxml import etree

    try:
        root = etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        return [Fault(label, error.lineno or 0, 1, f"is not valid XML: {error.msg}")]
    name = SCHEMAS.get(etree.QName(root).localname)
    if name is None or root.get("version") != "1.0":
        return []
    schema = _schema(name)
    schema.validate(root)
    faults = []
    for slip in list(schema.error_log)[:MAX_SLIPS]:
        reason = slip.message
        for uri, prefix in NAMESPACES.items():
            reason = reason.replace(f"{{{uri}}}", f"{prefix}:")
        faults.append(Fault(label, slip.line, 1, f"violates the schema of SSP: {reason}"))
    return faults
