"""Cache of derived files, keyed by the content of their source.

The cache contains compiled libraries and templates, which commands of this user execute. It is therefore a folder of
this user without write access for others, or a private temporary folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import stat
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.core.drafts import draft_of
from cosim.core.scratch import process_folder

VARIABLE = "XDG_CACHE_HOME"


def cache_path(source: str, suffix: str) -> Path:
    """Return the path in the cache of a file that is derived from a source."""
    return cache_folder() / f"{hashlib.sha256(source.encode()).hexdigest()[:32]}{suffix}"


@functools.cache
def _user_folder(variable: str) -> Path | None:
    """Return the user's cache folder, if usable and safe. An unsafe folder is reported once.

    Args:
        variable: Folder of all caches; "" for ~/.cache.
    """
    home = os.path.expanduser("~")  # stays "~" for an unlisted user
    if not variable and not os.path.isabs(home):
        return None
    folder = (Path(variable) if variable else Path(home) / ".cache").absolute() / "cosim"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.resolve().stat()
    except OSError:
        return None
    if hasattr(os, "geteuid") and (status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        with contextlib.suppress(OSError, ValueError):
            reason = f"another user can write to it: run chmod go-w on it, or set {VARIABLE} to another folder"
            sys.stderr.write(f"note: a temporary cache is used instead of {folder}: {reason}\n")
        return None
    return folder if os.access(folder, os.W_OK) else None


def cache_folder() -> Path:
    """Return the user's cache folder, or a temporary folder that is removed at this process's end."""
    if folder := _user_folder(os.environ.get(VARIABLE, "")):
        return folder
    folder = process_folder() / "cache" / "cosim"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder


def cache_environment() -> Mapping[str, str]:
    """Return environment variables that let a child process use the cache of this process."""
    return {} if _user_folder(os.environ.get(VARIABLE, "")) else {VARIABLE: str(cache_folder().parent)}


def load_or_make(source: str, make: Callable[[], Any]) -> Any:
    """Return a JSON value from the cache; if the cache does not have it, call `make` and store the result.

    Args:
        source: Text that identifies the value, such as the code and options it is made from.
        make: Function that computes the value.
    """
    path = cache_path(source, ".json")
    with contextlib.suppress(OSError, ValueError):
        return json.loads(path.read_bytes())
    value = make()
    with contextlib.suppress(OSError), draft_of(path) as draft:  # A read-only cache is no error.
        draft.write_text(json.dumps(value), encoding="utf-8")
    return value


def fingerprint(packages: Iterable[str]) -> str:
    """Return a hash of the code of packages and of sympy, which both determine the printed C code."""
    import sympy

    files = (f for name in packages for f in sorted(Path(str(import_module(name).__file__)).parent.glob("*.py")))
    return f"{sympy.__version__} {hashlib.sha256(b''.join(f.read_bytes() for f in files)).hexdigest()}"
