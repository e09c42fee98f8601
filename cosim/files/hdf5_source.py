"""HDF5: a dataset per signal, with its unit as an attribute. Needs h5py (extra `hdf5`)."""

from __future__ import annotations

from collections.abc import Collection, Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.extras import optional
from cosim.files.table import Column, Source, Table, as_text, plain_numbers, split_heading, table_by_time

MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_DEFLATED, FILLED = 1032, 1 << 26  # size over stored bytes that deflate can reach; [bytes] that may be no values
MIN_COMPRESSED = 1000  # rows; the index of compressed parts is larger than a short dataset


class Hdf5(Source):
    """HDF5, read and written by h5py. A dataset's attribute `name` is its full name, `unit` its unit."""

    name = "HDF5"
    suffixes = (".h5", ".hdf5")
    magic = MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read every dataset as long as `time`, in the order in which they were written."""
        h5py = optional("h5py", lambda message: Fault(path, 0, 0, message))
        found: list[tuple[int, Column]] = []

        def add(place: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or item.ndim != 1 or item.external or item.is_virtual:
                return  # values in other files, which may be pipes, are not read
            if item.nbytes > MOST_DEFLATED * item.id.get_storage_size() + FILLED:
                raise ValueError(f"{place} has fewer values than it declares")
            name, unit = item.attrs.get("name"), item.attrs.get("unit")
            if name is None:
                name, unit = split_heading(place.replace("/", "."), names)
            values = item.asstr()[:] if item.dtype.kind in "OS" else item[:]
            is_number = item.dtype.kind in "biuf"
            column = Column(str(name), str(unit or ""), plain_numbers(values) if is_number else [*map(str, values)])
            found.append((int(item.attrs.get("column", len(found))), column))

        try:
            with h5py.File(path, "r") as file:
                file.visititems(add)
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            reason = str(error).strip().partition("\n")[0][:200]
            raise InputError.at(path, f"is no HDF5 file that can be read: {reason}; write it again") from None
        return table_by_time([column for _, column in sorted(found, key=lambda each: each[0])])

    def check_writable(self) -> None:
        """Raise InputError if h5py is not installed."""
        optional("h5py", "--format hdf5")

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write a dataset per column; dots of a name separate groups.

        The file is made in memory, because the HDF5 library ends the process if a disk is full.
        """
        h5py = optional("h5py", "--format hdf5")
        with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
            for number, column in enumerate(columns):
                component, _, variable = column.name.partition(".")
                place = f"{component}/{variable.replace('/', '|') or 'value'}"  # a group for a component
                if column.name == "time":
                    place = "time"
                if place in file or place.startswith("time/"):  # beside the dataset of the time no group has its name
                    place = f"signal {number}"
                values: Any = column.values
                if not isinstance(values, np.ndarray):
                    values = np.array([as_text(v) for v in values], dtype=h5py.string_dtype())
                compression = "gzip" if len(values) >= MIN_COMPRESSED else None
                data = file.create_dataset(place, data=values, compression=compression)
                data.attrs.update({"name": column.name, "unit": column.unit, "column": number})
            file.flush()
            content = file.id.get_file_image()
        with draft_of(path) as draft:
            draft.write_bytes(content)


HDF5 = Hdf5()
