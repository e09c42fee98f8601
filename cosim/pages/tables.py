"""Rows of tables: small ones in memory, large ones converted once into files of the cache.

The folder `view/HASH` in the user's cache contains rows, texts.arrow and about.json. HASH depends on file, size and
time of the table.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from hashlib import sha256
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
from cosim.files.cache import cache_folder
from cosim.files.csv_source import CSV, read_heading
from cosim.files.files import scratch_folder
from cosim.files.folders import content_of
from cosim.files.formats import PARQUET, heading_of
from cosim.files.results import INTEGER, Results, is_rounded, read_results
from cosim.files.table import is_time, source_of
from cosim.pages.rows import TIME, Recording, Store

FOLDER, ABOUT, TEXTS, VERSION = "view", "about.json", "texts.arrow", 6
UNUSED = 30 * 86_400.0  # age [s] above which a conversion is removed
DRAFT = "draft-"  # prefix of an unfinished conversion
SMALL = 4_000_000  # largest table that is read as a whole [bytes]
ROWS = 1 << 16  # values of a Parquet file read at a time
BLOCK = 1 << 24  # of text read at a time [bytes]
WHOLE = f"^({INTEGER.pattern})$"
Progress = Callable[[int, int], None] | None


@dataclass(frozen=True)
class ColumnTypes:
    """Known properties of the columns of a table.

    Attributes:
        units: Units of columns without unit in the header.
        names: Column → name of its signal, or `time`, for columns to rename.
        text: Columns of text or of large integers, even with numeric content.
        words: Columns of `text` that are not integers, even if their cells look like integers.
    """

    units: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    text: Sequence[str] = ()
    words: frozenset[str] = frozenset()

    def read(self, path: Path) -> Results:
        """Return the rows of a table in memory; raise InputError without rows."""
        results = read_results(path, self.units, self.text, words=self.words, names=self.names)
        if not results.time.size:
            raise InputError.at(path, "has no rows yet; wait for the end of the run, or run it again")
        return results


def open_rows(path: Path, columns: ColumnTypes, progress: Progress = None) -> Recording:
    """Return the rows of a table; convert a large one first, unless it is converted already.

    Args:
        columns: Known properties of the columns.
        progress: Function of (converted size, total size) [bytes].

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
        recording.assumed = results.notes
        recording.inexact = [name for name in results.columns if name in results.whole and is_rounded(results[name])]
        return recording
    place = cache_folder() / FOLDER / _key(path, status, columns)
    if content_of(place / ABOUT):
        os.utime(place)
    else:
        place.parent.mkdir(mode=0o700, exist_ok=True)
        for each in place.parent.iterdir():  # conversions not used for a long time
            with suppress(OSError):
                if not each.name.startswith(DRAFT) and time.time() - each.stat().st_mtime > UNUSED:
                    shutil.rmtree(each)
        with scratch_folder(place.parent, DRAFT) as folder:
            draft = folder / place.name
            draft.mkdir()
            try:
                written = _convert(path, draft, columns, progress)
            except (pa.ArrowException, OSError, ValueError) as error:
                if is_full(error):
                    raise
                columns.read(path)  # this reading reports each fault with its place
                raise InputError.at(path, f"cannot be read: {str(error).partition(chr(10))[0]}") from None
            (draft / ABOUT).write_text(json.dumps(written), encoding="utf-8")
            if _key(path, path.stat(), columns) != place.name:  # the file has changed since the key was computed
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
    """Return a key of the content of a file and of its types; a renamed file keeps its key."""
    types = [sorted(columns.units.items()), sorted(columns.names.items()), sorted(columns.text), sorted(columns.words)]
    content = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    return sha256(json.dumps([VERSION, path.suffix, content, types]).encode()).hexdigest()


# -- conversion -------------------------------------------------------------------------------------------

Heads = list[tuple[str, str]]  # name and unit of each column
Read = Callable[[list[int]], Iterator[tuple[Any, int]]]  # columns of text → batches, and share of the file read so far


def _convert(path: Path, draft: Path, columns: ColumnTypes, progress: Progress) -> dict[str, Any]:
    """Write rows and texts of a table; return the description for the cache."""
    found, kinds, read = _opened(path, columns)
    heads = [(printable(name), printable(unit)) for name, unit in found]
    if not heads or not is_time(heads[0][0]) or not _is_number(kinds[0]):
        raise ValueError("the first column is not time")
    firsts: dict[str, int] = {}
    for place, (name, _) in enumerate(heads[1:], 1):
        firsts.setdefault(name, place)
    firsts.pop(TIME, None)
    texts = [k for name, k in firsts.items() if not _is_number(kinds[k]) or name in columns.text]
    numbers = [0, *(k for k in firsts.values() if k not in texts)]
    # Texts that are integers are also stored as numbers, unless they are declared as words or one of them is not an
    # integer.
    tried = [k for k in texts if heads[k][0] not in columns.words]
    whole, inexact, rounded = {*tried}, set[int](), set[int]()
    store = Store(draft, dict(heads[k] for k in (*numbers[1:], *tried)))
    scale, last = factor(heads[0][1], "s") or 1.0, -np.inf
    schema, size = pa.schema([pa.field(str(k), pa.string()) for k in texts]), path.stat().st_size
    with pa.OSFile(str(draft / TEXTS), "wb") as file, pa.ipc.new_file(file, schema) as kept:
        for batch, done in read(texts):
            values = [batch.column(k).cast("float64", safe=False).to_numpy(zero_copy_only=False) for k in numbers]
            strings = {k: _strings(batch.column(k)) for k in texts}
            values[0] = time_ = values[0] * scale
            if not (np.isfinite(time_).all() and np.all(np.diff(time_, prepend=last) >= 0.0)):
                raise ValueError("a time is missing or decreases")
            last = float(time_[-1]) if time_.size else last
            inexact |= {k for k, v in zip(numbers, values, strict=True) if _is_whole(kinds[k]) and is_rounded(v)}
            for k in tried:
                values.append(np.full(time_.size, np.nan))
                if k in whole and compute.all(compute.match_substring_regex(strings[k], WHOLE), min_count=0).as_py():
                    values[-1] = strings[k].cast("float64").to_numpy(zero_copy_only=False)
                    rounded |= {k} if is_rounded(values[-1]) else set()
                else:
                    whole.discard(k)
            if texts:
                kept.write_batch(pa.RecordBatch.from_arrays([*strings.values()], schema=schema))
            store.append(np.array(values))
            if progress is not None:
                progress(min(done, size), size)
    if not store.rows:
        raise ValueError("the table has no rows")
    return {
        "units": store.units,
        "hidden": [heads[k][0] for k in tried if k not in whole],
        "rows": store.rows,
        "texts": [heads[k][0] for k in texts],
        "rounded": [heads[k][0] for k in sorted(rounded & whole)],
        "inexact": [heads[k][0] for k in sorted(inexact)],
    }


def _is_whole(kind: Any) -> bool:
    return bool(pa.types.is_integer(kind))


def _is_number(kind: Any) -> bool:
    types = pa.types
    return _is_whole(kind) or any(test(kind) for test in (types.is_floating, types.is_boolean, types.is_null))


def _strings(column: Any) -> Any:
    """Return a column as strings, binary data as hexadecimal digits."""
    if "binary" in str(column.type):
        return pa.array([(value or b"").hex() for value in column.to_pylist()], pa.string())
    return column.cast("string")


def _opened(path: Path, columns: ColumnTypes) -> tuple[Heads, list[Any], Read]:
    """Return the columns of a table, their pyarrow types, and a function that reads them."""
    source, size, heads, line = source_of(path), path.stat().st_size, list[tuple[str, str]](), 0
    with suppress(ValueError):  # a file of another tool, e.g. with semicolons
        heads, line = read_heading(path, columns.units) if source is CSV and not columns.names else (heads, line)
    if heads and is_time(heads[0][0]):
        reading = csv.ReadOptions(block_size=BLOCK, skip_rows=line, column_names=[str(k) for k in range(len(heads))])
        with csv.open_csv(path, read_options=reading) as first:
            kinds = [pa.string() if pa.types.is_boolean(kind) else kind for kind in first.schema.types]

        def read_csv(texts: list[int]) -> Iterator[tuple[Any, int]]:
            are_numbers = [k not in texts and _is_number(kind) for k, kind in enumerate(kinds)]
            types = {str(k): pa.float64() if is_number else pa.string() for k, is_number in enumerate(are_numbers)}
            converting = csv.ConvertOptions(column_types=types)
            with csv.open_csv(path, read_options=reading, convert_options=converting) as reader:
                yield from ((batch, number * BLOCK) for number, batch in enumerate(reader, 1))

        return heads, kinds, read_csv
    if source is PARQUET and not columns.names:
        schema = parquet.read_schema(path)
        heads = [heading_of(column, columns.units) for column in schema]
        kinds = [kind.value_type if pa.types.is_dictionary(kind) else kind for kind in schema.types]

        def read_parquet(texts: list[int]) -> Iterator[tuple[Any, int]]:
            with parquet.ParquetFile(path) as file:
                done, count = 0, max(1, file.metadata.num_rows)
                for batch in file.iter_batches(ROWS):
                    done += batch.num_rows
                    yield batch, size * done // count

        return heads, kinds, read_parquet
    results = columns.read(path)
    values = {name: pa.array(results[name]) for name in results.columns}
    values |= {name: pa.array(each, pa.string()) for name, each in results.texts().items()}
    kinds = [pa.int64() if name in results.whole else each.type for name, each in values.items()]
    whole = pa.RecordBatch.from_arrays([pa.array(results.time), *values.values()], [TIME, *values])
    heads = [(TIME, "s"), *((name, results.units.get(name, "")) for name in values)]
    return heads, [pa.float64(), *kinds], lambda texts: iter([(whole, size)])
