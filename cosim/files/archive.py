"""Checks of FMU and SSP archives before unpacking or parsing.

Rejected are archives that would fill disk or memory or write outside their folder, and XML with entity definitions.
"""

from __future__ import annotations

import errno
import hashlib
import os
import posixpath
import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

from cosim.core.drafts import is_full
from cosim.core.scratch import process_folder

DESCRIPTION = "modelDescription.xml"
STRUCTURE = "SystemStructure.ssd"
ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)  # of every written file, the earliest of ZIP: equal content gives equal bytes
MAX_MEMBER_CHARACTERS = 60  # characters of a name in a message
MOST_FILES = 20_000
MOST_UNPACKED = 1_000_000_000  # unpacked size of all files [bytes], whatever their compression
MOST_OF_FREE = 0.9  # usable fraction of the free disk space
MOST_XML = 20_000_000  # size of a parsed file [bytes], enough for about 100 000 variables
# XML limits: nesting, elements in total, attributes per element
MAX_XML_DEPTH, MAX_XML_ELEMENTS, MAX_XML_ATTRIBUTES = 60, 500_000, 100
DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError, struct.error)


class BadArchive(ValueError):
    """An archive that is refused, with the reason."""


@dataclass(frozen=True)
class Contents:
    """Contents of a kind of archive: the required files, and which files are parsed, by name or suffix."""

    standard: str
    needed: str
    parsed: tuple[str, ...]

    def parses(self, name: str) -> bool:
        """Return True if a file with this name is parsed."""
        return name in self.parsed or posixpath.splitext(name)[1].lower() in self.parsed


FMU_CONTENTS = Contents("FMI", DESCRIPTION, (DESCRIPTION, "sources/buildDescription.xml"))
SSP_CONTENTS = Contents("SSP", STRUCTURE, (STRUCTURE, ".ssd", ".ssv", ".ssm", ".ssb"))
_SOUND: set[bytes] = set()  # digests of accepted XML, which is read several times


def check_archive(path: Path) -> None:
    """Check an FMU archive.

    Raises:
        BadArchive: The archive is invalid, too large or would write outside its folder.
        OSError: The file is unreadable.
    """
    with _checked(path):
        pass


def description_of(path: Path) -> bytes:
    """Check an FMU archive and return the bytes of its modelDescription.xml."""
    with _checked(path) as archive:
        return archive.read(DESCRIPTION)


def member_of(path: Path, name: str) -> bytes | None:
    """Check an FMU archive and return the bytes of one of its files; None for a missing or too large one."""
    with _checked(path) as archive:
        sizes = {member.filename: member.file_size for member in archive.infolist()}
        return archive.read(name) if sizes.get(name, MOST_XML + 1) <= MOST_XML else None


def unpack(path: Path, folder: Path, kind: Contents = FMU_CONTENTS) -> None:
    """Unpack an archive into a folder.

    A link in the archive becomes a file with its target as content.

    Raises:
        BadArchive: Unpacking fails.
        OSError: The disk has too little space; nothing was written.
    """
    with _checked(path, kind) as archive:
        folder.mkdir(parents=True, exist_ok=True)
        # zipfile never unpacks more than the declared size.
        size = sum(member.file_size for member in archive.infolist())
        if size > MOST_OF_FREE * shutil.disk_usage(folder).free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
        archive.extractall(folder)


def unpack_once(path: Path) -> Path:
    """Return a folder with the files of an FMU, for all its instances in this process."""
    about = path.stat()
    folder = process_folder() / f"fmu-{about.st_dev}-{about.st_ino}-{about.st_mtime_ns}-{about.st_size}"
    if not folder.is_dir():
        with tempfile.TemporaryDirectory(dir=folder.parent) as draft:
            unpack(path, Path(draft, "fmu"))
            Path(draft, "fmu").replace(folder)
    return folder


@contextmanager
def _checked(path: Path, kind: Contents = FMU_CONTENTS) -> Iterator[zipfile.ZipFile]:
    """Yield an archive after its checks."""
    with path.open("rb") as stream:
        try:
            archive = zipfile.ZipFile(stream)
        except DAMAGES:
            raise BadArchive("it is not a zip archive") from None
        with archive:
            members = archive.infolist()
            if len(members) > MOST_FILES:
                raise BadArchive(f"it has more than {MOST_FILES} files")
            for member in members:
                inner = member.filename.replace("\\", "/")
                is_outside = inner.startswith("/") or re.match("[A-Za-z]:", inner) or ".." in inner.split("/")
                if is_outside or "\\" in member.orig_filename:
                    name = member.filename[:MAX_MEMBER_CHARACTERS]
                    raise BadArchive(f'"{name}" in it is outside its folder or has a backslash; separate folders by /')
            # The compression ratio is no criterion: a table of zeros shrinks a thousandfold.
            if (size := sum(member.file_size for member in members)) > MOST_UNPACKED:
                limit = f"more than the {MOST_UNPACKED / 1e6:.0f} MB that are unpacked; it may be a zip bomb"
                raise BadArchive(f"it would unpack to {size / 1e6:.0f} MB, {limit}")
            for member in members:
                if kind.parses(member.filename) and (size := member.file_size) > MOST_XML:
                    limit = f"the limit is {MOST_XML / 1e6:.0f} MB"
                    raise BadArchive(f"its {member.filename} has {size / 1e6:.0f} MB; {limit}")
            names = {m.filename for m in members}
            if kind.needed not in names:
                raise BadArchive(f"it has no {kind.needed}")
            try:
                for name in filter(kind.parses, names):
                    text = archive.read(name)
                    if (digest := hashlib.sha256(text).digest()) not in _SOUND:
                        check_xml(name, text, kind.standard)
                        _SOUND.add(digest)
                yield archive
            except BadArchive:
                raise
            except DAMAGES as error:
                if is_full(error):
                    raise
                reason = " ".join(str(error).split())[:200] or "it cannot be unpacked"
                raise BadArchive(f"its archive is damaged: {reason}; copy or export it again") from None


def check_xml(name: str, text: bytes, standard: str) -> None:
    """Raise BadArchive if XML is invalid, is nested too deeply, or has a DOCTYPE.

    Entities of a DOCTYPE could grow without bound or name files of this machine.
    """
    depth = count = 0

    def refuse(*_: object) -> None:
        raise BadArchive(f"its {name} has a DOCTYPE, which {standard} does not allow; remove it")

    def start(_: str, attributes: list[str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_XML_DEPTH:
            raise BadArchive(f"its {name} is nested more than {MAX_XML_DEPTH} levels deep; use fewer levels")
        if count > MAX_XML_ELEMENTS or len(attributes) > 2 * MAX_XML_ATTRIBUTES:
            raise BadArchive(
                f"its {name} has more than the {MAX_XML_ELEMENTS} elements with {MAX_XML_ATTRIBUTES} attributes each "
                "that are read"
            )

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
        reason = expat.ErrorString(error.code)
        raise BadArchive(f"its {name} is not XML (line {error.lineno}): {reason}") from None
    except BadArchive:
        raise
    except (LookupError, ValueError):
        raise BadArchive(f"its {name} is in an unknown encoding; write it in UTF-8") from None
