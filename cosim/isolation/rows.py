"""Rows and progress of a run, in memory or in memory-mapped files that two processes share."""

from __future__ import annotations

import ctypes
import errno
import json
import mmap
import os
import sys
import weakref
from array import array
from collections.abc import Callable, MutableSequence, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array

# Current call: number of the component times CALLS, plus PUT, ADVANCE or GET of `cosim.blocks.component`, or OTHER.
CALLS = 4
OTHER = 3
NO_CALL = -1  # no call yet
WAITING = NO_CALL - CALLS  # for the clock, or for the end of a pause; like NO_CALL, no call
FILL_BYTES = 1 << 20  # bytes per write on disks that cannot reserve space
POPULATE_WRITE, AHEAD = 23, 2**26  # MADV_POPULATE_WRITE of Linux, and bytes of a table to map beforehand


class ExactFile:
    """A file of values that doubles cannot represent: one JSON line per row, readable after a crash."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("ab", buffering=0)

    def append(self, row: tuple[Any, ...]) -> None:
        """Append the values of a row; raise OSError on a full disk."""
        content = exact_line(row)
        if self._stream.write(content) < len(content):
            raise OSError(errno.ENOSPC, "no room for the exact values of a row")

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def read_exact(path: Path, rows: int) -> list[tuple[Any, ...]]:
    """Return the values of the first complete rows; rows without a line have the values of the last line."""
    values: list[tuple[Any, ...]] = []
    with suppress(FileNotFoundError), path.open("rb") as stream:
        for line in stream:
            if len(values) == rows:
                break
            with suppress(ValueError):  # the line is incomplete, or an FMU has written it
                if isinstance(row := json.loads(line), list):
                    values.append(tuple(bytes.fromhex(v["hex"]) if isinstance(v, dict) else v for v in row))
    return values + values[-1:] * (rows - len(values))


def exact_line(row: Sequence[Any]) -> bytes:
    """Return exact values as a line of JSON."""
    return json.dumps([{"hex": v.hex()} if isinstance(v, bytes) else v for v in row]).encode() + b"\n"


@dataclass(frozen=True)
class Rows:
    """Rows of a run while it is recorded, and the progress of the run.

    Attributes:
        beside: Values that doubles cannot represent, such as text and 64-bit integers: a list of rows or an
            `ExactFile`. They are stored before `made` counts their row.
        made: [number of complete rows], updated after each row.
        doing: [current call], updated before each call.
        tell_loop: Function that is called with the kind of loop (C or Python) before the loop starts.
        asked: [True if the loop must call `keeper.look` after the current step].
        keeper: Object that writes checkpoints of the run, if any.
        given: Number of rows from a stopped run that is resumed.
    """

    table: Array
    beside: Any = field(default_factory=list[tuple[Any, ...]])
    made: MutableSequence[int] = field(default_factory=lambda: array("q", [0]))
    doing: MutableSequence[int] = field(default_factory=lambda: array("q", [NO_CALL]))
    tell_loop: Callable[[str], None] = lambda loop: None
    asked: MutableSequence[int] = field(default_factory=lambda: array("q", [0]))
    keeper: Any = None
    given: int = 0

    @classmethod
    def in_memory(cls, rows: int, columns: int) -> Rows:
        """Return rows in the memory of this process."""
        return cls(np.zeros((rows, columns)))


def allocate(path: Path, size: int) -> None:
    """Create a file of zeros whose disk space is reserved.

    A full disk raises OSError here; otherwise writing to a mapped page would crash later.
    """
    with path.open("wb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, max(1, size))
            return
        for first in range(0, size, FILL_BYTES):
            stream.write(bytes(min(FILL_BYTES, size - first)))


def mapped_table(path: Path, rows: int, columns: int) -> Array:
    """Return the table in an allocated file as a mapped array."""
    if not rows * columns:
        return np.zeros((rows, columns))
    mapped = _map(path, 8 * rows * columns)
    if isinstance(mapped, ctypes.Array):  # otherwise each page would cause a page fault during stepping
        _libc().madvise(mapped, ctypes.c_size_t(min(len(mapped), AHEAD)), POPULATE_WRITE)
    return np.frombuffer(mapped, np.float64).reshape(rows, columns)


def _map(path: Path, size: int) -> Any:
    """Return a memory-mapped file as a buffer; on Linux without an open descriptor to which an FMU could write."""
    with path.open("r+b") as stream:
        if sys.platform != "linux":
            return mmap.mmap(stream.fileno(), size)
        libc = _libc()
        protection = mmap.PROT_READ | mmap.PROT_WRITE
        address = libc.mmap(None, size, protection, mmap.MAP_SHARED, stream.fileno(), 0)
    if address == ctypes.c_void_p(-1).value:
        raise OSError(ctypes.get_errno(), f"cannot map {path}")
    buffer = (ctypes.c_char * size).from_address(address)
    weakref.finalize(buffer, libc.munmap, ctypes.c_void_p(address), ctypes.c_size_t(size)).atexit = False
    return buffer


@cache
def _libc() -> Any:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
    return libc


def read_table(path: Path, rows: int, columns: int, *, mapped: bool = False) -> Array:
    """Return the first rows of a table file as an array in memory, or mapped, which requires the file."""
    if not rows * columns:
        return np.zeros((rows, columns))
    if mapped:
        return np.memmap(path, np.float64, "r", shape=(rows, columns))
    return np.fromfile(path, np.float64, rows * columns).reshape(rows, columns)


class Progress(ctypes.Structure):
    """Progress of a run, in memory that the running process and its observer share.

    Attributes:
        made: As in `Rows`; likewise `doing`.
        named: True if `call` is the current FMI function.
        stop: True if the observer requests an early end.
        hold: True if the observer requests a pause.
        sent: Number of changes that the observer has sent.
        asked: As in `Rows`.
        ending: True if the caller requests a checkpoint and an immediate end.
        words: Last message of an FMU.
        loop: Kind of stepping loop.
    """

    _fields_ = (
        ("made", ctypes.c_int64 * 1),
        ("doing", ctypes.c_int64 * 1),
        ("named", ctypes.c_int64 * 1),
        ("stop", ctypes.c_int64 * 1),
        ("hold", ctypes.c_int64 * 1),
        ("sent", ctypes.c_int64 * 1),
        ("asked", ctypes.c_int64 * 1),
        ("ending", ctypes.c_int64 * 1),
        ("call", ctypes.c_char * 128),
        ("words", ctypes.c_char * 512),
        ("loop", ctypes.c_char * 256),
    )


def mapped_progress(path: Path) -> Progress:
    """Return the progress in a file, which is created if it is missing."""
    if not path.exists():
        path.write_bytes(bytes(ctypes.sizeof(Progress)))
    return Progress.from_buffer(_map(path, ctypes.sizeof(Progress)))
