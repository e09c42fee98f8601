"""Folder for the results of a function: permanent or temporary."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cosim.base.scratch import temporary_folder
from cosim.storage.files import FilePath
from cosim.storage.folders import new_run


@contextmanager
def results_in(out: FilePath | None, verb: str, *, force: bool = False) -> Iterator[Path]:
    """Yield the folder `out`, which must be empty without `force`, or a temporary folder."""
    if out is not None:
        with new_run(out, "", verb, force=force) as folder:
            yield folder
        return
    with temporary_folder("run") as scratch:
        yield scratch
