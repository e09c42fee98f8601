"""MAT files of MATLAB and Octave, version 5, and HDF5, which needs h5py (extra `hdf5`).

A MAT file of cosim has the time, a matrix of numbers and the names of its columns. An HDF5 file has one dataset per
signal, with the unit as an attribute. MAT files of other tools may have one numeric variable per signal, as long as
the time.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.extras import optional
from cosim.files.files import open_bytes
from cosim.files.table import Column, Source, Table, as_text, plain_numbers, split_heading, table_by_time

MAT_MAGIC = b"MATLAB 5.0 MAT-file"
MOST_VARIABLE_BYTES = 2**31 - 1  # of a variable


class Mat(Source):
    """MAT-file version 5, read and written by scipy.

    Variables: `time`; `values` with a row per time; `names`, `units` and `whole` (True for integers) of the
        columns;
    `text`, `text_names` and `text_units` for values that are not doubles.
    """

    name = "MAT"
    suffixes = (".mat",)
    magic = MAT_MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns."""
        from scipy.io import loadmat

        try:
            with open_bytes(path) as stream:
                content: Mapping[str, Any] = loadmat(stream)
        except Exception as error:  # scipy reports damage by many kinds of errors
            reason = getattr(error, "strerror", None) or str(error)[:200]
            cure = "write it with -v7, or as HDF5 with one dataset per signal"
            raise InputError.at(path, f"is not a readable MAT file of version 5: {reason}; {cure}") from None
        if "names" in content:
            columns = [Column("time", "s", np.ravel(content["time"]).astype(np.float64))]
            whole = np.ravel(content["whole"])
            for k, head in enumerate(zip(_words(content["names"]), _words(content["units"]), strict=True)):
                numbers: Array = np.ascontiguousarray(content["values"][:, k], dtype=np.float64)
                columns.append(Column(*head, numbers.astype(np.int64) if whole[k] else numbers))
            if "text" in content:
                heads = zip(_words(content["text_names"]), _words(content["text_units"]), strict=True)
                columns += [Column(*head, _words(content["text"][:, k])) for k, head in enumerate(heads)]
            return Table(columns)
        columns = []
        for heading, values in content.items():
            if isinstance(values, np.ndarray) and values.dtype.kind in "biuf" and max(values.shape) == values.size:
                columns.append(Column(*split_heading(heading, names), plain_numbers(np.ravel(values))))
        return table_by_time(columns)

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns, time first.

        Raises:
            InputError: The rows need more than the 2 GB of a variable.
        """
        from scipy.io import savemat

        time, *others = columns
        numbers = [c for c in others if isinstance(c.values, np.ndarray)]
        texts = [c for c in others if not isinstance(c.values, np.ndarray)]
        rows = len(time.values)
        if 8 * rows * max(1, len(numbers)) > MOST_VARIABLE_BYTES:
            size = f"{rows} rows of {len(numbers)} columns"
            raise InputError.at(path, f"{size} exceed the 2 GB of a MAT variable; use another format")
        values = [np.asarray(c.values) for c in numbers]
        content = {
            "time": np.asarray(time.values, dtype=np.float64).reshape(-1, 1),
            "values": np.column_stack(values).astype(np.float64) if values else np.empty((rows, 0)),
            "whole": np.array([[v.dtype.kind == "i" for v in values]], dtype=bool),
            "names": _cells([c.name for c in numbers]),
            "units": _cells([c.unit for c in numbers]),
        }
        if texts:
            cells = _cells([as_text(value) for c in texts for value in c.values]).reshape(len(texts), rows).T
            content |= {"text": cells, "text_names": _cells([c.name for c in texts])}
            content["text_units"] = _cells([c.unit for c in texts])
        with draft_of(path) as draft, draft.open("wb") as stream:
            savemat(stream, content, do_compression=True)


MAT = Mat()


def _cells(texts: Sequence[str]) -> Any:
    """Return texts as a cell array with one row."""
    cells = np.empty((1, len(texts)), dtype=object)
    cells[0, :] = texts
    return cells


def _words(cells: Any) -> list[str]:
    return ["".join(map(str, np.ravel(cell))) for cell in np.ravel(cells)]


HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_DEFLATED, FILLED = 1032, 1 << 26  # size over stored bytes that deflate can reach; [bytes] that may be no values
MIN_COMPRESSED = 1000  # rows; the index of compressed parts is larger than a short dataset


class Hdf5(Source):
    """HDF5, read and written by h5py. The attributes of a dataset are `name` (its full name) and `unit`."""

    name = "HDF5"
    suffixes = (".h5", ".hdf5")
    magic = HDF5_MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read every dataset as long as `time`, in the order of writing."""
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
            raise InputError.at(path, f"is not a readable HDF5 file: {reason}; write it again") from None
        return table_by_time([column for _, column in sorted(found, key=lambda each: each[0])])

    def check_writable(self) -> None:
        """Raise InputError if h5py is not installed."""
        optional("h5py", "--format hdf5")

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write a dataset per column; a dot in a name separates groups.

        The file is built in memory, because the HDF5 library ends the process on a full disk.
        """
        h5py = optional("h5py", "--format hdf5")
        with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
            for number, column in enumerate(columns):
                component, _, variable = column.name.partition(".")
                place = f"{component}/{variable.replace('/', '|') or 'value'}"  # one group per component
                if column.name == "time":
                    place = "time"
                if place in file or place.startswith("time/"):  # a dataset and a group must not both be called `time`
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
