"""MAT files of MATLAB and Octave, version 5: time, a matrix of numbers, and the names of its columns.

A file of another tool may have a variable of numbers per signal instead, as long as time.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import InputError
from cosim.storage.files import open_bytes
from cosim.storage.table import HEAD, Column, Source, Table, as_text, split_heading, time_among, whole_numbers

MAGIC = b"MATLAB 5.0 MAT-file"
OF_OCTAVE = b"# Created by Octave", b"Octave-1-"
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
        content = _content(path)
        columns = [*_own_columns(content)] if "names" in content else [*_variables(content, names)]
        return Table(columns)

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


def _content(path: Path) -> Mapping[str, Any]:
    from scipy.io import loadmat

    try:
        with open_bytes(path) as stream:
            head = stream.read(HEAD)
        content: Mapping[str, Any] = {} if head.startswith(OF_OCTAVE) else loadmat(path)
    except NotImplementedError:  # version 7.3
        cure = "write it with -v7, or as HDF5 with one dataset a signal"
        raise InputError.at(path, f"is a MAT file of version 7.3; {cure}") from None
    except Exception as error:  # scipy reports damage by many kinds of errors
        reason = getattr(error, "strerror", None) or str(error)[:200]
        raise InputError.at(path, f"is no MAT file that can be read: {reason}; write it again") from None
    if head.startswith(OF_OCTAVE):
        cure = "write it as save('-v7', 'NAME.mat', 'time', …)"
        raise InputError.at(path, f"is a file in a format of Octave's own; {cure}")
    return content


def _own_columns(content: Mapping[str, Any]) -> Iterator[Column]:
    """Yield the columns of a file written by `Mat.write`."""
    yield Column("time", "s", np.ravel(content["time"]).astype(np.float64))
    whole = np.ravel(content["whole"])
    for k, (name, unit) in enumerate(zip(_words(content["names"]), _words(content["units"]), strict=True)):
        values: Array = np.ascontiguousarray(content["values"][:, k], dtype=np.float64)
        yield Column(name, unit, values.astype(np.int64) if whole[k] else values)
    if "text" in content:
        heads = zip(_words(content["text_names"]), _words(content["text_units"]), strict=True)
        for k, (name, unit) in enumerate(heads):
            yield Column(name, unit, _words(content["text"][:, k]))


def _variables(content: Mapping[str, Any], names: Container[str]) -> Iterator[Column]:
    """Yield the variables as long as `time`, which comes first."""
    vectors = {name: np.ravel(v) for name, v in content.items() if isinstance(v, np.ndarray) and max(v.shape) == v.size}
    headings = {split_heading(heading)[0]: heading for heading in vectors}
    if (found := time_among(headings)) is None:
        return
    time = vectors[headings[found]]
    yield Column("time", split_heading(headings[found])[1] or "s", time.astype(np.float64))
    for heading, values in vectors.items():
        if values is not time and values.size == time.size and values.dtype.kind in "biuf":
            name, unit = split_heading(heading, names)
            is_whole = values.dtype.kind in "biu"
            yield Column(name, unit, whole_numbers(values) if is_whole else values.astype(np.float64))


def _cells(texts: Sequence[str]) -> Any:
    """Return a cell array of one row."""
    cells = np.empty((1, len(texts)), dtype=object)
    cells[0, :] = texts
    return cells


def _words(cells: Any) -> list[str]:
    return ["".join(map(str, np.ravel(cell))) for cell in np.ravel(cells)]
