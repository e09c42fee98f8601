"""The one cache: what is made of a source, kept by its content."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from pathlib import Path


def cached(source: str, suffix: str) -> Path:
    """Where what is made of a source is kept: in the user's cache, or, where none can be written, as long as we run."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cosim"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    name = hashlib.sha256(source.encode()).hexdigest()[:32]
    return (folder if writable else Path(_temporary().name)) / f"{name}{suffix}"


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    """A folder of this process alone."""
    return tempfile.TemporaryDirectory(prefix="cosim-kernels-", ignore_cleanup_errors=True)
