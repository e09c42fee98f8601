"""Folder for the results of a function: permanent or temporary."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cosim.base.scratch import temporary_folder
from cosim.storage.files import FilePath, named_path


@contextmanager
def results_in(out: FilePath | None) -> Iterator[Path]:
    """Yield the folder `out`, or a temporary folder."""
    if out is not None:
        yield named_path(out)
        return
    with temporary_folder("run") as scratch:
        yield scratch
