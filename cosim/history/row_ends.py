"""Rows of a run that end before its record says, judged by the last bytes of their file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

LAST_BYTES = 2**16  # read first from the end of a table
LONGEST_ROW = 2**22  # bytes
ROUNDING = 1e-9  # share of the end time
ENDS = {".parquet": b"PAR1", ".mcap": b"\x89MCAP0\r\n"}  # last bytes of a complete file


def is_cut(rows: Path, record: Mapping[str, Any]) -> bool:
    """Return whether rows end before the end of their run.

    A table of text is cut if its last line has no end, if a short one has fewer rows, or if the last time of a long one
    is before that of the last row of the run. HDF5 and MAT files are not examined.
    """
    count = record.get("rows")
    if not count:
        return False
    with suppress(OSError, ValueError):
        if (end := ENDS.get(rows.suffix)) is not None:
            return not _last_bytes(rows, len(end)).endswith(end)
        if rows.suffix == ".csv" and type(count) is int:
            return _is_cut_text(rows, record, count)
    return False


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
