"""Read the record of credibility in an FMU, without the modules of a record if there is none."""

from __future__ import annotations

import hashlib
import json
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cosim.files.archive import DAMAGES, member_of

if TYPE_CHECKING:
    from cosim.credibility.record import Credibility

SCHEMA = 1
CREDIBILITY_FOLDER = "extra/org.cosim.credibility/"
RECORD, IDENTITY = f"{CREDIBILITY_FOLDER}credibility.json", f"{CREDIBILITY_FOLDER}identity.json"
READ_CHUNK_BYTES = 1 << 20


class Found(NamedTuple):
    """The record of an FMU (None if there is no readable one), and a message on what is wrong with it, or ""."""

    record: Credibility | None
    problem: str = ""


def read_credibility(fmu: Path) -> Found:
    """Return the record of an FMU, or why it cannot be read."""
    about = fmu.stat()
    return _read(fmu, about.st_mtime_ns, about.st_size, about.st_ino)


@lru_cache(maxsize=64)
def _read(fmu: Path, _time: int, _size: int, _file: int) -> Found:
    try:
        text = member_of(fmu, RECORD)
        if text is None:
            return Found(None)
        content: Any = json.loads(text)
        version = content.get("schema_version") if isinstance(content, dict) else None
        if isinstance(version, int) and version > SCHEMA:
            problem = f"its record of credibility has schema {version}, and this version of cosim reads {SCHEMA}"
            return Found(None, f"{problem}; it is ignored")
        from cosim.credibility.record import Credibility

        record = Credibility.model_validate(content)
        is_changed = identity_of(fmu).get("sha256") != content_hash(fmu)
    except DAMAGES as error:
        return Found(None, f"its record of credibility is damaged and ignored: {str(error).splitlines()[0]}")
    if is_changed:
        problem = "it was changed after its record of credibility was written: its SHA-256 differs or is missing"
        return Found(record, problem)
    return Found(record)


def content_hash(fmu: Path) -> str:
    """Return the SHA-256 of names and contents of all files in an FMU, except the file with this SHA-256."""
    sha = hashlib.sha256()
    with zipfile.ZipFile(fmu) as archive:
        for member in sorted(archive.infolist(), key=lambda m: m.filename):
            if member.filename == IDENTITY or member.is_dir():
                continue
            sha.update(f"{member.filename}\0{member.file_size}\0".encode())
            with archive.open(member) as stream:
                while part := stream.read(READ_CHUNK_BYTES):
                    sha.update(part)
    return sha.hexdigest()


def identity_of(fmu: Path) -> dict[str, Any]:
    """Return the content of the identity file of an FMU, empty if there is none."""
    content = json.loads(member_of(fmu, IDENTITY) or "{}")
    return content if isinstance(content, dict) else {}
