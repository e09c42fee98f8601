"""Rows of a run, extremes of their blocks, and the points needed to draw a signal.

Small tables are kept in memory. Large ones are converted once into the folder `view/HASH` in the user's cache, with
rows, texts.arrow and about.json; HASH depends on file, size and time of the table.
"""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pyarrow import feather

from cosim.core.arrays import Array, Rows
from cosim.core.errors import InputError
from cosim.core.messages import printable
from cosim.files.cache import cache_folder
from cosim.files.files import scratch_folder
from cosim.files.folders import content_of
from cosim.files.results import read_results

BLOCK_ROWS = 16  # rows of a block
MIN_BLOCKS_PER_PIXEL = 4  # blocks per pixel column, so that an edge is wrong by at most a quarter of a column
MAX_ROWS_PER_PIXEL = 2  # rows per pixel column up to which rows are drawn unchanged
FIRST_CAPACITY_ROWS = 4096  # rows for which a growing recording has room at first
TIME_COLUMN = "time"


def finite(values: Array) -> Array:
    """Return values with NaN for infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


@dataclass(frozen=True)
class Picture:
    """Rows or blocks of a time range, and their pixel columns.

    If there are few rows, all are used. Otherwise each pixel column has the extremes of all its rows, for any spacing
    of their times. One row beyond each end is included.

    Attributes:
        blocks, rows: Indices of the blocks, and of the rows outside these blocks.
        time: Times of the points [s].
        order: Order of the blocks and rows by time.
        starts: Index in `order` of the first block or row of each point; None if each point is one row.
    """

    recording: Recording
    blocks: Rows
    rows: Rows | slice
    time: Array
    order: Rows | slice
    starts: Rows | None

    def points(self, name: str) -> tuple[Array, Array]:
        """Return the smallest and largest value of each point of a signal; NaN without a finite value."""
        values = finite(self.recording.column(name)[self.rows])
        if self.starts is None:
            return values, values
        ends = self.recording.extremes(name) if self.blocks.size else (values, values)
        low, high = (np.append(end[self.blocks], values)[self.order] for end in ends)
        return np.fmin.reduceat(low, self.starts), np.fmax.reduceat(high, self.starts)


class Recording:
    """Time and signals of a run; it may grow, and several threads may use it.

    Attributes:
        units: Signal → unit, "" without unit, in the order of the file.
        rows: Number of rows.
        texts: Signals that doubles cannot represent, with all values as text; large integers also have a numeric
            column.
        assumed: Assumptions made when the table was read, as sentences.
    """

    def __init__(
        self,
        columns: Mapping[str, Array],
        units: Mapping[str, str],
        texts: Mapping[str, Sequence[Any]] = MappingProxyType({}),
    ) -> None:
        self.units, self.texts = dict(units), texts
        self.assumed: Sequence[str] = ()
        self._columns = {TIME_COLUMN: np.zeros(0), **columns}
        self.rows = self._columns[TIME_COLUMN].size
        self._table = np.empty((1 + len(units), 0))  # of a growing recording, with room for further rows
        self._extremes: dict[str, tuple[int, Array, Array]] = {}  # column → covered rows, extremes of their blocks
        self._lock = threading.RLock()

    def append(self, values: Array) -> None:
        """Add rows to a recording that began without any, shape (columns, rows), time first."""
        with self._lock:
            before, rows = self.rows, self.rows + values.shape[1]
            if rows > self._table.shape[1]:
                table = np.empty((len(values), max(FIRST_CAPACITY_ROWS, 2 * rows)))
                table[:, :before] = self._table[:, :before]
                self._table = table
            self._table[:, before:rows] = values
            self._columns |= dict(zip((TIME_COLUMN, *self.units), self._table[:, :rows], strict=True))
            self.rows = rows

    def column(self, name: str) -> Array:
        """Return all rows of a column."""
        with self._lock:
            return self._columns[name]

    def read(self, name: str, begin: int = 0, end: int | None = None) -> Array:
        """Return the rows `begin` to `end` (exclusive) of a column."""
        return self.column(name)[begin:end]

    def exact(self, name: str, begin: int, end: int) -> Array | list[str]:
        """Return the rows `begin` to `end` (exclusive) of a column, as text if doubles cannot represent them."""
        return [*map(str, self.texts[name][begin:end])] if name in self.texts else self.read(name, begin, end)

    def locate(self, time: float, side: Literal["left", "right"] = "left") -> int:
        """Return the number of rows before a time [s]; with `right`, rows at the time are included."""
        return int(np.searchsorted(self.column(TIME_COLUMN), time, side))

    def span(self) -> tuple[float, float]:
        """Return the first and the last time [s], zeros without rows."""
        time = self.column(TIME_COLUMN) if self.rows else np.zeros(1)
        return float(time[0]), float(time[-1])

    def extremes(self, name: str) -> tuple[Array, Array]:
        """Return the smallest and largest finite value of each block of rows."""
        with self._lock:
            values = self.column(name)
            covered, low, high = self._extremes.get(name, (0, np.empty(0), np.empty(0)))
            if covered != values.size:  # the last block may be incomplete
                begin = covered // BLOCK_ROWS
                rest = np.append(finite(values[begin * BLOCK_ROWS :]), np.full(-values.size % BLOCK_ROWS, np.nan))
                low = np.append(low[:begin], np.fmin.reduce(rest.reshape(-1, BLOCK_ROWS), axis=1))
                high = np.append(high[:begin], np.fmax.reduce(rest.reshape(-1, BLOCK_ROWS), axis=1))
                self._extremes[name] = values.size, low, high
            return low, high

    def picture(self, begin: float, end: float, width: int) -> Picture:
        """Return the rows and blocks to draw for a time range [s] with `width` pixel columns."""
        first, stop = max(0, self.locate(begin) - 1), min(self.rows, self.locate(end, "right") + 1)
        blocks, time, pixel = np.arange(0), self.column(TIME_COLUMN), (end - begin) / width
        if stop - first <= MAX_ROWS_PER_PIXEL * width:
            return Picture(self, blocks, slice(first, stop), time[first:stop], slice(None), None)
        rows = np.arange(first, stop)
        if rows.size >= MIN_BLOCKS_PER_PIXEL * BLOCK_ROWS * width:  # blocks that are not wider than a pixel
            blocks = np.arange(first // BLOCK_ROWS, -(-stop // BLOCK_ROWS))
            is_wide = time[np.minimum((blocks + 1) * BLOCK_ROWS, time.size) - 1] - time[blocks * BLOCK_ROWS] > pixel
            rows = (blocks[is_wide, None] * BLOCK_ROWS + np.arange(BLOCK_ROWS)).ravel()
            blocks, rows = blocks[~is_wide], rows[rows < time.size]
        since = np.append(time[blocks * BLOCK_ROWS], time[rows])
        until = np.append(time[np.minimum((blocks + 1) * BLOCK_ROWS, time.size) - 1], time[rows])
        order = np.argsort(since, kind="stable")
        since, until = since[order], until[order]
        starts = np.flatnonzero(np.diff(np.clip(np.floor((since - begin) / pixel), -1, width), prepend=-2.0))
        middle = (since[starts] + until[np.append(starts[1:], since.size) - 1]) / 2
        return Picture(self, blocks, rows, middle, order, starts)


VIEW_FOLDER, VIEW_VERSION = "view", 8
VIEW_ROWS_FILE, VIEW_ABOUT_FILE, VIEW_TEXTS_FILE = "rows", "about.json", "texts.arrow"
UNUSED_AGE_S = 30 * 86_400.0  # age [s] above which a conversion is removed
DRAFT = "draft-"  # prefix of an unfinished conversion
MAX_MEMORY_BYTES = 4_000_000  # largest table that is kept in memory [bytes]


def open_rows(path: Path, **about: Any) -> Recording:
    """Return the rows of a table; convert a large one first, unless it is converted already.

    Args:
        about: What is known about its columns, as arguments of `read_results`.

    Raises:
        InputError: The table has faults, or no rows.
    """
    status = path.stat() if path.is_file() else None
    if status is None or status.st_size <= MAX_MEMORY_BYTES:
        return _read(path, about)
    content = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns  # a renamed file keeps its conversion
    types = json.dumps([VIEW_VERSION, path.suffix, content, about], sort_keys=True, default=sorted)
    place = cache_folder() / VIEW_FOLDER / sha256(types.encode()).hexdigest()
    if content_of(place / VIEW_ABOUT_FILE):
        os.utime(place)
    else:
        place.parent.mkdir(mode=0o700, exist_ok=True)
        for each in place.parent.iterdir():  # conversions not used for a long time
            with suppress(OSError):
                if not each.name.startswith(DRAFT) and time.time() - each.stat().st_mtime > UNUSED_AGE_S:
                    shutil.rmtree(each)
        with scratch_folder(place.parent, DRAFT) as folder:
            draft, made = folder / place.name, _read(path, about)
            draft.mkdir()
            with (draft / VIEW_ROWS_FILE).open("wb") as stream:
                for name in (TIME_COLUMN, *made.units):
                    stream.write(made.column(name).tobytes())
            columns = [pa.array(values, pa.string()) for values in made.texts.values()]
            if columns:
                table = pa.table(columns, [*map(str, range(len(columns)))])
                feather.write_feather(table, draft / VIEW_TEXTS_FILE, compression="uncompressed")
            record = {"units": made.units, "texts": [*made.texts], "assumed": made.assumed}
            (draft / VIEW_ABOUT_FILE).write_text(json.dumps(record), encoding="utf-8")
            shutil.rmtree(place, ignore_errors=True)
            with suppress(OSError):  # Another command was faster.
                draft.rename(place)
    known: Any = content_of(place / VIEW_ABOUT_FILE)
    if not known:  # the cache is not writable, or was cleared
        return _read(path, about)
    names = [TIME_COLUMN, *known["units"]]
    numbers: Any = np.memmap(place / VIEW_ROWS_FILE, np.float64, "r").reshape(len(names), -1).view(np.ndarray)
    texts = feather.read_table(place / VIEW_TEXTS_FILE, memory_map=True) if known["texts"] else None
    strings = {name: texts.column(k) for k, name in enumerate(known["texts"])} if texts is not None else {}
    recording = Recording(dict(zip(names, numbers, strict=True)), known["units"], strings)
    recording.assumed = known["assumed"]
    return recording


def _read(path: Path, about: dict[str, Any]) -> Recording:
    results = read_results(path, **about)
    if not results.time.size:
        raise InputError.at(path, "has no rows yet; wait for the end of the run, or run it again")
    shown = results.with_integers()
    columns = {TIME_COLUMN: shown.time, **{printable(name): shown[name] for name in shown.columns}}
    units = {printable(name): printable(shown.units.get(name, "")) for name in shown.columns}
    recording = Recording(columns, units, {printable(name): values for name, values in shown.texts().items()})
    recording.assumed = results.notes
    return recording
