"""Rows of a run that end before its record says, judged by the last bytes of their file."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

LAST_BYTES = 2**16  # read first from the end of a table
LONGEST_ROW = 2**22  # bytes
ROUNDING = 1e-9  # share of the end time
MAT_HEAD, COMPRESSED = 128, 15  # bytes before the first variable; kind of a compressed variable, which is not padded
ENDS = {".parquet": b"PAR1", ".mcap": b"\x89MCAP0\r\n"}  # last bytes of a complete file


def is_cut(rows: Path, record: Mapping[str, Any]) -> bool:
    """Return whether rows end before their run did.

    A table of text is cut if its last line has no end, if a short one has fewer rows, or if the last time of a long one
    is before that of the last row of the run. HDF5 and MAT files are cut if they end before the place that they name.
    """
    count = record.get("rows")
    if not count:
        return False
    with suppress(OSError, ValueError, struct.error):
        if (has_end := BY_LENGTH.get(rows.suffix)) is not None:
            return not has_end(rows)
        if (end := ENDS.get(rows.suffix)) is not None:
            return not _last_bytes(rows, len(end)).endswith(end)
        if rows.suffix == ".csv" and type(count) is int:
            return _is_cut_text(rows, record, count)
    return False


def _has_end_of_hdf5(path: Path) -> bool:
    """Return whether a file has its superblock's length."""
    with path.open("rb") as stream:
        head = stream.read(64)
    version = head[8] if len(head) > 8 else 0
    if len(head) < 64:
        return False
    place, size = (24, head[13]) if version < 2 else (12, head[9])
    if version == 1:
        place += 4
    if size != 8:  # bytes of an address; written by no known tool
        return True
    base, _, end = struct.unpack_from("<QQQ", head, place)
    return path.stat().st_size >= int(base) + int(end)


def _has_end_of_mat(path: Path) -> bool:
    """Return whether a file ends with a variable."""
    size, place = path.stat().st_size, MAT_HEAD
    with path.open("rb") as stream:
        order = "<" if stream.read(MAT_HEAD).endswith(b"IM") else ">"
        while place + 8 <= size:
            stream.seek(place)
            kind, length = struct.unpack(f"{order}II", stream.read(8))
            place += 8 + length + (-length % 8) * (kind != COMPRESSED)
    return place == size


BY_LENGTH = {".h5": _has_end_of_hdf5, ".hdf5": _has_end_of_hdf5, ".mat": _has_end_of_mat}


def _last_bytes(path: Path, count: int) -> bytes:
    with path.open("rb", buffering=0) as stream:
        stream.seek(-min(count, os.fstat(stream.fileno()).st_size), os.SEEK_END)
        return stream.readall()


def _is_cut_text(path: Path, record: Mapping[str, Any], count: int) -> bool:
    """Return whether a table of text ends before its last row; raise ValueError if its end cannot be read."""
    length = LAST_BYTES
    while length <= LONGEST_ROW:
        text = _last_bytes(path, length)
        if not text.endswith(b"\n"):
            return True
        if len(text) < length:
            return text.count(b"\n") <= count  # with the header; a text in a cell may have further lines
        _, end, line = text[:-1].rpartition(b"\n")
        if end:
            expected = _time_of_last_row(record, count)
            return expected is not None and float(line.partition(b",")[0]) < expected
        length *= 8
    raise ValueError("the last row is too long")


def _time_of_last_row(record: Mapping[str, Any], count: int) -> float | None:
    """Return a time [s] before which the last of `count` rows cannot be, if the record says enough."""
    scenario: Mapping[str, Any] = record.get("scenario") or {}
    start, duration, step = (_number(scenario.get(key, 0.0)) for key in ("start_time", "duration", "step"))
    recorded = scenario.get("record")
    every = _number(recorded.get("every")) if isinstance(recorded, dict) else None
    if start is None or duration is None:
        return None
    end = start + duration
    if step is None:  # controlled steps
        return end - ROUNDING * abs(end) if record.get("status") == "ok" else None
    last = start + (count - 1) * (every or step)
    if every and last < end:  # The last row of a run is recorded even between two times of `every`.
        return last - every
    return min(end, last) - step / 2


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) else None
