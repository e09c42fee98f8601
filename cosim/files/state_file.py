"""State files: JSON with bytes, checked by a hash, written completely or not at all.

    cosim state 1
    SHA-256 of the rest
    {"text": characters of the JSON, "blobs": [sizes of the bytes values]}
    JSON, in which {"blob": k} refers to the k-th bytes value, then the bytes values

A state file contains data only; reading one executes nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.core.drafts import draft_of

MAGIC = b"cosim state 1\n"
BLOB = "blob"


class BadState(ValueError):
    """A file that is not a state file, has another version, or is damaged."""


def pack(content: Any) -> bytes:
    """Return the content of a state file."""
    blobs: list[bytes] = []

    def reference(value: Any) -> Any:
        if not isinstance(value, (bytes, bytearray)):
            raise TypeError(f"a state file cannot store a {type(value).__name__}")
        blobs.append(bytes(value))
        return {BLOB: len(blobs) - 1}

    text = json.dumps(content, default=reference).encode()
    sizes = json.dumps({"text": len(text), "blobs": [len(blob) for blob in blobs]}).encode()
    body = b"".join([sizes, b"\n", text, *blobs])
    return MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def unpack(data: bytes) -> Any:
    """Return the values; raise BadState if damaged."""
    if not data.startswith(MAGIC):
        raise BadState("it is not a state file of this version")
    digest, _, body = data[len(MAGIC) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise BadState("its SHA-256 differs from its content: it is incomplete or was changed")
    head, _, rest = body.partition(b"\n")
    sizes = json.loads(head)
    first, blobs = sizes["text"], []
    for size in sizes["blobs"]:
        blobs.append(rest[first : first + size])
        first += size

    def resolve(mapping: dict[str, Any]) -> Any:
        return blobs[mapping[BLOB]] if mapping.keys() == {BLOB} else mapping

    return json.loads(rest[: sizes["text"]], object_hook=resolve)


def write_durable(path: Path, content: bytes) -> None:
    """Replace a file, safe against power failures."""
    with draft_of(path) as draft, draft.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    sync(path.parent)


def sync(path: Path) -> None:
    """Write a file or folder to the disk."""
    with suppress(OSError):  # Some systems do not open folders; a disk that cannot sync keeps the file anyway.
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
