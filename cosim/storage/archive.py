"""Checks of FMU and SSP archives before anything is unpacked or parsed.

Rejected are archives that would fill disk or memory or write outside their folder, and XML with entity definitions.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import BinaryIO, TypeVar
from xml.parsers import expat

from cosim.base.drafts import is_full

DESCRIPTION = "modelDescription.xml"
STRUCTURE = "SystemStructure.ssd"
MOST_FILES = 20_000
MOST_UNPACKED = 1_000_000_000  # unpacked size of all files [bytes], whatever their compression
MOST_OF_FREE = 0.9  # usable fraction of the free disk space
BOMB_RATIO = 100.0  # compression ratio of an archive beyond MOST_UNPACKED that suggests a bomb
LOCAL_HEADER = 30  # minimum size of a file's local header [bytes]
MOST_XML = 20_000_000  # size of a parsed file [bytes], enough for about 100 000 variables
# XML limits: nesting, elements in total, attributes per element
DEEPEST, MOST_ELEMENTS, MOST_ATTRIBUTES = 60, 500_000, 100
END, END_SIZE, COMMENT = b"PK\x05\x06", 22, 65_535
DIRECTORY = 100  # directory size per file [bytes]; the same again for its name
PACKED_BY = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
Taken = TypeVar("Taken")
DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    ValueError,
    struct.error,
)


class BadArchive(ValueError):
    """Reason for not opening an archive."""


@dataclass(frozen=True)
class Contents:
    """Required and parsed files of a kind of archive; parsed files by name or ending."""

    standard: str
    needed: str
    parsed: tuple[str, ...]

    def parses(self, name: str) -> bool:
        """Return whether a file of the archive is parsed."""
        return name in self.parsed or PurePosixPath(name).suffix.lower() in self.parsed


FMU = Contents("FMI", DESCRIPTION, (DESCRIPTION, "sources/buildDescription.xml"))
SSP = Contents("SSP", STRUCTURE, (STRUCTURE, ".ssd", ".ssv", ".ssm", ".ssb"))
_SOUND: set[bytes] = set()  # digests of accepted XML


def check_archive(path: Path) -> None:
    """Check an FMU archive.

    Raises:
        BadArchive: The archive is invalid, too large or would write outside its folder.
        OSError: The file is unreadable.
    """
    _read(path, lambda archive: None)


def description_of(path: Path) -> bytes:
    """Return the bytes of modelDescription.xml after all checks."""
    return _read(path, lambda archive: archive.read(DESCRIPTION))


def unpack(path: Path, folder: Path, kind: Contents = FMU) -> None:
    """Unpack an archive into a folder.

    A link in the archive becomes a file with its target as content.

    Raises:
        BadArchive: Unpacking fails.
        OSError: The disk lacks space; nothing has been written.
    """

    def all_of(archive: zipfile.ZipFile) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        if _unpacked_size(archive.infolist()) > MOST_OF_FREE * shutil.disk_usage(folder).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        for member in archive.infolist():
            archive.extract(member, folder)

    _read(path, all_of, kind)


def check_identifier(identifier: str | None) -> None:
    """Raise BadArchive for a library name outside its folder."""
    if identifier is None or not re.fullmatch(r"[^/\\\x00-\x1f:]+", identifier) or identifier in {".", ".."}:
        raise BadArchive(f'its modelIdentifier "{str(identifier)[:60]}" is no name of a file')


def _read(path: Path, take: Callable[[zipfile.ZipFile], Taken], kind: Contents = FMU) -> Taken:
    with path.open("rb") as stream:
        _check_directory(stream, path.stat().st_size)
        try:
            archive = zipfile.ZipFile(stream)
        except DAMAGED:
            raise BadArchive("it is not a zip archive") from None
        with archive:
            members = archive.infolist()
            for member in members:
                _check_member(member)
            _check_sizes(members, kind)
            names = {m.filename for m in members}
            if kind.needed not in names:
                raise BadArchive(f"it has no {kind.needed}")
            try:
                for name in filter(kind.parses, names):
                    _check_xml_once(name, archive.read(name), kind.standard)
                return take(archive)
            except BadArchive:
                raise
            except DAMAGED as error:
                if is_full(error):
                    raise
                raise BadArchive(f"its archive is damaged: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """Return the reason of a failure without Python terms."""
    return str(error) if isinstance(error, zipfile.BadZipFile) else "it cannot be unpacked"


def _check_directory(stream: BinaryIO, size: int) -> None:
    """Check the archive's directory. zipfile reads the whole directory, so the number of files is checked first."""
    stream.seek(max(0, size - END_SIZE - COMMENT - END_SIZE))
    tail = stream.read()
    end = tail.rfind(END)
    if end < 0 or len(tail) - end < END_SIZE:
        raise BadArchive("it is not a zip archive")
    count, directory = struct.unpack_from("<HI", tail, end + 10)
    if end >= 20 and tail[end - 20 : end - 16] == b"PK\x06\x07":  # the 64-bit directory takes precedence
        (offset,) = struct.unpack_from("<Q", tail, end - 12)
        if offset > size - 56:
            raise BadArchive("it is not a zip archive")
        stream.seek(offset)
        count, directory = struct.unpack_from("<QQ", stream.read(56), 32)
    if count > MOST_FILES or directory > 2 * DIRECTORY * MOST_FILES:
        raise BadArchive(f"it holds more than {MOST_FILES} files")
    stream.seek(0)


def _check_member(member: zipfile.ZipInfo) -> None:
    """Check the name, type and compression of a file."""
    name = member.filename.replace("\\", "/")
    if name.startswith("/") or re.match("[A-Za-z]:", name) or ".." in name.split("/"):
        raise BadArchive(f'"{member.filename[:60]}" in it would be written outside its folder')
    if "\\" in member.orig_filename:
        raise BadArchive(f'"{member.filename[:60]}" in it has a backslash; folders are parted by /')
    if stat.S_ISLNK(member.external_attr >> 16):
        raise BadArchive(f'"{member.filename[:60]}" in it is a link; pack the file it leads to')
    if member.flag_bits & 1:
        raise BadArchive(f'"{member.filename[:60]}" in it is encrypted')
    if member.compress_type not in PACKED_BY:
        raise BadArchive(f'"{member.filename[:60]}" in it is packed in a way that is not known here')


def _unpacked_size(members: Sequence[zipfile.ZipInfo]) -> int:
    """Return the unpacked size [bytes]. zipfile never unpacks more than the declared size."""
    return sum(member.file_size for member in members)


def _check_sizes(members: Sequence[zipfile.ZipInfo], kind: Contents) -> None:
    """Reject files that are too large or share bytes.

    The compression ratio is no criterion: a table of zeros shrinks a thousandfold.
    """
    unpacked, packed = _unpacked_size(members), sum(m.compress_size for m in members)
    if unpacked > MOST_UNPACKED:
        ratio = unpacked / max(1, packed)
        bomb = f", {ratio:.0f} times its size: a zip bomb?" if ratio > BOMB_RATIO else ""
        most = f"more than the {MOST_UNPACKED / 1e6:.0f} MB that are unpacked"
        raise BadArchive(f"it would unpack to {unpacked / 1e6:.0f} MB, {most}{bomb}")
    in_order = sorted(members, key=lambda m: m.header_offset)
    for member, following in pairwise(in_order):
        if following.header_offset < member.header_offset + LOCAL_HEADER + member.compress_size:
            names = f'"{member.filename[:60]}" and "{following.filename[:60]}"'
            raise BadArchive(f"{names} in it share bytes: a zip bomb?")
    for member in members:
        if kind.parses(member.filename) and member.file_size > MOST_XML:
            most = f"more than the {MOST_XML / 1e6:.0f} MB that are read"
            raise BadArchive(f"its {member.filename} has {member.file_size / 1e6:.0f} MB, {most}")


def _check_xml_once(name: str, text: bytes, standard: str) -> None:
    """Check XML once per process. An archive is read several times, and its XML may have 20 000 variables."""
    content = hashlib.sha256(text).digest()
    if content not in _SOUND:
        check_xml(name, text, standard)
        _SOUND.add(content)


def check_xml(name: str, text: bytes, standard: str) -> None:
    """Raise BadArchive for invalid or deep XML, or a DOCTYPE.

    Entities of a DOCTYPE could grow without bound or name files of this machine.
    """
    depth = count = 0

    def refuse(*_: object) -> None:
        raise BadArchive(f"its {name} has a DOCTYPE, which {standard} knows nothing of; take it out")

    def start(_: str, attributes: list[str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST:
            raise BadArchive(f"its {name} is nested too deep")
        if count > MOST_ELEMENTS or len(attributes) > 2 * MOST_ATTRIBUTES:
            most = f"{MOST_ELEMENTS} elements with {MOST_ATTRIBUTES} attributes each"
            raise BadArchive(f"its {name} has more than the {most} that are read")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.ordered_attributes = True
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise BadArchive(f"its {name} is not XML (line {error.lineno}): {expat.ErrorString(error.code)}") from None
    except (LookupError, ValueError) as error:
        if isinstance(error, BadArchive):
            raise
        raise BadArchive(f"its {name} is in an encoding that is not known here; UTF-8 is") from None
