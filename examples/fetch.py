"""Recordings of others, which are not part of this project: from a folder, or from their public home into it.

Whatever its origin, a file is used only if its SHA-256 is the one that is written beside its address.
"""

from __future__ import annotations

import hashlib
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

TIMEOUT = 60.0  # [s]


@dataclass(frozen=True)
class Recording:
    """A file: its name in a folder, its public home, the SHA-256 of its content.

    copies: further names under which a folder may hold the same numbers in other bytes, and the SHA-256 of these.
    """

    name: str
    url: str
    sha256: str
    copies: Mapping[str, str] = field(default_factory=dict)


class RecordingError(Exception):
    """A recording is out of reach, or not the one that is meant."""


def recorded(recording: Recording, folder: Path) -> Path:
    """Return the recording in `folder`, after a download if missing.

    Raises:
        RecordingError: The download failed, or the file is a different one.
    """
    for name, sha256 in {recording.name: recording.sha256, **recording.copies}.items():
        path = folder / name
        if path.is_file():
            _check(name, sha256, path.read_bytes(), str(path))
            return path
    content = _downloaded(recording, folder)
    _check(recording.name, recording.sha256, content, recording.url)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / recording.name
    path.write_bytes(content)
    return path


def _downloaded(recording: Recording, folder: Path) -> bytes:
    try:
        with urllib.request.urlopen(recording.url, timeout=TIMEOUT) as answer:
            return bytes(answer.read())
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise RecordingError(
            f"{recording.name} is not in {folder} and cannot be downloaded ({reason}).\n"
            f"Without a network: put the file of {recording.url} there, by that name, and run this again."
        ) from None


def _check(name: str, sha256: str, content: bytes, origin: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise RecordingError(
            f"{origin} is not the recording that this example is about: its SHA-256 is {found},\n"
            f"that of {name} is {sha256}."
        )
