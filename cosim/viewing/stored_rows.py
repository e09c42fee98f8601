"""Rows of a file: small tables in memory, others from Parquet in the cache, written once with the extremes of blocks.

`view/HASH` in the user's cache, by the content of the table, holds rows.parquet, low.parquet and high.parquet with
equal columns, and about.json. Rows of low.parquet and high.parquet are the levels of `pyramid`, one behind the other.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.drafts import is_full
from cosim.base.errors import InputError
from cosim.base.messages import printable
from cosim.base.scratch import process_folder
from cosim.base.units import factor
from cosim.storage.cache import cache_folder, load_or_make
from cosim.storage.csv_source import CSV, read_heading
from cosim.storage.files import open_bytes, scratch_folder
from cosim.storage.folders import content_of
from cosim.storage.parquet_source import PARQUET, heading_of
from cosim.storage.results import INTEGER, Results, is_rounded, read_results
from cosim.storage.table import is_time, source_of
from cosim.viewing.pyramid import (
    FACTOR,
    TIME,
    Part,
    Places,
    Recording,
    join_blocks,
    level_sizes,
    make_levels,
)

FOLDER, ABOUT, VERSION = "view", "about.json", 4
UNUSED = 30 * 86_400.0  # [s] from which a conversion is removed
DRAFT = "draft-"  # prefix of a conversion that is being written
SETTLED = 2.0  # [s] without a change, after which size and times of a file stand for its content
TEXTS, TEXT_ROWS = "texts", 1 << 16  # file of texts, and the rows of a group in it
SMALL = 4_000_000  # size of a table that is read as a whole [bytes]
GROUP_VALUES = 1 << 23  # values written at a time
LEAST_GROUP, MOST_GROUP = FACTOR**3, 4 * FACTOR**3  # rows of a group
MEMORY = 1 << 28  # of columns kept from files [bytes]
BLOCK = 1 << 24  # of text read at a time [bytes]
WHOLE = f"^({INTEGER.pattern})$"
Progress = Callable[[int, int], None] | None
Batches = Iterator[tuple[list[Array], int]]  # columns, and how much of the file they end at


class Chunks:
    """Columns of row groups that were read last, up to a size; for all files together."""

    def __init__(self, size: int = MEMORY) -> None:
        self._size, self._used, self._lock = size, 0, threading.Lock()
        self._chunks = OrderedDict[Any, Any]()  # arrays of numpy, and of pyarrow for texts

    def get(self, key: Any) -> Any:
        """Return a chunk if it is here."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, chunks: Mapping[Any, Any]) -> None:
        """Keep chunks in the place of those that were used longest ago."""
        with self._lock:
            for key, chunk in chunks.items():
                if key not in self._chunks:
                    self._chunks[key] = chunk
                    self._used += chunk.nbytes
            while self._used > self._size and len(self._chunks) > 1:
                self._used -= self._chunks.popitem(last=False)[1].nbytes


CHUNKS = Chunks()


class StoredRecording(Recording):
    """Rows in the Parquet files of a cache, opened at their first use."""

    def __init__(self, folder: Path, about: Mapping[str, Any]) -> None:
        super().__init__({}, about["units"], int(about["rows"]), dict.fromkeys(about["texts"], ()))
        self.rounded, self.inexact = list(about["rounded"]), list(about["inexact"])
        self._folder, self._group = folder, int(about["group"])
        self._ends = tuple(about["span"])
        self._files: dict[str, Any] = {}

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s]."""
        return float(self._ends[0]), float(self._ends[1])

    def take(self, part: Part, name: str, places: Places) -> Array:
        """Return values of a column at places, which are within it."""
        if name in self.added:
            return super().take(part, name, places)
        size = self._group
        if isinstance(places, slice):
            first, last = places.start // size, max(places.start, places.stop - 1) // size
            chunks = [
                self._chunk(part, name, k)[max(0, places.start - k * size) : places.stop - k * size]
                for k in range(first, last + 1)
            ]
            return chunks[0] if len(chunks) == 1 else np.concatenate(chunks)
        groups, values = places // size, np.empty(places.size)
        for group in np.unique(groups).tolist():
            here = groups == group
            values[here] = self._chunk(part, name, group)[places[here] - group * size]
        return values

    def text(self, name: str, row: int) -> str:
        """Return a text of a row."""
        group = row // TEXT_ROWS
        chunk = CHUNKS.get((id(self), TEXTS, name, group))
        if chunk is None:
            with self._lock:
                chunk = self._file(TEXTS).read_row_group(group, columns=[name], use_threads=False).column(name)
            CHUNKS.put({(id(self), TEXTS, name, group): chunk})
        return str(chunk[row % TEXT_ROWS].as_py())

    def _file(self, part: str) -> Any:
        if part not in self._files:
            from pyarrow import parquet

            self._files[part] = parquet.ParquetFile(self._folder / f"{part}.parquet", memory_map=True)
        return self._files[part]

    def _chunk(self, part: Part, name: str, group: int) -> Array:
        """Return a column of a row group, read together with the other columns that are needed now."""
        found: Array | None = CHUNKS.get((id(self), part, name, group))
        if found is not None:
            return found
        names = {name}
        if name in self.needed:  # not time, of which a search reads other groups
            names |= {n for n in self.needed if CHUNKS.get((id(self), part, n, group)) is None} - {*self.added}
        with self._lock:
            # A column a also brings a.b, whose path begins with its name.
            table = self._file(part).read_row_group(group, columns=sorted(names), use_threads=False)
        chunks = {n: np.asarray(table.column(n).to_numpy(), dtype=np.float64) for n in names}
        CHUNKS.put({(id(self), part, n, group): chunk for n, chunk in chunks.items()})
        return chunks[name]


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
        """Return the rows of a table in memory."""
        return read_results(path, self.units, self.text, words=self.words)


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
        return _in_memory(columns.read(path), path)
    place = cache_folder() / FOLDER / _key(path, status, columns)
    if about := content_of(place / ABOUT):
        os.utime(place)
        return StoredRecording(place, about)
    return StoredRecording(*_convert(path, status, place, columns, progress))


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


def _in_memory(results: Results, path: Path) -> Recording:
    if not results.time.size:
        raise InputError.at(path, "has no row yet; wait for the end of the run, or run it again")
    shown = results.with_integers()
    columns = {TIME: shown.time, **{printable(name): shown[name] for name in shown.columns}}
    units = {printable(name): printable(shown.units.get(name, "")) for name in shown.columns}
    texts = {printable(name): values for name, values in shown.texts().items()}
    recording = Recording(columns, units, shown.time.size, texts)
    recording.inexact = _inexact(results)
    return recording


def _inexact(results: Results) -> list[str]:
    return [name for name in results.columns if name in results.whole and is_rounded(results[name])]


# -- conversion -------------------------------------------------------------------------------------------


def _convert(
    path: Path, status: os.stat_result, place: Path, columns: ColumnTypes, progress: Progress
) -> tuple[Path, Any]:
    """Write the files of a cache; return their folder and description. Faults of a table are those of its reader."""
    import pyarrow

    _remove_unused(place.parent)
    with scratch_folder(place.parent, DRAFT) as folder:
        draft = folder / place.name
        draft.mkdir()
        try:
            table = _table_of(path, columns)
            table = replace(table, heads=[(printable(name), printable(unit)) for name, unit in table.heads])
            whole, rounded = _write_texts(draft / f"{TEXTS}.parquet", table)
            places = [*table.numbers, *whole]
            integers = {n for n, k in enumerate(places) if k in table.integers}
            about = _write(draft, [table.heads[k] for k in places], table.batches(places), integers, (path, progress))
            about["texts"], about["rounded"] = ([table.heads[k][0] for k in some] for some in (table.texts, rounded))
        except (pyarrow.ArrowException, OSError, ValueError) as error:
            if is_full(error):
                raise
            results = columns.read(path)  # which tells each fault by its place
            if not results.time.size:
                raise InputError.at(path, "has no row yet; wait for the end of the run, or run it again") from None
            raise InputError.at(path, "cannot be read: {reason}".format(reason=str(error).partition("\n")[0])) from None
        (draft / ABOUT).write_text(json.dumps(about), encoding="utf-8")
        if _state(path.stat()) != _state(status):  # no longer the content of its key
            place = process_folder() / FOLDER / place.name
            place.parent.mkdir(exist_ok=True)
        shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):  # Another command was faster.
            shutil.move(draft, place)
    return place, about


def _remove_unused(folder: Path) -> None:
    """Remove conversions of other tables that nobody has looked at for long."""
    folder.mkdir(mode=0o700, exist_ok=True)
    for place in folder.iterdir():
        with suppress(OSError):
            if not place.name.startswith(DRAFT) and time.time() - place.stat().st_mtime > UNUSED:
                shutil.rmtree(place)


@dataclass(frozen=True)
class _Table:
    """Columns of a table by their places.

    Attributes:
        heads: Names and units.
        numbers: Places of the columns of numbers, time first.
        texts: Places of the columns of texts, and of integers that doubles do not hold.
        words: Places of the columns of texts that are no integers, also if they look like it.
        integers: Places of the columns of numbers that the file has as integers.
        batches: Function of places that returns their columns as numbers.
        text_batches: Function of places that returns their columns as arrays of pyarrow with texts.
    """

    heads: Sequence[tuple[str, str]]
    numbers: Sequence[int]
    texts: Sequence[int]
    batches: Callable[[Sequence[int]], Batches]
    text_batches: Callable[[Sequence[int]], Iterator[Sequence[Any]]]
    words: Collection[int]
    integers: Collection[int]


def _table_of(path: Path, columns: ColumnTypes) -> _Table:
    """Return the columns of a table in any format."""
    source = source_of(path)
    if source is CSV:
        return _csv_table(path, columns)
    if source is PARQUET:
        return _parquet_table(path, columns)
    from pyarrow import array, string

    results = columns.read(path)
    texts, last = results.texts(), len(results.columns) + 1
    values = [results.time, *results.values.T, *texts.values()]
    heads = [(TIME, "s"), *((name, results.units.get(name, "")) for name in (*results.columns, *texts))]

    def batches(places: Sequence[int]) -> Batches:
        yield [np.asarray(values[k], dtype=np.float64) for k in places], path.stat().st_size

    def text_batches(places: Sequence[int]) -> Iterator[Sequence[Any]]:
        yield [array(values[k], string()) for k in places]

    words, inexact = ({k for k, (name, _) in enumerate(heads) if name in s} for s in (results.words, results.whole))
    return _Table(heads, range(last), range(last, len(values)), batches, text_batches, words, inexact)


def _csv_table(path: Path, columns: ColumnTypes) -> _Table:
    from pyarrow import csv, float64, string, types

    heads, line = read_heading(path, columns.units)
    reading = csv.ReadOptions(block_size=BLOCK, skip_rows=line, column_names=[str(k) for k in range(len(heads))])
    with csv.open_csv(path, read_options=reading) as first:
        kinds = first.schema.types
    numbers = [types.is_floating(kind) or types.is_integer(kind) or types.is_null(kind) for kind in kinds]

    def read(places: Sequence[int], kind: Any) -> Iterator[Any]:
        names = [str(k) for k in places]
        converting = csv.ConvertOptions(column_types=dict.fromkeys(names, kind), include_columns=names)
        with csv.open_csv(path, read_options=reading, convert_options=converting) as reader:
            yield from reader

    def batches(places: Sequence[int]) -> Batches:
        size, done = path.stat().st_size, 0
        for batch in read(places, float64()):
            done = min(size, done + BLOCK)
            yield [column.to_numpy(zero_copy_only=False) for column in batch.columns], done

    words = {k for k, (name, _) in enumerate(heads) if name in columns.words}
    integers = {k for k, kind in enumerate(kinds) if types.is_integer(kind)}
    chosen = _choose(heads, numbers, columns.text)
    return _Table(heads, *chosen, batches, lambda k: (b.columns for b in read(k, string())), words, integers)


def _parquet_table(path: Path, columns: ColumnTypes) -> _Table:
    from pyarrow import array, parquet, string, types

    file = parquet.ParquetFile(path)
    heads, numbers, kinds = list[tuple[str, str]](), list[bool](), list[Any]()
    for column in file.schema_arrow:
        heads.append(heading_of(column, columns.units))
        kind = column.type.value_type if types.is_dictionary(column.type) else column.type
        kinds.append(kind)
        numbers.append(types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind))

    def read() -> Iterator[Any]:
        with parquet.ParquetFile(path) as rows:
            yield from rows.iter_batches(MOST_GROUP)

    def batches(places: Sequence[int]) -> Batches:
        size, rows, done = path.stat().st_size, max(1, file.metadata.num_rows), 0
        for batch in read():
            done += batch.num_rows
            arrays = [batch.column(k).cast("float64", safe=False) for k in places]
            yield [a.to_numpy(zero_copy_only=False) for a in arrays], size * done // rows

    def texts_of(column: Any, kind: Any) -> Any:
        is_binary = types.is_binary(kind) or types.is_large_binary(kind) or types.is_fixed_size_binary(kind)
        return array([(v or b"").hex() for v in column.to_pylist()], string()) if is_binary else column.cast("string")

    def text_batches(places: Sequence[int]) -> Iterator[Sequence[Any]]:
        for batch in read():
            yield [texts_of(batch.column(k), kinds[k]) for k in places]

    words = {k for k, is_number in enumerate(numbers) if not is_number or heads[k][0] in columns.words}
    integers = {k for k, kind in enumerate(kinds) if types.is_integer(kind)}
    return _Table(heads, *_choose(heads, numbers, columns.text), batches, text_batches, words, integers)


def _choose(
    heads: Sequence[tuple[str, str]], numbers: Sequence[bool], text: Sequence[str]
) -> tuple[list[int], list[int]]:
    """Return the places of time and of all columns of numbers, and those of texts, each name once."""
    if not heads or not is_time(heads[0][0]) or not numbers[0]:
        raise ValueError("the first column is no time")
    firsts: dict[str, int] = {}
    for place, (name, _) in enumerate(heads[1:], 1):
        if name != TIME:
            firsts.setdefault(name, place)
    of_text = [place for name, place in firsts.items() if name in text or not numbers[place]]
    return [0, *(place for place in firsts.values() if place not in {*of_text})], of_text


def _write_texts(path: Path, table: _Table) -> tuple[list[int], list[int]]:
    """Write columns of texts; return the places of integer columns, and of columns with integers above 2^53."""
    if not table.texts:
        return [], []
    import pyarrow as pa
    from pyarrow import compute, parquet

    schema = pa.schema([pa.field(table.heads[k][0], pa.string()) for k in table.texts])
    whole, rounded, waiting = {*table.texts} - {*table.words}, set[int](), schema.empty_table()
    with parquet.ParquetWriter(path, schema, compression="lz4", write_statistics=False) as file:
        for columns in table.text_batches(table.texts):
            for place, column in zip(table.texts, columns, strict=True):
                if place in whole and compute.all(compute.match_substring_regex(column, WHOLE), min_count=0).as_py():
                    rounded |= {place} if is_rounded(column.cast("float64").to_numpy(zero_copy_only=False)) else set()
                else:
                    whole.discard(place)
            waiting = pa.concat_tables([waiting, pa.Table.from_arrays(columns, schema=schema)])
            full = waiting.num_rows // TEXT_ROWS * TEXT_ROWS
            if full:
                file.write_table(waiting.slice(0, full), row_group_size=TEXT_ROWS)
                waiting = waiting.slice(full)
        if waiting.num_rows:
            file.write_table(waiting, row_group_size=TEXT_ROWS)
    return sorted(whole), sorted(whole & rounded)


def _further_levels(seconds: Sequence[tuple[Array, Array]], sizes: Sequence[int]) -> list[tuple[Array, Array]]:
    """Return the extremes of the second level and of those above; none for few rows."""
    if len(sizes) < 3:
        return []
    low, high = (np.concatenate(sides, axis=1) for sides in zip(*seconds, strict=True))
    return [(low, high), *make_levels(low, high, sizes[2:])]


def _write(
    draft: Path, heads: list[tuple[str, str]], batches: Batches, integers: set[int], about: tuple[Path, Progress]
) -> Any:
    """Write rows and extremes; return a cache's description.

    Args:
        integers: Places of columns that the file has as integers.
        about: File that is converted, and function of the converted and the whole size.
    """
    (path, progress), inexact = about, set[int]()
    units = dict(heads[1:])
    names, scale = [TIME, *units], factor(heads[0][1], "s") or 1.0
    group = max(LEAST_GROUP, min(MOST_GROUP, GROUP_VALUES // len(names) // LEAST_GROUP * LEAST_GROUP))
    size, rows, last, ends = path.stat().st_size, 0, -np.inf, list[float]()
    files = [_GroupFile(draft / f"{part}.parquet", names, group) for part in ("rows", "low", "high")]
    seconds: list[tuple[Array, Array]] = []  # the second level
    try:
        for values, done in _regroup(batches, group):
            values[0] *= scale
            time = values[0]
            if not (np.isfinite(time).all() and np.all(np.diff(time, prepend=last) >= 0.0)):
                raise ValueError("a time is missing or goes back")
            last, rows = float(time[-1]), rows + time.size
            ends = [*ends[:1], *([float(time[0])] if not ends else []), last]
            files[0].add(values)
            inexact |= _rounded_among(integers - inexact, values)
            values[~np.isfinite(values)] = np.nan
            first = join_blocks(values, values)
            for file, side in zip(files[1:], first, strict=True):
                file.add(side)
            seconds.append(join_blocks(*first))
            if progress is not None:
                progress(done, size)
        if not rows:
            raise ValueError("there is no row")
        for level in _further_levels(seconds, level_sizes(rows)):
            for file, side in zip(files[1:], level, strict=True):
                file.add(side)
    finally:
        for file in files:
            file.close()
    named = list(map(names.__getitem__, sorted(inexact)))
    return {"units": units, "rows": rows, "group": group, "span": ends, "inexact": named}


def _rounded_among(places: Iterable[int], values: Array) -> set[int]:
    return {place for place in places if is_rounded(values[place])}


def _regroup(batches: Batches, group: int) -> Iterator[tuple[Array, int]]:
    """Yield values in groups of equal size, shape (columns, rows), the rest last."""
    waiting, count, done = list[list[Array]](), 0, 0
    for columns, done in batches:
        while columns[0].size:
            taken = min(group - count, columns[0].size)
            waiting.append([column[:taken] for column in columns])
            columns, count = [column[taken:] for column in columns], count + taken
            if count == group:
                yield _joined(waiting), done
                waiting, count = [], 0
    if count:
        yield _joined(waiting), done


def _joined(parts: list[list[Array]]) -> Array:
    return np.array([np.concatenate(column) for column in zip(*parts, strict=True)], dtype=np.float64)


class _GroupFile:
    """A Parquet file of doubles, written in row groups of equal size."""

    def __init__(self, path: Path, names: Sequence[str], group: int) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        self._schema = pa.schema([pa.field(name, pa.float64()) for name in names])
        self._file = parquet.ParquetWriter(
            path, self._schema, compression="lz4", use_dictionary=False, write_statistics=False
        )
        self._group, self._waiting, self._count = group, list[Array](), 0

    def add(self, values: Array) -> None:
        """Add rows, shape (columns, rows)."""
        self._waiting.append(values.copy())
        self._count += values.shape[1]
        while self._count >= self._group:
            self._flush(self._group)

    def close(self) -> None:
        """Write the rest and close the file."""
        if self._count:
            self._flush(self._count)
        self._file.close()

    def _flush(self, rows: int) -> None:
        import pyarrow as pa

        values = np.concatenate(self._waiting, axis=1)
        self._file.write_table(pa.Table.from_arrays(list(map(pa.array, values[:, :rows])), schema=self._schema), rows)
        self._waiting, self._count = [values[:, rows:]], self._count - rows
