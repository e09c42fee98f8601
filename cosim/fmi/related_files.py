"""Files that an FMU carries, by the layered standard FMI-LS-REF: manifest and experiments, read and written.

Read are the manifests of 1.0.0-alpha.1 and 1.0.0-beta.1 and the experiments of 1.0.0-alpha.1 (its appendix A, since
beta.1 a specification of its own); written are manifests of beta.1. Source: https://github.com/modelica/fmi-ls-ref.
"""

from __future__ import annotations

import hashlib
import math
import posixpath
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element, SubElement, fromstring, indent, tostring

from cosim.base.drafts import draft_of
from cosim.base.messages import Message, join
from cosim.storage.archive import BadArchive, check_xml

ATTRIBUTE_MISSING = "{name}: <{tag}> has no attribute {attribute}, or an empty one"

NAME = "org.fmi-standard.fmi-ls-ref"
FOLDER = f"extra/{NAME}"
MANIFEST = f"{FOLDER}/fmi-ls-manifest.xml"
VERSION = "1.0.0-beta.1"
READ_VERSIONS = ("1.0.0-alpha.1", VERSION)
DESCRIPTION = "Layered Standard providing information on related files included in an FMU."
NAMESPACE = "http://fmi-standard.org/fmi-ls-manifest"
EXPERIMENTS = "application/x-ma-ls-experiments"  # of 1.0.0-alpha.1; x-ma-hs-experiments is another format
BITS = (224, 256, 384, 512)  # of the checksums
CSV, SSV, BINARY = "text/csv", "application/x-ssp-parameter-set", "application/octet-stream"
ROLE = re.compile(
    r"document|requirement|specification|model|parameter|system|testcase"
    r"|experiment(/(smoke-test|validation|uncertainty-analysis))?|result|method|rationale|report|request|delivery"
    r"|configuration|signature|serialized-state(/.*)?|meta-data|other"
)
INSTANCE = "http://www.w3.org/2001/XMLSchema-instance"  # attributes of which every schema allows
CHECKSUMS = {f"{family}{bits}": f"{of}{bits}" for family, of in (("SHA3-", "sha3_"), ("SHA-", "sha")) for bits in BITS}
SCHEMA = {  # attributes and elements besides Annotations, which hold anything
    "fmiReferences": ([f"{{{NAMESPACE}}}fmi-ls-{key}" for key in ("name", "version", "description")], ["Related"]),
    "Related": (["type", "source", "role", "description", "checksum", "checksumType"], ["Label"]),
    "Label": (["name", "description"], []),
}
FIXED_DATE = (1980, 1, 1, 0, 0, 0)  # equal content gives equal bytes
ATTRIBUTES = {"stop": "stopTime", "start": "startTime", "tolerance": "tolerance", "step": "stepSize"}


@dataclass(frozen=True)
class RelatedFile:
    """A file described by a manifest.

    Attributes:
        source: URI relative to the manifest.
        role: Purpose of the file, for example `experiment/validation`.
        type: MIME type.
        labels: Name → description of labels.
        checksum: Hexadecimal digest of the file, by a draft after 1.0.0-beta.1.
        checksum_type: Algorithm of the digest, "" for SHA3-256.
    """

    source: str
    role: str
    type: str = BINARY
    description: str = ""
    labels: tuple[tuple[str, str], ...] = ()
    checksum: str = ""
    checksum_type: str = ""

    @property
    def member(self) -> str | None:
        """Return the name in the archive; None for an absolute URI or a path outside the archive."""
        return member_of(FOLDER, self.source)

    def agrees(self, content: bytes) -> bool | None:
        """Return whether a content has the checksum; None without one or with an unknown algorithm."""
        algorithm = self.checksum_type or "SHA3-256"
        if not self.checksum or algorithm not in CHECKSUMS:
            return None
        return hashlib.new(CHECKSUMS[algorithm], content).hexdigest() == self.checksum.strip().lower()


@dataclass(frozen=True)
class Experiment:
    """A run of the FMU that somebody can repeat.

    Attributes:
        start: Start time [s]; None takes that of the FMU, as for stop, step and tolerance.
        parameters: URI of an SSV file with start values; "" for none.
        stimuli: URI of a CSV file with the inputs over time; "" for none.
        references: URI of a CSV file with the expected outputs over time; "" for none.
    """

    name: str
    description: str = ""
    start: float | None = None
    stop: float | None = None
    step: float | None = None
    tolerance: float | None = None
    parameters: str = ""
    stimuli: str = ""
    references: str = ""


@dataclass(frozen=True)
class RelatedManifest:
    """Content of a manifest: files, and warnings about its form."""

    version: str
    files: tuple[RelatedFile, ...]
    warnings: tuple[Message, ...] = ()


def member_of(folder: str, uri: str) -> str | None:
    """Return the name in the archive of a URI relative to `folder`; None for an absolute URI or one that leads out."""
    parts = urlsplit(uri)
    path = unquote(parts.path)
    name = posixpath.normpath(posixpath.join(folder, path))
    absolute = parts.scheme or parts.netloc or path.startswith("/") or "\\" in path or not path
    return None if absolute or name == ".." or name.startswith("../") else name


def read_manifest(text: bytes) -> RelatedManifest:
    """Return the content of a manifest.

    Raises:
        BadArchive: The manifest is no manifest of this standard, or breaks its schema. What a later version may have
            added is a warning.
    """
    root = _root_of(MANIFEST, text, "fmiReferences")
    warnings = []
    name, version, description = (
        root.get(f"{{{NAMESPACE}}}fmi-ls-{key}") for key in ("name", "version", "description")
    )
    if name != NAME:
        raise BadArchive(f"{MANIFEST} is of the layered standard {name}, not of {NAME}")
    if not version:
        raise BadArchive(ATTRIBUTE_MISSING.format(name=MANIFEST, tag="fmiReferences", attribute="fmi-ls-version"))
    if version not in READ_VERSIONS:
        known = " and ".join(READ_VERSIONS)
        warnings.append(f"{MANIFEST} has version {version}; {known} are known; read as {VERSION}")
    if description is None:
        warnings.append(f"{MANIFEST} has no fmi-ls-description, which FMI-LS-REF requires")
    if unknown := [*_unknown(root)]:
        if version in READ_VERSIONS:
            raise BadArchive(join("; ", unknown))
        warnings += [f"{each}; it is left out" for each in unknown]
    files = []
    for element in root.findall("Related"):
        source, role = (_needed(MANIFEST, element, key) for key in ("source", "role"))
        if not ROLE.fullmatch(role):
            raise BadArchive(
                f'{MANIFEST}: {source} has the role "{role}"; FMI-LS-REF has for example experiment, result, parameter'
            )
        labels = tuple((_needed(MANIFEST, e, "name"), e.get("description", "")) for e in element.findall("Label"))
        type_, about = element.get("type", BINARY), element.get("description", "")
        checksum = element.get("checksum", ""), element.get("checksumType", "")
        files.append(RelatedFile(source, role, type_, about, labels, *checksum))
    return RelatedManifest(version, tuple(files), tuple(warnings))


def read_experiments(name: str, text: bytes) -> list[Experiment]:
    """Return the experiments of a file.

    Raises:
        BadArchive: The file does not follow the schema of experiments.
    """
    experiments = []
    for element in _root_of(name, text, "Experiments"):
        if element.tag != "Experiment":
            raise BadArchive(f"{name}: FMI-LS-REF has no element <{element.tag}>")
        settings: dict[str, Any] = {}
        for key, attribute in ATTRIBUTES.items():
            if (word := element.get(attribute)) is not None:
                try:
                    settings[key] = float(word)
                except ValueError:
                    settings[key] = math.nan
                if not math.isfinite(settings[key]):
                    raise BadArchive(f'{name}: {attribute} is "{word}"; give a number')
        for part in element:
            if part.tag not in {"Parameters", "Stimuli", "References"}:
                raise BadArchive(f"{name}: FMI-LS-REF has no element <{part.tag}>")
            default = SSV if part.tag == "Parameters" else CSV
            if (type_ := part.get("type", default)) != default:
                raise BadArchive(f"{name}: <{part.tag}> is of type {type_}; only {default} is read")
            settings[part.tag.lower()] = _needed(name, part, "source")
        title, about = _needed(name, element, "name"), element.get("description", "")
        experiments.append(Experiment(title, about, **settings))
    if not experiments:
        raise BadArchive(f"{name} has no experiment")
    return experiments


def manifest_text(files: Sequence[RelatedFile]) -> bytes:
    """Return a manifest of 1.0.0-beta.1."""
    about = {"name": NAME, "version": VERSION, "description": DESCRIPTION}
    attributes = {f"fmi-ls:fmi-ls-{key}": value for key, value in about.items()}
    root = Element("fmiReferences", {"xmlns:fmi-ls": NAMESPACE, **attributes})
    for file in files:
        words = {"type": file.type, "source": file.source, "role": file.role, "description": file.description}
        words |= {"checksum": file.checksum, "checksumType": file.checksum_type}
        element = SubElement(root, "Related", {key: word for key, word in words.items() if word})
        for name, description in file.labels:
            SubElement(element, "Label", {"name": name} | ({"description": description} if description else {}))
    return _xml(root)


def experiments_text(name: str, experiments: Sequence[Experiment], description: str = "") -> bytes:
    """Return a file of experiments."""
    root = Element("Experiments", {"name": name} | ({"description": description} if description else {}))
    for each in experiments:
        numbers = {attribute: getattr(each, key) for key, attribute in ATTRIBUTES.items()}
        texts = {"description": each.description} if each.description else {}
        words = {attribute: repr(value) for attribute, value in numbers.items() if value is not None}
        element = SubElement(root, "Experiment", {"name": each.name, **texts, **words})
        for tag in ("Parameters", "Stimuli", "References"):
            if source := getattr(each, tag.lower()):
                SubElement(element, tag, source=source)
    return _xml(root)


def add_related(fmu: Path, files: Sequence[tuple[RelatedFile, bytes]], more: Mapping[str, bytes] | None = None) -> None:
    """Add files and their manifest to an FMU; every other member stays byte for byte.

    Files of an earlier manifest stay described, unless a new one has the same source.

    Args:
        files: Files to describe, with their content.
        more: Further members that experiments name, by URI.
    """
    with zipfile.ZipFile(fmu) as archive:
        kept: tuple[RelatedFile, ...] = ()
        if MANIFEST in archive.namelist():
            kept = read_manifest(archive.read(MANIFEST)).files
        new = {file.source for file, _ in files}
        described = [*(file for file in kept if file.source not in new), *(file for file, _ in files)]
        content = {f"{FOLDER}/{file.source}": text for file, text in files}
        content |= {f"{FOLDER}/{source}": text for source, text in (more or {}).items()}
        content[MANIFEST] = manifest_text(described)
        with draft_of(fmu) as draft, zipfile.ZipFile(draft, "w") as copy:
            for member in archive.infolist():
                if member.filename not in content:
                    copy.writestr(member, archive.read(member))
            for name, text in content.items():
                member = zipfile.ZipInfo(name, FIXED_DATE)
                member.compress_type = zipfile.ZIP_DEFLATED
                copy.writestr(member, text)


def _root_of(name: str, text: bytes, tag: str) -> Element:
    check_xml(name, text, "FMI-LS-REF")
    root = fromstring(text)
    if root.tag != tag:
        raise BadArchive(f"{name} begins with <{root.tag}>; <{tag}> is needed")
    return root


def _unknown(element: Element) -> Iterator[Message]:
    """Yield messages on attributes and elements of a manifest that its schema does not have."""
    attributes, elements = SCHEMA[element.tag]
    for key in element.attrib:
        if key not in attributes and not key.startswith(f"{{{INSTANCE}}}"):
            known = ", ".join(name.rpartition("}")[2] for name in attributes)
            yield f"{MANIFEST}: FMI-LS-REF has no attribute {key} of <{element.tag}>; known are {known}"
    for each in element:
        if each.tag in elements:
            yield from _unknown(each)
        elif each.tag != "Annotations":
            yield f"{MANIFEST}: FMI-LS-REF has no element <{each.tag}>"


def _needed(name: str, element: Element, attribute: str) -> str:
    value = element.get(attribute)
    if not value:
        raise BadArchive(ATTRIBUTE_MISSING.format(name=name, tag=element.tag, attribute=attribute))
    return value


def _xml(root: Element) -> bytes:
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'.encode()
