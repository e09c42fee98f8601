"""Parquet: a column of numbers per signal, with its unit in the column metadata, read and written by pyarrow."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.drafts import draft_of
from cosim.core.errors import InputError
from cosim.files.table import Column, Source, Table, is_time, plain_numbers, split_heading

MAGIC = b"PAR1"  # first and last bytes of every Parquet file
UNIT = b"unit"  # key of a column's metadata
PANDAS = b"pandas"  # key of the metadata that pandas writes, in JSON
UNNAMED = re.compile(r"__index_level_\d+__")  # name that pandas gives to an index without one
NO_NAME = (
    "is an index of pandas without a name: its whole numbers may count rows or seconds; "
    "name it by `rename_axis('time')`, or write a column time"
)
MOST_VALUES = 200_000_000  # numbers in a file, 1.6 GB in memory
ROWS_A_GROUP = 65_536


class Parquet(Source):
    """Apache Parquet."""

    name = "Parquet"
    suffixes = (".parquet",)
    magic = MAGIC
    writes = True

    def read(self, path: Path, names: Container[str] = (), text: Collection[str] = ()) -> Table:
        """Read all columns; a column of an unsupported type gets a fault."""
        from pyarrow.parquet import ParquetFile

        try:
            with ParquetFile(path) as file:
                rows, columns = file.metadata.num_rows, file.metadata.num_columns
                if rows * columns > MOST_VALUES:
                    size = f"{rows} rows of {columns} columns; the limit is {MOST_VALUES:.0e} values"
                    raise InputError.at(path, f"has {size}; remove columns or rows")
                content = file.read(use_threads=False)
        except (OSError, ValueError, NotImplementedError) as error:  # pyarrow's errors derive from these
            reason = str(error).strip().partition("\n")[0][:200]
            raise InputError.at(path, f"is an incomplete or invalid Parquet file: {reason}; write it again") from None
        found: list[Column] = []
        for k in _order(content.schema):
            name, unit = heading_of(content.schema.field(k), names)
            found.append(_column(name, unit, content.column(k), is_text=name in text))
        if found and UNNAMED.fullmatch(found[0].name):  # Whole numbers may be row numbers.
            is_whole = found[0].numeric and np.asarray(found[0].values).dtype.kind == "i"
            found[0] = replace(found[0], name="time", unit="s", fault=NO_NAME if is_whole else found[0].fault)
        return Table(found)

    def column_names(self, path: Path) -> list[str]:
        """Return the column names; raise OSError or ValueError if unreadable."""
        from pyarrow.parquet import read_schema

        schema = read_schema(path)
        names = [split_heading(schema.field(k).name)[0] for k in _order(schema)]
        return ["time" if not k and UNNAMED.fullmatch(name) else name for k, name in enumerate(names)]

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


def heading_of(field: Any, names: Container[str] = ()) -> tuple[str, str]:
    """Return name and unit of a field; without a unit in the metadata, the name may be `name [unit]`."""
    unit = (field.metadata or {}).get(UNIT)
    return split_heading(field.name, names) if unit is None else (field.name, unit.decode())


def _order(schema: Any) -> list[int]:
    """Return the indices of the columns, with the time first.

    pandas writes the index of a table as its last column. The time is the column `time`, or else the index. An index
    without a name beside a column `time` is a row number, and is left out.
    """
    names = [field.name for field in schema]
    try:
        of_pandas = [*json.loads((schema.metadata or {})[PANDAS])["index_columns"]]
    except (KeyError, TypeError, ValueError):
        of_pandas = []
    index = [name for name in names if name in of_pandas or UNNAMED.fullmatch(name)]
    first = [name for name in names if is_time(split_heading(name)[0])][:1] or index
    left_out = {name for name in index if UNNAMED.fullmatch(name) and len(first) == 1}
    others = [k for k, name in enumerate(names) if name not in first and name not in left_out]
    return [*(k for k, name in enumerate(names) if name in first), *others]


def _column(name: str, unit: str, column: Any, *, is_text: bool) -> Column:
    import pyarrow as pa
    from pyarrow import types

    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    kind = column.type
    is_whole = types.is_boolean(kind) or types.is_integer(kind)
    if types.is_string(kind) or types.is_large_string(kind) or (is_text and is_whole):
        values = ["" if value is None else str(value) for value in column.to_pylist()]
        return Column(name, unit, values, is_text=not is_whole)
    if types.is_binary(kind) or types.is_large_binary(kind) or types.is_fixed_size_binary(kind):
        return Column(name, unit, [(value or b"").hex() for value in column.to_pylist()], is_text=True)
    if types.is_timestamp(kind):
        column = column.cast(pa.timestamp("us", kind.tz), safe=False)
        return Column(name, unit, ["" if value is None else value.isoformat() for value in column.to_pylist()])
    if is_whole and not column.null_count:
        return Column(name, unit, plain_numbers(column.to_numpy()))
    if not (is_whole or types.is_floating(kind) or types.is_null(kind)):
        return Column(name, unit, fault=f"has the type {str(kind)[:60]}; write one number per cell, times in seconds")
    values = column.cast("float64", safe=False).to_numpy()  # with NaN for missing ones
    return Column(name, unit, np.asarray(values, dtype=np.float64))
