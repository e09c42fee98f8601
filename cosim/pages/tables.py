"""Rows of tables: small ones in memory, others in files of the cache, written once with the extremes of blocks.

`view/HASH` in the user's cache, by the content of the table, holds the files of a `Store`, texts.arrow and about.json.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import compute, csv, parquet

from cosim.core.drafts import is_full
from cosim.core.errors import InputError
from cosim.core.messages import printable
from cosim.core.scratch import process_folder
from cosim.core.units import factor
from cosim.files.cache import cache_folder, load_or_make
from cosim.files.csv_source import CSV, read_heading
from cosim.files.files import open_bytes, scratch_folder
from cosim.files.folders import content_of
from cosim.files.parquet_source import PARQUET, heading_of
from cosim.files.results import INTEGER, Results, is_rounded, read_results
from cosim.files.table import is_time, source_of
from cosim.pages.rows import TIME, Recording, Store

FOLDER, ABOUT, TEXTS, VERSION = "view", "about.json", "texts.arrow", 5
UNUSED = 30 * 86_400.0  # [s] from which a conversion is removed
DRAFT = "draft-"  # prefix of a conversion that is being written
SETTLED = 2.0  # [s] without a change, after which size and times of a file stand for its content
SMALL = 4_000_000  # size of a table that is read as a whole [bytes]
ROWS = 1 << 16  # of a Parquet file, read at a time
BLOCK = 1 << 24  # of text read at a time [bytes]
WHOLE = f"^({INTEGER.pattern})$"
Progress = Callable[[int, int], None] | None


@dataclass(frozen=True)
class ColumnTypes:
    """What is known of the columns of a table from elsewhere.

    Attributes:
        units: Units of columns without unit in the header.
        text: Columns of text or of large integers, even with numeric content.
        words: Columns of `text` that are no integers, also if they look like it.
    """

    units: Mapping[str, str] = field(default_factory=dict)
    text: Sequence[str] = ()
    words: frozenset[str] = frozenset()

    def read(self, path: Path) -> Results:
        """Return the rows of a table in memory; raise InputError without rows."""
        results = read_results(path, self.units, self.text, words=self.words)
        if not results.time.size:
            raise InputError.at(path, "has no row yet; wait for the end of the run, or run it again")
        return results


def open_rows(path: Path, columns: ColumnTypes, progress: Progress = None) -> Recording:
    """Return the rows of a table; convert a large one first, unless its conversion is there.

    Args:
        columns: What is known of the columns from elsewhere.
        progress: Function of the converted and the whole size.

    Raises:
        InputError: The table has faults, or no rows.
    """
    status = path.stat() if path.is_file() else None
    if status is None or status.st_size <= SMALL:
        results = columns.read(path)
        shown = results.with_integers()
        numbers = {TIME: shown.time, **{printable(name): shown[name] for name in shown.columns}}
        units = {printable(name): printable(shown.units.get(name, "")) for name in shown.columns}
        texts = {printable(name): values for name, values in shown.texts().items()}
        recording = Recording(numbers, units, shown.time.size, texts)
        recording.inexact = [name for name in results.columns if name in results.whole and is_rounded(results[name])]
        return recording
    place = cache_folder() / FOLDER / _key(path, status, columns)
    if content_of(place / ABOUT):
        os.utime(place)
    else:
        place.parent.mkdir(mode=0o700, exist_ok=True)
        for each in place.parent.iterdir():  # conversions that nobody has looked at for long
            with suppress(OSError):
                if not each.name.startswith(DRAFT) and time.time() - each.stat().st_mtime > UNUSED:
                    shutil.rmtree(each)
        with scratch_folder(place.parent, DRAFT) as folder:
            draft = folder / place.name
            draft.mkdir()
            try:
                written = _write(draft, path, _table_of(path, columns), columns, progress)
            except (pa.ArrowException, OSError, ValueError) as error:
                if is_full(error):
                    raise
                columns.read(path)  # which tells each fault by its place
                raise InputError.at(path, f"cannot be read: {str(error).partition(chr(10))[0]}") from None
            (draft / ABOUT).write_text(json.dumps(written), encoding="utf-8")
            if _state(path.stat()) != _state(status):  # no longer the content of its key
                place = process_folder() / FOLDER / place.name
                place.parent.mkdir(exist_ok=True)
            shutil.rmtree(place, ignore_errors=True)
            with suppress(OSError):  # Another command was faster.
                shutil.move(draft, place)
    about: Any = content_of(place / ABOUT)
    store = Store(place, about["units"], int(about["rows"]))
    store.rounded, store.inexact = about["rounded"], about["inexact"]
    store.units = {name: unit for name, unit in store.units.items() if name not in about["hidden"]}
    if about["texts"]:
        with pa.memory_map(str(place / TEXTS)) as file:
            table = pa.ipc.open_file(file).read_all()
        store.texts = {name: table.column(k) for k, name in enumerate(about["texts"])}
    return store


def _key(path: Path, status: os.stat_result, columns: ColumnTypes) -> str:
    """Return a key of the content of a file and of its types."""

    def digest() -> str:
        with open_bytes(path) as stream:
            return file_digest(stream, "sha256").hexdigest()

    is_settled = time.time() - max(status.st_mtime, status.st_ctime) > SETTLED
    content = load_or_make(repr((str(path.resolve()), _state(status))), digest) if is_settled else digest()
    types = [sorted(columns.units.items()), sorted(columns.text), sorted(columns.words)]
    return sha256(json.dumps([VERSION, path.suffix, content, types]).encode()).hexdigest()


def _state(status: os.stat_result) -> tuple[int, ...]:
    """Return numbers that differ after a change of a file; only the system sets the last one."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


# -- conversion -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Table:
    """Columns of a table by their places.

    Attributes:
        heads: Names and units.
        numbers: Whether each column has numbers.
        whole: Places of the columns of integers.
        batches: Function of the places of numbers and of texts that yields these columns as doubles and as strings of
            pyarrow, and how much of the file they end at.
    """

    heads: Sequence[tuple[str, str]]
    numbers: Sequence[bool]
    whole: Collection[int]
    batches: Callable[[Sequence[int], Sequence[int]], Iterator[tuple[list[Any], list[Any], int]]]


def _write(draft: Path, path: Path, table: _Table, columns: ColumnTypes, progress: Progress) -> dict[str, Any]:
    """Write rows, extremes and texts; return the description of a cache."""
    heads = [(printable(name), printable(unit)) for name, unit in table.heads]
    if not heads or not is_time(heads[0][0]) or not table.numbers[0]:
        raise ValueError("the first column is no time")
    firsts: dict[str, int] = {}
    for place, (name, _) in enumerate(heads[1:], 1):
        firsts.setdefault(name, place)
    firsts.pop(TIME, None)
    texts = [k for name, k in firsts.items() if not table.numbers[k] or name in columns.text]
    numbers = [0, *(k for k in firsts.values() if k not in texts)]
    # Texts that are integers are numbers too, unless they are known to be words, or one of them is none.
    tried = [k for k in texts if heads[k][0] not in columns.words]
    whole, inexact, rounded = {*tried}, set[int](), set[int]()
    store = Store(draft, dict(heads[k] for k in (*numbers[1:], *tried)))
    scale, last = factor(heads[0][1], "s") or 1.0, -np.inf
    schema, size = pa.schema([pa.field(str(k), pa.string()) for k in texts]), path.stat().st_size
    with pa.OSFile(str(draft / TEXTS), "wb") as file, pa.ipc.new_file(file, schema) as kept:
        for doubles, strings, done in table.batches(numbers, texts):
            values = [np.asarray(v, np.float64) for v in doubles]
            values[0] = values[0] * scale
            if not (np.isfinite(values[0]).all() and np.all(np.diff(values[0], prepend=last) >= 0.0)):
                raise ValueError("a time is missing or goes back")
            last = float(values[0][-1]) if values[0].size else last
            inexact |= {k for k, v in zip(numbers, values, strict=True) if k in table.whole and is_rounded(v)}
            for k in tried:
                column, found = strings[texts.index(k)], np.full(values[0].size, np.nan)
                if k in whole and compute.all(compute.match_substring_regex(column, WHOLE), min_count=0).as_py():
                    found = column.cast("float64").to_numpy(zero_copy_only=False)
                    rounded |= {k} if is_rounded(found) else set()
                else:
                    whole.discard(k)
                values.append(found)
            if texts:
                kept.write_batch(pa.RecordBatch.from_arrays(strings, schema=schema))
            store.append(np.array(values))
            if progress is not None:
                progress(min(done, size), size)
    if not store.rows:
        raise ValueError("there is no row")
    store.finish()
    return {
        "units": dict(heads[k] for k in (*numbers[1:], *tried)),
        "hidden": [heads[k][0] for k in tried if k not in whole],
        "rows": store.rows,
        "texts": [heads[k][0] for k in texts],
        "rounded": [heads[k][0] for k in sorted(rounded & whole)],
        "inexact": [heads[k][0] for k in sorted(inexact)],
    }


def _table_of(path: Path, columns: ColumnTypes) -> _Table:
    """Return the columns of a table in any format."""
    source = source_of(path)
    if source is CSV:
        return _csv_table(path, columns)
    if source is PARQUET:
        return _parquet_table(path, columns)
    results = columns.read(path)
    texts, size = results.texts(), path.stat().st_size
    values = [results.time, *results.values.T, *(pa.array(each, pa.string()) for each in texts.values())]
    heads = [(TIME, "s"), *((name, results.units.get(name, "")) for name in (*results.columns, *texts))]
    whole = {k for k, (name, _) in enumerate(heads) if name in results.whole}
    numbers = [k <= len(results.columns) for k in range(len(heads))]
    return _Table(heads, numbers, whole, lambda n, t: iter([([values[k] for k in n], [values[k] for k in t], size)]))


def _csv_table(path: Path, columns: ColumnTypes) -> _Table:
    heads, line = read_heading(path, columns.units)
    reading = csv.ReadOptions(block_size=BLOCK, skip_rows=line, column_names=[str(k) for k in range(len(heads))])
    with csv.open_csv(path, read_options=reading) as first:
        kinds = first.schema.types

    def batches(numbers: Sequence[int], texts: Sequence[int]) -> Iterator[tuple[list[Any], list[Any], int]]:
        types = dict.fromkeys(map(str, numbers), pa.float64()) | dict.fromkeys(map(str, texts), pa.string())
        converting = csv.ConvertOptions(column_types=types, include_columns=list(types))
        with csv.open_csv(path, read_options=reading, convert_options=converting) as reader:
            for number, batch in enumerate(reader, 1):
                parts = batch.columns
                doubles = [column.to_numpy(zero_copy_only=False) for column in parts[: len(numbers)]]
                yield doubles, parts[len(numbers) :], number * BLOCK

    is_number = [pa.types.is_floating(k) or pa.types.is_integer(k) or pa.types.is_null(k) for k in kinds]
    return _Table(heads, is_number, {k for k, kind in enumerate(kinds) if pa.types.is_integer(kind)}, batches)


def _parquet_table(path: Path, columns: ColumnTypes) -> _Table:
    schema = parquet.read_schema(path)
    heads, kinds = list[tuple[str, str]](), list[Any]()
    for column in schema:
        heads.append(heading_of(column, columns.units))
        kinds.append(column.type.value_type if pa.types.is_dictionary(column.type) else column.type)

    def text_of(column: Any, kind: Any) -> Any:
        if pa.types.is_binary(kind) or pa.types.is_large_binary(kind) or pa.types.is_fixed_size_binary(kind):
            return pa.array([(v or b"").hex() for v in column.to_pylist()], pa.string())
        return column.cast("string")

    def batches(numbers: Sequence[int], texts: Sequence[int]) -> Iterator[tuple[list[Any], list[Any], int]]:
        done, size = 0, path.stat().st_size
        with parquet.ParquetFile(path) as file:
            count = max(1, file.metadata.num_rows)
            for batch in file.iter_batches(ROWS):
                done += batch.num_rows
                cast = [batch.column(k).cast("float64", safe=False) for k in numbers]
                doubles = [column.to_numpy(zero_copy_only=False) for column in cast]
                yield doubles, [text_of(batch.column(k), kinds[k]) for k in texts], size * done // count

    is_number = [pa.types.is_floating(k) or pa.types.is_integer(k) or pa.types.is_boolean(k) for k in kinds]
    return _Table(heads, is_number, {k for k, kind in enumerate(kinds) if pa.types.is_integer(kind)}, batches)
