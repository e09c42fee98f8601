"""Whether Python of the user may be executed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

skipped_files: ContextVar[list[Path] | None] = ContextVar("files of Python that are not executed", default=None)


@contextmanager
def without_execution() -> Iterator[list[Path]]:
    """Prevent the execution of model files; yield skipped files.

    A model in such a file raises NotExecuted.
    """
    skipped: list[Path] = []
    token = skipped_files.set(skipped)
    try:
        yield skipped
    finally:
        skipped_files.reset(token)


def is_execution_allowed() -> bool:
    """Return False within `without_execution`."""
    return skipped_files.get() is None
