"""MAT files of MATLAB and Octave, version 5: time, a matrix of numbers, and the names of its columns.

A file of another tool may have a variable of numbers per signal instead, as long as time.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import InputError
from cosim.files.files import open_bytes
from cosim.files.table import Column, Source, Table, as_text, plain_numbers, split_heading, table_by_time

MAGIC = b"MATLAB 5.0 MAT-file"
MOST_BYTES = 2**31 - 1  # of a variable


class Mat(Source):
    """MAT-file version 5, read and written by scipy.

    Variables: `time`, `values` with a row per time, `names`, `units` and `whole` (integers) of its columns; `text`,
    `text_names` and `text_units` for values that are no doubles.
    """

    name = "MAT"
    suffixes = (".mat",)
    magic = MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns."""
        from scipy.io import loadmat

        try:
            with open_bytes(path) as stream:
                content: Mapping[str, Any] = loadmat(stream)
        except Exception as error:  # scipy reports damage by many kinds of errors
            reason = getattr(error, "strerror", None) or str(error)[:200]
            cure = "write it with -v7, or as HDF5 with one dataset a signal"
            raise InputError.at(path, f"is no MAT file of version 5 that can be read: {reason}; {cure}") from None
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
        if 8 * rows * max(1, len(numbers)) > MOST_BYTES:
            size = f"{rows} rows of {len(numbers)} columns"
            raise InputError.at(path, f"{size} are more than the 2 GB of a MAT variable; take another format")
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
    """Return a cell array of one row."""
    cells = np.empty((1, len(texts)), dtype=object)
    cells[0, :] = texts
    return cells


def _words(cells: Any) -> list[str]:
    return ["".join(map(str, np.ravel(cell))) for cell in np.ravel(cells)]
