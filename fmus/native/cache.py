"""The one cache: what is made of a source, kept by its content."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import Any


def cached(source: str, suffix: str) -> Path:
    """Where what is made of a source is kept: in the user's cache, or, where none can be written, as long as we run."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cosim"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    name = _hash(source)[:32]
    return (folder if writable else Path(_temporary().name)) / f"{name}{suffix}"


def kept(source: str, make: Callable[[], Any]) -> Any:
    """What is made of a source, from the cache or made now: lists, texts and numbers, as JSON.

    The hash of its content stands before it: what is damaged, or half written, is made anew.
    """
    path = cached(source, ".json")
    try:
        head, _, text = path.read_text(encoding="utf-8").partition("\n")
        if head == _hash(text):
            return json.loads(text)
    except (OSError, ValueError):
        pass
    made = make()
    text = json.dumps(made)
    with contextlib.suppress(OSError):
        draft = path.with_name(f"{path.name}.{os.getpid()}")
        draft.write_text(f"{_hash(text)}\n{text}", encoding="utf-8")
        draft.replace(path)
    return made


def fingerprint(packages: Iterable[str]) -> str:
    """Of the code in some packages, and of sympy: what they print is as they are."""
    import sympy

    files = (f for name in packages for f in sorted(Path(str(import_module(name).__file__)).parent.glob("*.py")))
    return f"{sympy.__version__} {hashlib.sha256(b''.join(f.read_bytes() for f in files)).hexdigest()}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    """A folder of this process alone."""
    return tempfile.TemporaryDirectory(prefix="cosim-kernels-", ignore_cleanup_errors=True)
