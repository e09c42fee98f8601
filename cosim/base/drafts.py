"""Writing files whole or not at all."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # a disk, a quota, a limit of the shell


def is_full(error: object) -> bool:
    """Whether an error says that there is no room left to write."""
    return isinstance(error, OSError) and error.errno in FULL


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Where to write what takes the place of `path` only when the block ends without an error.

    Where the system refuses the exchange, the content stays beside it as `NAME-kept.SUFFIX`, and the OSError says so.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        draft.unlink(missing_ok=True)  # a link that somebody put there would be followed
        os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield draft
        try:
            draft.replace(path)
        except OSError as error:
            kept = path.with_name(f"{path.stem}-kept{path.suffix}")
            try:
                draft.replace(kept)
            except OSError:
                raise error from None
            reason = f"cannot be replaced ({error.strerror}); what was to take its place is {kept}"
            raise OSError(error.errno, reason, str(path)) from None
    finally:
        draft.unlink(missing_ok=True)


def remove_drafts(folder: Path, names: Sequence[str]) -> None:
    """Remove drafts of files that killed processes did not remove; only for who has locked the folder."""
    drafts = re.compile(rf"\.({'|'.join(map(re.escape, names))})\.\d+")
    with suppress(OSError):
        for path in folder.iterdir():
            if drafts.fullmatch(path.name) and path.is_file():
                path.unlink()
