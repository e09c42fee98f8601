"""A folder for results: the one that is asked for, or one that is gone at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cosim.base.scratch import temporary_folder
from cosim.storage.files import FilePath, named_path


@contextmanager
def results_in(out: FilePath | None) -> Iterator[Path]:
    """The folder that was asked for, or one that is gone at the end."""
    if out is not None:
        yield named_path(out)
        return
    with temporary_folder("run") as scratch:
        yield scratch
