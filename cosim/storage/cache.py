"""The cache of derived files, addressed by the content of their source.

The cache holds compiled libraries, which this user's commands execute. It is therefore a folder of this user without
write access for others, or else a private temporary folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import shutil
import stat
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from cosim.base.drafts import draft_of
from cosim.base.messages import Note
from cosim.base.scratch import process_folder

VARIABLE = "XDG_CACHE_HOME"
OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH
ROOT, UNMAPPED = 0, 65534  # allowed owners of parent folders; the second stands for root in a container


def cache_path(source: str, suffix: str) -> Path:
    """Return the cache path for a source's derived file. An existing file writable by others is removed."""
    path = cache_folder() / f"{_hash(source)[:32]}{suffix}"
    if not discard_untrusted([path]):
        path = _temporary() / path.name
    return path


def cache_folder() -> Path:
    """Return the user's cache folder, or a temporary folder."""
    return _user_folder() or _temporary()


def cache_environment() -> Mapping[str, str]:
    """Return environment variables for sharing this process's cache."""
    return {} if _user_folder() else {VARIABLE: str(_temporary().parent)}


def discard_untrusted(paths: Iterable[Path]) -> bool:
    """Remove cached files and folders writable by others.

    Returns:
        Whether all of them are gone.
    """
    untrusted = [path for path in paths if os.path.lexists(path) and not _is_trusted(path)]
    for path in untrusted:
        with contextlib.suppress(OSError):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    return not any(map(os.path.lexists, untrusted))


def load_or_make(source: str, make: Callable[[], Any]) -> Any:
    """Return a JSON value made from a source, cached.

    The cache file begins with a hash of its content, so that a damaged or partial file is made anew.
    """
    path = cache_path(source, ".json")
    try:
        head, _, text = path.read_text(encoding="utf-8").partition("\n")
        if head == _hash(text):
            return json.loads(text)
    except (OSError, ValueError):
        pass
    value = make()
    text = json.dumps(value)
    with contextlib.suppress(OSError), draft_of(path) as draft:  # A read-only cache costs time only.
        draft.write_text(f"{_hash(text)}\n{text}", encoding="utf-8")
    return value


def fingerprint(packages: Iterable[str]) -> str:
    """Return a hash of the code of packages and of sympy. Printed code depends on both."""
    import sympy

    files = (f for name in packages for f in sorted(Path(str(import_module(name).__file__)).parent.glob("*.py")))
    return f"{sympy.__version__} {hashlib.sha256(b''.join(f.read_bytes() for f in files)).hexdigest()}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# -- choice of folder -------------------------------------------------------------------------------


def _user_folder() -> Path | None:
    """Return the user's cache folder, if usable and safe. An unsafe folder is reported once."""
    home = _home()
    if home is None:
        return None
    folder = home / "cosim"
    try:
        _make(folder)
        reason = _distrust(folder.resolve())
        if not reason:
            return folder if os.access(folder, os.W_OK) else None
    except OSError:
        return None
    _say_once(Note(f"the cache {folder} is not used, a temporary one takes its place: {reason}"))
    return None


def _home() -> Path | None:
    """Return the folder for all caches; None without a home folder."""
    if folder := os.environ.get(VARIABLE, ""):
        return Path(folder).absolute()
    home = os.path.expanduser("~")  # stays "~" for an unlisted user
    return Path(home) / ".cache" if os.path.isabs(home) else None


def _make(folder: Path) -> None:
    """Create a folder and its missing parents, accessible to this user only."""
    if not folder.is_dir():
        _make(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)


def _temporary() -> Path:
    """Return a cache removed at this process's end."""
    folder = process_folder() / "cache" / "cosim"
    _make(folder)
    return folder


@functools.cache
def _say_once(note: str) -> None:
    """Write a note to stderr, once per process."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"note: {note}\n")


# -- trust ----------------------------------------------------------------------------------------


def _distrust(folder: Path) -> str:
    """Return the reason why a folder is not trusted, with remedy; "" if only this user can change its content."""
    if not hasattr(os, "geteuid"):
        return ""
    for place in (folder, *folder.parents):
        status = place.stat()
        owners = {os.geteuid()} if place == folder else {os.geteuid(), ROOT, UNMAPPED}
        if status.st_uid not in owners:
            return f"{place} belongs to another user; name another folder in {VARIABLE}"
        sticky = place != folder and status.st_mode & stat.S_ISVTX  # Others may add entries, but not replace any.
        if _others_write(status) and not sticky:
            return f"other users can write in {place}; take that from them by chmod go-w"
    return ""


def _is_trusted(path: Path) -> bool:
    """Return whether only this user can write a path."""
    if not hasattr(os, "geteuid"):
        return True
    try:
        status, folder = os.lstat(path), os.lstat(path.parent)
    except OSError:
        return False
    closed = not folder.st_mode & OTHERS_ENTER
    return status.st_uid == os.geteuid() and not stat.S_ISLNK(status.st_mode) and (closed or not _others_write(status))


def _others_write(status: os.stat_result) -> bool:
    """Return whether others may write, directly or by group."""
    if status.st_mode & stat.S_IWOTH:
        return True
    return bool(status.st_mode & stat.S_IWGRP) and not _is_own_group(status.st_gid)


def _is_own_group(number: int) -> bool:
    """Return whether a group is the user's private group."""
    if sys.platform == "win32":
        return False
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(number)
    except KeyError:
        return False
    return user.pw_gid == number and group.gr_name == user.pw_name and not set(group.gr_mem) - {user.pw_name}
