"""Atomic file writing: a file is written to a temporary draft, which then replaces the file."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no space on the disk or in the quota, or the shell's file size limit


def is_full(error: object) -> bool:
    """Return True if an error means that the disk or quota is full, or a file exceeds the allowed size."""
    return isinstance(error, OSError) and error.errno in FULL


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yield the path of a draft file. After success, the draft replaces `path`; OSError if the replacement fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        draft.unlink(missing_ok=True)  # otherwise writing would follow a link that another user made here
        os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield draft
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
