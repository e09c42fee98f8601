"""The one cache: what is made of a source, kept by its content.

It holds compiled libraries, which this user's commands execute. So it is a folder of this user that nobody
else can write, with files of this user in it; otherwise a private temporary folder takes its place.
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
from cosim.base.scratch import process_folder

VARIABLE = "XDG_CACHE_HOME"
OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH
ROOT, UNMAPPED = 0, 65534  # users who own folders above a user's own; the second stands for root in a container


def cached(source: str, suffix: str) -> Path:
    """Return where to keep what is made of a source; a file there that others could have written is removed."""
    path = cache_folder() / f"{_hash(source)[:32]}{suffix}"
    if not discard_untrusted([path]):
        path = _temporary() / path.name
    return path


def cache_folder() -> Path:
    """Return the folder `cosim` of the user's cache, or a temporary one if that cannot be used."""
    return _user_folder() or _temporary()


def cache_environment() -> Mapping[str, str]:
    """Return the variables by which another process uses the same cache as this one."""
    return {} if _user_folder() else {VARIABLE: str(_temporary().parent)}


def discard_untrusted(paths: Iterable[Path]) -> bool:
    """Remove files and folders in the cache that others could have written; False if one of them remains."""
    remaining = False
    for path in paths:
        if not os.path.lexists(path) or _is_trusted(path):
            continue
        with contextlib.suppress(OSError):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
        remaining |= os.path.lexists(path)
    return not remaining


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
    with contextlib.suppress(OSError), draft_of(path) as draft:
        draft.write_text(f"{_hash(text)}\n{text}", encoding="utf-8")
    return made


def fingerprint(packages: Iterable[str]) -> str:
    """Of the code in some packages, and of sympy: what they print is as they are."""
    import sympy

    files = (f for name in packages for f in sorted(Path(str(import_module(name).__file__)).parent.glob("*.py")))
    return f"{sympy.__version__} {hashlib.sha256(b''.join(f.read_bytes() for f in files)).hexdigest()}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# -- which folder ---------------------------------------------------------------------------------


def _user_folder() -> Path | None:
    """Return the folder `cosim` of the user's cache; None if it cannot be used, and one note if others can write it."""
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
    _say_once(f"note: the cache {folder} is not used, a temporary one takes its place: {reason}")
    return None


def _home() -> Path | None:
    """Return the folder for caches of all programs; None for a user without a home folder."""
    named = os.environ.get(VARIABLE, "")
    if named:
        return Path(named).absolute()
    home = os.path.expanduser("~")  # which stays as it is for a user that is in no list
    return Path(home) / ".cache" if os.path.isabs(home) else None


def _make(folder: Path) -> None:
    """Make a folder for this user alone, and those above it."""
    if not folder.is_dir():
        _make(folder.parent)
        folder.mkdir(mode=0o700, exist_ok=True)


def _temporary() -> Path:
    """Return a cache that is removed at the end of this process."""
    folder = process_folder() / "cache" / "cosim"
    _make(folder)
    return folder


@functools.cache
def _say_once(text: str) -> None:
    """Tell the user once in a process."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(f"{text}\n")


# -- trust ----------------------------------------------------------------------------------------


def _distrust(folder: Path) -> str:
    """Say why other users could change the content of a folder, with the cure; "" if they cannot."""
    if not hasattr(os, "geteuid"):
        return ""
    for place in (folder, *folder.parents):
        status = place.stat()
        owners = {os.geteuid()} if place == folder else {os.geteuid(), ROOT, UNMAPPED}
        if status.st_uid not in owners:
            return f"{place} belongs to another user; name another folder in {VARIABLE}"
        sticky = place != folder and status.st_mode & stat.S_ISVTX  # others may add to it, not take from it
        if _others_write(status) and not sticky:
            return f"other users can write in {place}; take that from them by chmod go-w"
    return ""


def _is_trusted(path: Path) -> bool:
    """Whether a file or folder in the cache was written by this user alone."""
    if not hasattr(os, "geteuid"):
        return True
    try:
        status, folder = os.lstat(path), os.lstat(path.parent)
    except OSError:
        return False
    closed = not folder.st_mode & OTHERS_ENTER
    return status.st_uid == os.geteuid() and not stat.S_ISLNK(status.st_mode) and (closed or not _others_write(status))


def _others_write(status: os.stat_result) -> bool:
    """Whether others may write: all users, or a group with other users in it."""
    if status.st_mode & stat.S_IWOTH:
        return True
    return bool(status.st_mode & stat.S_IWGRP) and not _is_own_group(status.st_gid)


def _is_own_group(number: int) -> bool:
    """Whether a group is the private one that many systems give each user."""
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(number)
    except KeyError:
        return False
    return user.pw_gid == number and group.gr_name == user.pw_name and not set(group.gr_mem) - {user.pw_name}
