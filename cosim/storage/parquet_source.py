"""Parquet: a column of numbers per signal, with its unit in the column metadata. Needs pyarrow (extra `parquet`)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.base.arrays import Array
from cosim.base.drafts import draft_of
from cosim.base.errors import Fault, InputError
from cosim.base.extras import optional
from cosim.storage.table_columns import is_time, split_heading
from cosim.storage.table_source import Frame, Source, SourceColumn, whole_numbers

MAGIC = b"PAR1"  # first and last bytes of every Parquet file
UNIT = b"unit"  # key of a column's metadata
PANDAS = b"pandas"  # key of the metadata that pandas writes, in JSON
UNNAMED = re.compile(r"__index_level_\d+__")  # name that pandas gives to an index without one
NO_NAME = (
    "is the index of a pandas table and has no name: its whole numbers may count rows or seconds; "
    "name it by `rename_axis('time')`, or write a column time"
)
MOST_VALUES = 200_000_000  # numbers in a file, 1.6 GB in memory
ROWS_A_GROUP = 65_536


class Parquet(Source):
    """Apache Parquet, read and written by pyarrow."""

    name = "Parquet"
    suffixes = (".parquet",)
    magic = MAGIC
    writes = True

    def frame(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Frame:
        """Read all columns; a column of an unsupported type gets a fault."""
        parquet = optional("pyarrow.parquet", lambda message: Fault(path, 0, 0, message))
        content = _content(parquet, path)
        columns, order = list[SourceColumn](), _order(content.schema)
        for field, column in ((content.schema.field(k), content.column(k)) for k in order):
            metadata = (field.metadata or {}).get(UNIT)
            # Without a unit in the metadata, the name may be `name [unit]`.
            name, unit = split_heading(field.name, names) if metadata is None else (field.name, metadata.decode())
            read = _column(name, unit, column, is_text=name in text)
            columns.append(_unnamed_time(read) if _is_unnamed(field.name) and not columns else read)
        return Frame(columns, range(1, content.num_rows + 1))

    def column_names(self, path: Path) -> list[str]:
        """Return the column names, none if unreadable."""
        try:
            parquet = optional("pyarrow.parquet", lambda message: Fault(path, 0, 0, message))
            schema = parquet.read_schema(path)
            names = (schema.field(k).name for k in _order(schema))
            return ["time" if _is_unnamed(name) and not k else split_heading(name)[0] for k, name in enumerate(names)]
        except (InputError, OSError, ValueError):
            return []

    def check_writable(self) -> None:
        """Raise InputError if pyarrow, which writes the format, is not installed."""
        optional("pyarrow", "--format parquet")

    def write(self, path: Path, columns: Sequence[SourceColumn]) -> None:
        """Write columns with their units."""
        pa = optional("pyarrow", "--format parquet")
        parquet = optional("pyarrow.parquet", "--format parquet")
        arrays = [_array(pa, column.values) for column in columns]
        fields = [
            pa.field(column.name, values.type, metadata={UNIT: column.unit.encode()})
            for column, values in zip(columns, arrays, strict=True)
        ]
        table = pa.Table.from_arrays(arrays, schema=pa.schema(fields))
        with draft_of(path) as draft:
            parquet.write_table(table, draft, row_group_size=ROWS_A_GROUP, compression="zstd", use_dictionary=False)


PARQUET = Parquet()


def _content(parquet: Any, path: Path) -> Any:
    """Return a file as a pyarrow table; raise InputError if incomplete, damaged or too large."""
    try:
        with path.open("rb") as stream:
            stream.seek(-len(MAGIC), 2)
            is_whole = stream.read() == MAGIC
    except OSError:
        is_whole = False
    if not is_whole:
        raise InputError.at(
            path, "is no whole Parquet file: its end is missing, as after a writer that was stopped; write it again"
        )
    try:
        with parquet.ParquetFile(path) as file:
            rows, columns = file.metadata.num_rows, file.metadata.num_columns
            if rows * columns > MOST_VALUES:
                raise InputError.at(
                    path,
                    (
                        f"has {rows} rows of {columns} columns, more than the {MOST_VALUES:.0e} values that are "
                        "read; leave out columns or rows"
                    ),
                )
            return file.read(use_threads=False)
    except (OSError, ValueError, NotImplementedError) as error:  # pyarrow's errors derive from these
        reason = str(error).strip().partition("\n")[0][:200]
        raise InputError.at(path, f"is no Parquet file that can be read: {reason}; write it again") from None


def _order(schema: Any) -> list[int]:
    """Return the places of the columns, that of the time first.

    pandas writes the index of a table as its last column. The time is the column `time` or else the index. An index
    without a name beside a column `time` numbers the rows; it is left out.
    """
    places = {field.name: k for k, field in reversed([*enumerate(schema)])}
    of_pandas = _pandas_index(schema)
    index = [name for name in places if name in of_pandas or _is_unnamed(name)]
    times = [name for name in places if is_time(split_heading(name)[0])][-1:] or index
    first = sorted(places[name] for name in times)
    left_out = {places[name] for name in index if _is_unnamed(name) and len(times) == 1}
    return [*first, *(k for k in range(len(schema)) if k not in {*first, *left_out})]


def _pandas_index(schema: Any) -> list[str]:
    """Return the names of the columns that are the index of a table of pandas."""
    try:
        index = json.loads((schema.metadata or {})[PANDAS])["index_columns"]
        return [name for name in index if isinstance(name, str)]
    except (KeyError, TypeError, ValueError):
        return []


def _is_unnamed(name: str) -> bool:
    """Return whether a name is that of an index of pandas without a name."""
    return UNNAMED.fullmatch(name) is not None


def _unnamed_time(column: SourceColumn) -> SourceColumn:
    """Return an index without a name as the time; whole numbers may number the rows, and are a fault."""
    is_whole = column.numeric and np.asarray(column.values).dtype.kind == "i"
    return replace(column, name="time", unit="s", fault=NO_NAME if is_whole else column.fault)


def _column(name: str, unit: str, column: Any, *, is_text: bool) -> SourceColumn:
    types = optional("pyarrow.types", "Parquet")
    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    for tests, values in READERS:
        if any(getattr(types, f"is_{test}")(column.type) for test in tests.split()):
            read = _texts(column) if is_text and values is _integers else values(column)
            return SourceColumn(name, unit, read, is_text=values not in {_doubles, _integers})
    return SourceColumn(name, unit, fault=_no_numbers(types, column.type))


def _texts(column: Any) -> list[str]:
    return ["" if value is None else str(value) for value in column.to_pylist()]


def _integers(column: Any) -> Array | NDArray[np.int64]:
    """Return whole numbers; doubles if values are missing."""
    return _doubles(column) if column.null_count else whole_numbers(column.to_numpy())


def _doubles(column: Any) -> Array:
    """Return numbers, with NaN for missing ones."""
    values = column.cast("float64", safe=False).to_numpy()
    return np.asarray(values, dtype=np.float64)


READERS: tuple[tuple[str, Callable[[Any], Any]], ...] = (  # column types and their conversions
    ("floating null", _doubles),
    ("boolean integer", _integers),
    ("string large_string", _texts),
    ("binary large_binary fixed_size_binary", lambda column: [(v or b"").hex() for v in column.to_pylist()]),
)


def _no_numbers(types: Any, kind: Any) -> str:
    """Return why a column type cannot be read as numbers, and a remedy."""
    if types.is_temporal(kind):
        return f"holds moments or durations ({kind}); write seconds as numbers"
    if types.is_decimal(kind):
        return f"holds decimals ({kind}); write them as double"
    if types.is_nested(kind):
        return f"is nested ({str(kind)[:60]}); write one column a number"
    return f"holds {kind}; write numbers"


def _array(pa: Any, values: Any) -> Any:
    """Return a pyarrow array; integers beyond 63 bits are unsigned."""
    if isinstance(values, np.ndarray):
        return pa.array(values)
    large = any(isinstance(value, int) and value >= 2**63 for value in values)
    return pa.array(values, pa.uint64()) if large else pa.array(values)
