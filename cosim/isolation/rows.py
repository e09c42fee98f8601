"""Where a run writes its rows and how far it is: in memory, or mapped from files so that another process sees them."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import pickle
from array import array
from collections.abc import Callable, MutableSequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cosim.base.arrays import Array

# What is called of a component: its number times CALLS, plus one of these.
CALLS = 4
PUT, ADVANCE, GET, OTHER = range(CALLS)
NOTHING = -1  # is called yet
BLOCK = 1 << 20  # bytes written at a time where a disk cannot be asked for room
POPULATE_WRITE, AHEAD = 23, 2**26  # MADV_POPULATE_WRITE of Linux; bytes of a table whose pages are there beforehand


class Beside(Protocol):
    """What a list can do with what stands beside the rows."""

    def append(self, row: tuple[Any, ...], /) -> None:
        """Keep one more."""


class BesideFile:
    """What stands beside the rows, in a file: another process can read it where this one has ended."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("ab", buffering=0)

    def append(self, row: tuple[Any, ...]) -> None:
        """Keep one more; OSError where there is no room."""
        content = pickle.dumps(row)
        if self._stream.write(content) < len(content):
            raise OSError(errno.ENOSPC, "no room for what stands beside a row")

    def close(self) -> None:
        """No more is kept."""
        self._stream.close()


def read_beside(path: Path, rows: int) -> list[tuple[Any, ...]]:
    """The first rows of such a file, as many as there are whole."""
    kept: list[tuple[Any, ...]] = []
    if path.exists():
        with path.open("rb") as stream, suppress(EOFError, pickle.UnpicklingError):
            while len(kept) < rows:
                kept.append(pickle.load(stream))
    return kept


@dataclass(frozen=True)
class Rows:
    """A table to be filled, and how far it is.

    beside: one for each row, appended before it counts: what no double holds
    made:   [rows that are whole], written after the row
    doing:  [what is being called], written before the call
    tell_loop: told which loop steps, before it does
    """

    table: Array
    beside: Beside = field(default_factory=list[tuple[Any, ...]])
    made: MutableSequence[int] = field(default_factory=lambda: array("q", [0]))
    doing: MutableSequence[int] = field(default_factory=lambda: array("q", [NOTHING]))
    tell_loop: Callable[[str], None] = lambda loop: None

    @classmethod
    def in_memory(cls, rows: int, columns: int) -> Rows:
        """Of this process alone."""
        return cls(np.zeros((rows, columns)))


def allocate(path: Path, size: int) -> None:
    """Make a file of `size` zeros that the disk has room for, as writing to a page without is a crash; OSError."""
    with path.open("wb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, max(1, size))
            return
        for first in range(0, size, BLOCK):
            stream.write(bytes(min(BLOCK, size - first)))


def mapped_table(path: Path, rows: int, columns: int) -> Array:
    """The table in a file that `allocate` made."""
    if not rows * columns:
        return np.zeros((rows, columns))
    with path.open("r+b") as stream:
        mapped = mmap.mmap(stream.fileno(), 8 * rows * columns)
    with suppress(OSError, ValueError):  # of Linux alone; without, each page is a fault while the FMUs step
        mapped.madvise(POPULATE_WRITE, 0, min(len(mapped), AHEAD))
    return np.frombuffer(mapped, np.float64).reshape(rows, columns)


def read_table(path: Path, rows: int, columns: int) -> Array:
    """The first rows of such a table, in memory."""
    if not rows * columns:
        return np.zeros((rows, columns))
    return np.fromfile(path, np.float64, rows * columns).reshape(rows, columns)


class Progress(ctypes.Structure):
    """How far a process is, mapped by it and by the one that watches.

    made, doing: of the rows
    named:       whether `call` is the FMI function being called now
    stop:        whether the one that watches asks for an early end
    words:       the last that an FMU said
    loop:        which loop steps
    """

    _fields_ = (
        ("made", ctypes.c_int64 * 1),
        ("doing", ctypes.c_int64 * 1),
        ("named", ctypes.c_int64 * 1),
        ("stop", ctypes.c_int64 * 1),
        ("call", ctypes.c_char * 128),
        ("words", ctypes.c_char * 512),
        ("loop", ctypes.c_char * 256),
    )


def mapped_progress(path: Path) -> Progress:
    """The progress in a file; it is made where there is none."""
    if not path.exists():
        path.write_bytes(bytes(ctypes.sizeof(Progress)))
    with path.open("r+b") as stream:
        return Progress.from_buffer(mmap.mmap(stream.fileno(), ctypes.sizeof(Progress)))
