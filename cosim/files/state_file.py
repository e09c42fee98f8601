"""State files, such as checkpoints: JSON with bytes in Base64 and a SHA-256, written completely or not at all.

A state file contains data only; reading one executes nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
from base64 import b64decode, b64encode
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.core.drafts import draft_of

STATE_FILE_MAGIC = b"cosim state 2\n"
BLOB = "blob"  # key of bytes


class BadState(ValueError):
    """A file that is not a state file, has another version, or is damaged."""


def pack(content: Any) -> bytes:
    """Return the bytes of a state file with this content."""
    text = json.dumps(content, default=lambda value: {BLOB: b64encode(value).decode()}).encode()
    return STATE_FILE_MAGIC + hashlib.sha256(text).hexdigest().encode() + b"\n" + text


def unpack(data: bytes) -> Any:
    """Return the values; raise BadState if damaged."""
    if not data.startswith(STATE_FILE_MAGIC):
        raise BadState("it is not a state file of this version")
    digest, _, text = data[len(STATE_FILE_MAGIC) :].partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        raise BadState("its SHA-256 differs from its content: it is incomplete or was changed")
    return json.loads(text, object_hook=lambda item: b64decode(item[BLOB]) if item.keys() == {BLOB} else item)


def write_durable(path: Path, content: bytes) -> None:
    """Replace a file so that a power failure leaves either the old or the new content."""
    with draft_of(path) as draft, draft.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    sync(path.parent)


def sync(path: Path) -> None:
    """Write buffered data of a file or folder to the disk."""
    with suppress(OSError):  # Some systems cannot open folders or sync.
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
