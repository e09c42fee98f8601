"""Formats of tables besides CSV: Parquet, MAT files of version 5, HDF5, Excel and MDF.

A Parquet file has a column of numbers per signal, with its unit in the column metadata. A MAT file of cosim contains
the time, a matrix of numbers and the names of its columns; a MAT file of another tool may contain one numeric variable
per signal, with as many values as the time. An HDF5 file has one dataset per signal, with the unit as an attribute.
"""

from __future__ import annotations

import gc
import json
import re
import sys
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from traceback import clear_frames
from typing import Any
from zipfile import ZipFile

import numpy as np

from cosim.core.arrays import Array
from cosim.core.drafts import draft_of
from cosim.core.errors import Fault, InputError
from cosim.core.extras import optional
from cosim.core.text import counted, join_names
from cosim.files.csv_source import MAX_TABLE_BYTES, cells_of
from cosim.files.files import open_bytes
from cosim.files.table import Column, Source, Table, as_text, is_time, plain_numbers, split_heading, table_by_time

PARQUET_MAGIC = b"PAR1"  # first and last bytes of every Parquet file
UNIT = b"unit"  # key of a column's metadata
PANDAS = b"pandas"  # key of the metadata that pandas writes, in JSON
UNNAMED = re.compile(r"__index_level_\d+__")  # name that pandas gives to an index without one
MOST_VALUES = 200_000_000  # numbers in a file, 1.6 GB in memory
ROWS_A_GROUP = 65_536


@contextmanager
def _reading(path: Path, form: str, cure: str = "write it again") -> Iterator[None]:
    """Raise InputError for any error of a library, because the libraries report damage by many kinds of errors."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error).strip().partition("\n")[0][:200]
        # asammdf also raises errors when a half-read file object is deleted, which is a variable of its frames
        hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
        clear_frames(error.__traceback__)
        error.__context__ = None
        gc.collect()
        sys.unraisablehook = hook
        raise InputError.at(path, f"is an incomplete or invalid {form}: {reason}; {cure}") from None


def _refuse_large(path: Path, rows: int, columns: int) -> None:
    """Raise InputError for a table that does not fit into the memory."""
    if rows * columns > MOST_VALUES:
        size = f"{rows} rows of {columns} columns; the limit is {MOST_VALUES:.0e} values"
        raise InputError.at(path, f"has {size}; remove columns or rows")


class Parquet(Source):
    """Apache Parquet."""

    name = "Parquet"
    suffixes = (".parquet",)
    magic = PARQUET_MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns. A column whose type is not supported gets a fault."""
        from pyarrow.parquet import ParquetFile

        with _reading(path, "Parquet file"), ParquetFile(path) as file:
            _refuse_large(path, file.metadata.num_rows, file.metadata.num_columns)
            content = file.read(use_threads=False)
            fields = _fields(content.schema)
        found: list[Column] = []
        for k, field in fields:
            unit = (field.metadata or {}).get(UNIT)  # without metadata, the name may be `name [unit]`
            name, unit = split_heading(field.name, names) if unit is None else (field.name, unit.decode())
            found.append(_column(name, unit, content.column(k), is_text=name in text))
        return Table(found)

    def column_names(self, path: Path) -> list[str]:
        """Return the column names; raise InputError if unreadable."""
        from pyarrow.parquet import read_schema

        with _reading(path, "Parquet file"):
            return [split_heading(field.name)[0] for _, field in _fields(read_schema(path))]

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write columns with their units."""
        import pyarrow as pa
        from pyarrow.parquet import write_table

        def array(values: Any) -> Any:
            is_large = isinstance(values, list) and any(isinstance(v, int) and v >= 2**63 for v in values)
            return pa.array(values, pa.uint64() if is_large else None)

        arrays = [array(column.values) for column in columns]
        fields = [
            pa.field(column.name, values.type, metadata={UNIT: column.unit.encode()})
            for column, values in zip(columns, arrays, strict=True)
        ]
        table = pa.Table.from_arrays(arrays, schema=pa.schema(fields))
        with draft_of(path) as draft:
            write_table(table, draft, row_group_size=ROWS_A_GROUP, compression="zstd", use_dictionary=False)


PARQUET = Parquet()


def _fields(schema: Any) -> list[tuple[int, Any]]:
    """Return index and field of each column, the time first.

    The time is the column `time`, or else the index of a pandas table, which pandas writes as its last column. An index
    without a name is left out if it contains row numbers or if a column is called time.
    """
    try:
        of_pandas = [*json.loads(schema.metadata[PANDAS])["index_columns"]]
    except (KeyError, TypeError, ValueError):  # not written by pandas, or damaged
        of_pandas = []
    times = [k for k, field in enumerate(schema) if is_time(split_heading(field.name)[0])]
    times += [k for k, field in enumerate(schema) if field.name in of_pandas or UNNAMED.fullmatch(field.name)]
    fields = {}
    for k, field in enumerate(schema):
        is_unnamed = UNNAMED.fullmatch(field.name)
        if not is_unnamed or (k == times[0] and not re.match("u?int", str(field.type))):
            fields[k] = field.with_name("time") if is_unnamed else field
    return sorted(fields.items(), key=lambda item: item[0] not in times[:1])


def _column(name: str, unit: str, column: Any, *, is_text: bool) -> Column:
    import pyarrow as pa

    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    kind = str(column.type)
    is_whole = re.fullmatch(r"bool|u?int\d+", kind) is not None
    if kind in {"string", "large_string"} or (is_text and is_whole):
        values = ["" if value is None else str(value) for value in column.to_pylist()]
        return Column(name, unit, values, is_text=not is_whole)
    if re.match("(large_|fixed_size_)?binary", kind):
        return Column(name, unit, [(value or b"").hex() for value in column.to_pylist()], is_text=True)
    if kind.startswith("timestamp"):
        column = column.cast(pa.timestamp("us", column.type.tz), safe=False)
        return Column(name, unit, ["" if value is None else value.isoformat() for value in column.to_pylist()])
    if is_whole and not column.null_count:
        return Column(name, unit, plain_numbers(column.to_numpy()))
    if not is_whole and kind not in {"double", "float", "halffloat", "null"}:
        return Column(name, unit, fault=f"has the type {kind[:60]}; write one number per cell, times in seconds")
    numbers = column.cast("float64", safe=False).to_numpy()  # with NaN for missing ones
    return Column(name, unit, np.asarray(numbers, dtype=np.float64))


MAT_MAGIC = b"MATLAB 5.0 MAT-file"
MOST_VARIABLE_BYTES = 2**31 - 1  # size of one variable


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

        cure = "write it with -v7, or as HDF5 with one dataset per signal"
        with _reading(path, "MAT file of version 5", cure), open_bytes(path) as stream:
            content: Mapping[str, Any] = loadmat(stream)
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
    """Return texts as a MATLAB cell array with one row."""
    cells = np.empty((1, len(texts)), dtype=object)
    cells[0, :] = texts
    return cells


def _words(cells: Any) -> list[str]:
    return ["".join(map(str, np.ravel(cell))) for cell in np.ravel(cells)]


HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
MOST_DEFLATED, FILLED = 1032, 1 << 26  # size per stored byte by deflate; [bytes] that may be fill values
MIN_COMPRESSED = 1000  # rows; the index of compressed parts is larger than a short dataset


class Hdf5(Source):
    """HDF5, read and written by h5py. A dataset has the attributes `name` (full name) and `unit`."""

    name = "HDF5"
    suffixes = (".h5", ".hdf5")
    magic = HDF5_MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read every dataset with as many values as `time`, in the order in which they were written."""
        h5py = optional("h5py", lambda message: Fault(path, 0, 0, message))
        found: list[tuple[int, Column]] = []

        def add(place: str, item: Any) -> None:
            if not isinstance(item, h5py.Dataset) or item.ndim != 1 or item.external or item.is_virtual:
                return  # values stored in other files, which may be pipes, are not read
            if item.nbytes > MOST_DEFLATED * item.id.get_storage_size() + FILLED:
                raise ValueError(f"{place} has fewer values than it declares")
            name, unit = item.attrs.get("name"), item.attrs.get("unit")
            if name is None:
                name, unit = split_heading(place.replace("/", "."), names)
            values = item.asstr()[:] if item.dtype.kind in "OS" else item[:]
            is_number = item.dtype.kind in "biuf"
            column = Column(str(name), str(unit or ""), plain_numbers(values) if is_number else [*map(str, values)])
            found.append((int(item.attrs.get("column", len(found))), column))

        with _reading(path, "HDF5 file"), h5py.File(path, "r") as file:
            file.visititems(add)
        return table_by_time([column for _, column in sorted(found, key=lambda each: each[0])])

    def check_writable(self) -> None:
        """Raise InputError if h5py is not installed."""
        optional("h5py", "--format hdf5")

    def write(self, path: Path, columns: Sequence[Column]) -> None:
        """Write a dataset per column; `component.variable` becomes the dataset `variable` in the group `component`.

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


class Excel(Source):
    """Excel workbooks with one table, read by openpyxl."""

    name = "Excel"
    suffixes = (".xlsx", ".xlsm")

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns of the table. For a formula, the value stored by Excel is read."""
        openpyxl = optional("openpyxl", lambda message: Fault(path, 0, 0, message))
        with _reading(path, "workbook", "save it again"):
            with ZipFile(path) as parts:
                size = sum(part.file_size for part in parts.infolist())
            if size > MAX_TABLE_BYTES:
                limit = f"the limit is {MAX_TABLE_BYTES / 1e6:.0f} MB; write Parquet"
                raise InputError.at(path, f"unpacks to {size / 1e6:.0f} MB; {limit}")
            book = openpyxl.load_workbook(path, read_only=True, data_only=True)
            sheets = {sheet.title: [*sheet.iter_rows(values_only=True)] for sheet in book.worksheets}
            book.close()
        tables = []
        for sheet, rows in sheets.items():
            if filled := [(line, row) for line, row in enumerate(rows, 1) if any(cell is not None for cell in row)]:
                tables.append((sheet, filled))
        if len(tables) > 1:
            raise InputError.at(path, f"has tables in the sheets {join_names([s for s, _ in tables])}; keep one")
        if not tables:
            return Table()
        lines, cells = zip(*tables[0][1], strict=True)
        headings = [str("" if cell is None else cell) for cell in cells[0]]
        while not headings[-1]:
            headings.pop()
        columns = []
        for k, heading in enumerate(headings):
            name, unit = split_heading(heading, names)
            values = [row[k] if k < len(row) else None for row in cells[1:]]
            texts = ["" if v is None else v.isoformat() if isinstance(v, date) else str(v) for v in values]
            columns.append(cells_of(name, unit, texts, is_text=name in text))
        return Table(columns, lines[1:], lines[0])


EXCEL = Excel()


class Mdf(Source):
    """Measurement files of ASAM MDF, version 4, and of version 3 if asammdf can read them."""

    name = "MDF"
    suffixes = (".mf4", ".mdf")
    magic = b"MDF     "

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all channels into one table, with a row for each time of any channel; missing values are NaN."""
        asammdf = optional("asammdf", lambda message: Fault(path, 0, 0, message))
        with _reading(path, "MDF file", "save it again"), asammdf.MDF(path) as file:
            signals = list(file.iter_channels(copy_master=True))
        rasters = {signal.timestamps.tobytes(): signal.timestamps for signal in signals if signal.timestamps.size}
        if not rasters:
            return Table()
        time = np.unique(np.concatenate([*rasters.values()]))
        _refuse_large(path, time.size, len(signals))
        places = {key: np.searchsorted(time, raster) for key, raster in rasters.items()}
        columns = [Column("time", "s", time)]
        for signal in signals:
            if not signal.timestamps.size or signal.samples.ndim != 1 or signal.samples.dtype.names:
                continue  # no values, an array or a structure
            rows, samples = places[signal.timestamps.tobytes()], signal.samples
            if samples.dtype.kind in "biuf":
                if rows.size == time.size and samples.dtype.kind in "biu":
                    values = samples.astype(np.int64) if samples.dtype.kind != "u" else samples
                else:
                    values = np.full(time.size, np.nan)
                    values[rows] = samples
                columns.append(Column(signal.name, signal.unit or "", values))
            else:
                cells = [""] * time.size
                for row, sample in zip(rows.tolist(), samples.tolist(), strict=True):
                    cells[row] = sample.decode("utf-8", "replace") if isinstance(sample, bytes) else str(sample)
                columns.append(Column(signal.name, signal.unit or "", cells, is_text=True))
        assumed = [f"{counted(len(rasters), 'time channel')} are joined"] if len(rasters) > 1 else []
        omitted = [s.name for s in signals if s.samples.ndim != 1 or s.samples.dtype.names]
        assumed += [f"arrays and structures were not read: {join_names(omitted)}"] if omitted else []
        return Table(columns, assumed=tuple(assumed), own_times=len(rasters) > 1)


MDF = Mdf()
