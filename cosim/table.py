"""A table of numbers as CSV: a header of names and units, one row a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cosim.arrays import Array
from cosim.files import atomic_write


def write_columns(path: Path, time: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write `time` and columns as `name [unit]`, nine digits each, whole or not at all."""
    with atomic_write(path) as stream:
        stream.write(",".join(["time", *(f"{name} [{units[name]}]" for name in columns)]) + "\n")
        for row in zip(time.tolist(), *(c.tolist() for c in columns.values()), strict=True):
            stream.write(",".join(f"{v:.9g}" for v in row) + "\n")
