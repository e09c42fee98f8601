"""The archive of an FMU or of an SSP, looked at before anything in it is unpacked or parsed.

Refused is what would fill disk or memory, what would be written outside its folder, and XML that defines entities.
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
MOST_UNPACKED = 1_000_000_000  # bytes of all files together, however well they are packed
MOST_OF_FREE = 0.9  # of the room on the disk
BOMB_RATIO = 100.0  # of packing, from which an archive beyond MOST_UNPACKED is taken for a bomb
LOCAL_HEADER = 30  # bytes before each file's own, at least
MOST_XML = 20_000_000  # bytes of a description: some 100 000 variables
DEEPEST, MOST_ELEMENTS, MOST_ATTRIBUTES = 60, 500_000, 100  # elements within elements, in all, attributes of one
END, END_SIZE, COMMENT = b"PK\x05\x06", 22, 65_535
DIRECTORY = 100  # bytes of the directory for a file, and for its name as much again
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
    """Why the archive is not opened."""


@dataclass(frozen=True)
class Contents:
    """What an archive of one kind must hold, and what a host parses of it: by name, or by ending."""

    standard: str
    needed: str
    parsed: tuple[str, ...]

    def parses(self, name: str) -> bool:
        """Whether this file of it is parsed."""
        return name in self.parsed or PurePosixPath(name).suffix.lower() in self.parsed


FMU = Contents("FMI", DESCRIPTION, (DESCRIPTION, "sources/buildDescription.xml"))
SSP = Contents("SSP", STRUCTURE, (STRUCTURE, ".ssd", ".ssv", ".ssm", ".ssb"))
_SOUND: set[bytes] = set()  # digests of the XML that was found sound


def check_archive(path: Path) -> None:
    """BadArchive where the archive is none, would take too much or would leave its folder; OSError if unreadable."""
    _read(path, lambda archive: None)


def description_of(path: Path) -> bytes:
    """The bytes of its modelDescription.xml, without entities and not too deep; BadArchive."""
    return _read(path, lambda archive: archive.read(DESCRIPTION))


def unpack(path: Path, folder: Path, kind: Contents = FMU) -> None:
    """Unpack it into a folder; BadArchive where that fails, OSError before anything is written where there is no room.

    A link in it becomes a file that holds its target.
    """

    def all_of(archive: zipfile.ZipFile) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        if _unpacked_size(archive.infolist()) > MOST_OF_FREE * shutil.disk_usage(folder).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        for member in archive.infolist():
            archive.extract(member, folder)

    _read(path, all_of, kind)


def check_identifier(identifier: str | None) -> None:
    """BadArchive where the name of its library would lead out of its folder."""
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
    """Why something cannot be unpacked, without the names of Python."""
    return str(error) if isinstance(error, zipfile.BadZipFile) else "it cannot be unpacked"


def _check_directory(stream: BinaryIO, size: int) -> None:
    """The directory at its end, which is read as a whole: the number of files is known before."""
    stream.seek(max(0, size - END_SIZE - COMMENT - END_SIZE))
    tail = stream.read()
    end = tail.rfind(END)
    if end < 0 or len(tail) - end < END_SIZE:
        raise BadArchive("it is not a zip archive")
    count, directory = struct.unpack_from("<HI", tail, end + 10)
    if end >= 20 and tail[end - 20 : end - 16] == b"PK\x06\x07":  # of 64 bits, which counts
        (offset,) = struct.unpack_from("<Q", tail, end - 12)
        if offset > size - 56:
            raise BadArchive("it is not a zip archive")
        stream.seek(offset)
        count, directory = struct.unpack_from("<QQ", stream.read(56), 32)
    if count > MOST_FILES or directory > 2 * DIRECTORY * MOST_FILES:
        raise BadArchive(f"it holds more than {MOST_FILES} files")
    stream.seek(0)


def _check_member(member: zipfile.ZipInfo) -> None:
    """A file that would stay in its folder and can be unpacked."""
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
    """Return the bytes that all files take on the disk: zipfile unpacks no more of a file than is declared."""
    return sum(member.file_size for member in members)


def _check_sizes(members: Sequence[zipfile.ZipInfo], kind: Contents) -> None:
    """Refuse files that together take too much room, share bytes in the archive, or are too large to be parsed.

    How well a file is packed is no reason: a table of zeros is packed a thousand times.
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
    """The same, once a process: an archive is read several times, and its XML may have 20 000 variables."""
    content = hashlib.sha256(text).digest()
    if content not in _SOUND:
        check_xml(name, text, standard)
        _SOUND.add(content)


def check_xml(name: str, text: bytes, standard: str) -> None:
    """BadArchive where it is no XML, is too deep, or has a document type.

    In that entities could grow without end, or name files of this machine.
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
