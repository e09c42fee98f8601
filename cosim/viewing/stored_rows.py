"""Rows of a file: small tables in memory, others from Parquet beside them, written once with the extremes of blocks.

`.view/NAME` beside a table holds rows.parquet, low.parquet and high.parquet with equal columns, and about.json. Rows of
low.parquet and high.parquet are the levels of `pyramid`, one behind the other.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.extras import install_command, optional
from cosim.base.scratch import process_folder
from cosim.base.units import factor
from cosim.storage.csv_source import CSV, read_heading
from cosim.storage.folders import content_of
from cosim.storage.parquet_source import PARQUET, UNIT
from cosim.storage.results import Results, read_results
from cosim.storage.table_columns import is_time, split_heading
from cosim.storage.table_source import source_of
from cosim.viewing import messages
from cosim.viewing.pyramid import FACTOR, TIME, Part, Places, Recording, join_blocks, level_sizes, make_levels

FOLDER, ABOUT, VERSION = ".view", "about.json", 1
SMALL = 4_000_000  # size of a table that is read as a whole [bytes]
GROUP_VALUES = 1 << 23  # values written at a time
LEAST_GROUP, MOST_GROUP = FACTOR**3, 4 * FACTOR**3  # rows of a group
MEMORY = 1 << 28  # of columns kept from files [bytes]
BLOCK = 1 << 24  # of text read at a time [bytes]
Progress = Callable[[int, int], None] | None
Batches = Iterator[tuple[list[Array], int]]  # columns, and how much of the file they end at


class Chunks:
    """Columns of row groups that were read last, up to a size; for all files together."""

    def __init__(self, size: int = MEMORY) -> None:
        self._size, self._used, self._lock = size, 0, threading.Lock()
        self._chunks = OrderedDict[Any, Array]()

    def get(self, key: Any) -> Array | None:
        """Return a chunk if it is here."""
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
            return self._chunks.get(key)

    def put(self, chunks: Mapping[Any, Array]) -> None:
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
        super().__init__({}, about["units"], int(about["rows"]))
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

    def _chunk(self, part: Part, name: str, group: int) -> Array:
        """Return a column of a row group, read together with the other columns that are needed now."""
        if (found := CHUNKS.get((id(self), part, name, group))) is not None:
            return found
        names = {name}
        if name in self.needed:  # not time, of which a search reads other groups
            names |= {n for n in self.needed if CHUNKS.get((id(self), part, n, group)) is None} - {*self.added}
        with self._lock:
            file = self._files.get(part)
            if file is None:
                parquet = optional("pyarrow.parquet", "cosim view")
                file = self._files[part] = parquet.ParquetFile(self._folder / f"{part}.parquet", memory_map=True)
            # A column a also brings a.b, whose path begins with its name.
            table = file.read_row_group(group, columns=sorted(names), use_threads=False)
        chunks = {n: np.asarray(table.column(n).to_numpy(), dtype=np.float64) for n in names}
        CHUNKS.put({(id(self), part, n, group): chunk for n, chunk in chunks.items()})
        return chunks[name]


def open_rows(path: Path, units: Mapping[str, str], text: Sequence[str], progress: Progress = None) -> Recording:
    """Return the rows of a table; convert a large one first, unless its conversion is there.

    Args:
        units: Units of columns without unit in the header.
        text: Columns of text, which are left out.
        progress: Function of the converted and the whole size.

    Raises:
        InputError: The table has faults, or no rows.
    """
    status = path.stat() if path.is_file() else None
    if status is None or status.st_size <= SMALL or not _has_pyarrow():
        return _in_memory(read_results(path, units, text), path)
    key = _key(status, units, text)
    places = [
        path.parent / FOLDER / path.name,
        process_folder() / FOLDER / sha256(os.fsencode(path.resolve())).hexdigest(),
    ]
    for place in places:
        about = content_of(place / ABOUT)
        if about.get("key") == key and not place.is_symlink() and not place.parent.is_symlink():
            return StoredRecording(place, about)
    place = places[0] if _is_writable(path.parent) else places[1]
    return StoredRecording(place, _convert(path, place, units, text, progress))


def notes_on(path: Path) -> list[str]:
    """Return notes on rows that must be read or converted anew each time."""
    if path.stat().st_size <= SMALL:
        return []
    if not _has_pyarrow():
        return [messages.SLOW_ROWS(file=path, command=install_command("parquet"))]
    return [] if _is_writable(path.parent) else [messages.TEMPORARY(folder=path.parent)]


def _key(status: os.stat_result, units: Mapping[str, str], text: Sequence[str]) -> dict[str, Any]:
    """Return a value that changes with a file and with what is known of its columns."""
    known = sha256(json.dumps([sorted(units.items()), sorted(text)]).encode()).hexdigest()
    return {"version": VERSION, "size": status.st_size, "time": status.st_mtime_ns, "known": known}


def _has_pyarrow() -> bool:
    return find_spec("pyarrow") is not None


def _is_writable(folder: Path) -> bool:
    """Return whether the cache of a folder can be written; a link may lead elsewhere and is not followed."""
    cache = folder / FOLDER
    return not cache.is_symlink() and os.access(cache if cache.is_dir() else folder, os.W_OK | os.X_OK)


def _in_memory(results: Results, path: Path) -> Recording:
    if not results.time.size:
        raise InputError.at(path, messages.NO_ROW())
    columns = {TIME: results.time, **{name: results[name] for name in results.columns}}
    return Recording(columns, {name: results.units.get(name, "") for name in results.columns}, results.time.size)


# -- conversion -------------------------------------------------------------------------------------------


def _convert(path: Path, place: Path, units: Mapping[str, str], text: Sequence[str], progress: Progress) -> Any:
    """Write the files of a cache and return their description; the faults of a table are those of its reader."""
    import pyarrow

    draft = place.with_name(f".{place.name}.{os.getpid()}")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    status = path.stat()
    try:
        try:
            about = _write(draft, *_columns_of(path, units, text), path, progress)
        except (pyarrow.ArrowException, OSError, ValueError) as error:
            results = read_results(path, units, text)  # which tells each fault by its place
            if not results.time.size:
                raise InputError.at(path, messages.NO_ROW()) from None
            raise InputError.at(path, messages.UNREADABLE(reason=str(error).partition("\n")[0])) from None
        (draft / ABOUT).write_text(json.dumps({"key": _key(status, units, text), **about}), encoding="utf-8")
        shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):  # Another command was faster.
            draft.rename(place)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return about


def _columns_of(path: Path, units: Mapping[str, str], text: Sequence[str]) -> tuple[list[tuple[str, str]], Batches]:
    """Return names and units of the numeric columns, time first, and their values."""
    source = source_of(path)
    if source is CSV:
        return _csv_columns(path, units, text)
    if source is PARQUET:
        return _parquet_columns(path, units, text)
    results = read_results(path, units, text)
    heads = [(TIME, "s"), *((name, results.units.get(name, "")) for name in results.columns)]
    return heads, iter([([results.time, *results.values.T], path.stat().st_size)])


def _csv_columns(path: Path, units: Mapping[str, str], text: Sequence[str]) -> tuple[list[tuple[str, str]], Batches]:
    from pyarrow import csv, float64, types

    heads, line = read_heading(path, units)
    reading = csv.ReadOptions(block_size=BLOCK, skip_rows=line, column_names=[str(k) for k in range(len(heads))])
    with csv.open_csv(path, read_options=reading) as first:
        kinds = first.schema.types
    numbers = [types.is_floating(kind) or types.is_integer(kind) or types.is_null(kind) for kind in kinds]
    chosen = _choose([(*head, number) for head, number in zip(heads, numbers, strict=True)], text)
    names = [str(k) for k in chosen]
    converting = csv.ConvertOptions(column_types=dict.fromkeys(names, float64()), include_columns=names)

    def batches() -> Batches:
        size, done = path.stat().st_size, 0
        with csv.open_csv(path, read_options=reading, convert_options=converting) as reader:
            for batch in reader:
                done = min(size, done + BLOCK)
                yield [column.to_numpy(zero_copy_only=False) for column in batch.columns], done

    return [heads[k] for k in chosen], batches()


def _parquet_columns(
    path: Path, units: Mapping[str, str], text: Sequence[str]
) -> tuple[list[tuple[str, str]], Batches]:
    from pyarrow import parquet, types

    file = parquet.ParquetFile(path)
    columns = []
    for field in file.schema_arrow:
        unit = (field.metadata or {}).get(UNIT)
        head = split_heading(field.name, units) if unit is None else (field.name, unit.decode())
        columns.append((*head, types.is_floating(field.type) or types.is_integer(field.type)))
    chosen = _choose(columns, text)

    def batches() -> Batches:
        size, rows, done = path.stat().st_size, max(1, file.metadata.num_rows), 0
        with file:
            for batch in file.iter_batches(MOST_GROUP):
                done += batch.num_rows
                arrays = [batch.column(k).cast("float64", safe=False) for k in chosen]
                yield [a.to_numpy(zero_copy_only=False) for a in arrays], size * done // rows

    return [columns[k][:2] for k in chosen], batches()


def _choose(columns: Sequence[tuple[str, str, bool]], text: Sequence[str]) -> list[int]:
    """Return the places of time and of all numeric columns, each name once."""
    if not columns or not is_time(columns[0][0]) or not columns[0][2]:
        raise ValueError("the first column is no time")
    firsts: dict[str, int] = {}
    for place, (name, _, is_number) in enumerate(columns[1:], 1):
        if is_number and name != TIME and name not in text:
            firsts.setdefault(name, place)
    return [0, *firsts.values()]


def _further_levels(seconds: Sequence[tuple[Array, Array]], sizes: Sequence[int]) -> list[tuple[Array, Array]]:
    """Return the extremes of the second level and of those above; none for few rows."""
    if len(sizes) < 3:
        return []
    low, high = (np.concatenate(sides, axis=1) for sides in zip(*seconds, strict=True))
    return [(low, high), *make_levels(low, high, sizes[2:])]


def _write(draft: Path, heads: list[tuple[str, str]], batches: Batches, path: Path, progress: Progress) -> Any:
    """Write rows and extremes; return the description of a cache."""
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
    return {"units": units, "rows": rows, "group": group, "span": ends}


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
