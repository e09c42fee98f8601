"""Stepping loop in C (`stepping.c`) for systems of FMUs whose functions C can call: its structures, and its library.

A `Slot` is an FMU (function pointers and instance loaded by FMPy) or a source with values computed beforehand. A
`Transfer` copies a value within a row of doubles and applies links: factors, noise and injected faults. The caller
allocates all memory. A step gives the same bits as the same calls from Python.
"""

from __future__ import annotations

import ctypes
import os
from ctypes import c_void_p
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any

from cosim.blocks.component import Row
from cosim.fmi.fmi_types import Exchange, FmiType
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, load_library

SOURCE = Path(__file__).with_name("stepping.c")
NEVER = -1
IN_PYTHON = -1  # version of a slot whose component Python steps
C_TYPES = {
    **{name: getattr(ctypes, f"c_{name}") for name in ("double", "int32", "int64", "uint64", "bool")},
    "size": ctypes.c_size_t,
    "pointer": c_void_p,
}
C_TYPE_NAMES = ("double", "float", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "bool")
# as stepping.c numbers them
C_TYPE_NUMBERS = {getattr(ctypes, f"c_{name}"): number for number, name in enumerate(C_TYPE_NAMES)}
BITS64, TEXT_CELL = len(C_TYPE_NAMES), len(C_TYPE_NAMES) + 1  # of values that no double holds


class StopReason(IntEnum):
    """Reason for a return of the loop: its last step, or a need for Python.

    STATUS: a call returned a status other than OK; NOT_FINITE: an output is not finite; UNFIT: an input is outside its
    type; NO_ITEM: a value is not an item of the target's enumeration; TERMINATED: an FMU ended the simulation; PAUSED:
    the row of a point is complete but not stored; LATER: a second has passed, or Python has requested a return; ASKED:
    Python must step the current component.
    """

    FINISHED, STATUS, NOT_FINITE, UNFIT, NO_ITEM, TERMINATED, PAUSED, LATER, ASKED = range(9)


class LinkKind(IntEnum):
    """Effect of a link on a value v at point k; all but AFFINE, ADDED and ITEMS only from point `first` to `last`.

    v·a + b, v + values[k], v + a, v·a, a, v + a where marks[k], v of `count` − 1 points before, the last v where
    marks[k], v if it is among `values`
    """

    AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS = range(9)


def _fields(declaration: str) -> list[tuple[str, Any]]:
    """Return the fields of a structure from their declaration in the syntax of stepping.c."""
    declarations = (part.split(maxsplit=1) for part in declaration.split(";"))
    return [(name, C_TYPES[kind]) for kind, names in declarations for name in names.split(", ")]


class ConvertedLink(ctypes.Structure):
    """Effect of a connection on a value, for C; `keeping` references its buffers, so that they are not freed."""

    keeping: Any

    _fields_ = _fields("int32 kind; int64 first, last; double a, b; pointer values, marks, past; int64 count")


class Cell(ctypes.Structure):
    """A value that doubles cannot represent exactly: 64 bits, or a text that C copies."""

    _fields_ = _fields("int64 is_text; uint64 bits; pointer text")

    def value(self, kind: FmiType) -> Any:
        """Return the value as an object of an FMI type."""
        if self.is_text:
            return ctypes.string_at(self.text).decode("utf-8", "replace")
        return kind.ctype(self.bits).value

    def set(self, kind: FmiType, value: Any) -> None:
        """Set the value, of an FMI type, by the loop's library."""
        encoded = kind.encode(value)
        library().put_cell(ctypes.byref(self), encoded if self.is_text else ctypes.byref(ctypes.c_uint64(encoded)))


class Transfer(ctypes.Structure):
    """Copy of a value between two places of the row, every n-th point."""

    keeping: Any

    _fields_ = _fields("pointer origin, to; int64 every, links; pointer link, from_cell, to_cell")


class Move(ctypes.Structure):
    """Variables of one type that a single call sets or gets.

    `row` is the index of the first one in the row. The first `finite` values of a get must be finite.
    """

    _fields_ = _fields(
        "pointer function, references; size count, scalars; pointer values, row; double low, high; pointer cell; "
        "size finite; int32 type"
    )


class Slot(ctypes.Structure):
    """Data of one stepped component for the loop in C.

    `version` 2 or 3: an FMU of this FMI version; without `step`, only its outputs are read. `version` 0: a source with
    `scalars` precomputed values per point, from point `since` on. `version` IN_PYTHON: Python steps the component.
    """

    keeping: Any

    _fields_ = _fields(
        "int32 version; pointer step, instance; int64 every, doing, pulls, lates, puts, gets; "
        "pointer pull, late, put, get, prepared, row; size scalars; int64 since; double time, reached; "
        "pointer past, course; int64 phase, move, called, moving, batch; double begin, length, least; "
        "int32 status, why, timed; bool event, terminate, early, again, stepped"
    )


class Course(ctypes.Structure):
    """Polynomial through the last `points` values of extrapolated or interpolated inputs, the newest first."""

    keeping: Any

    _fields_ = _fields("int64 degree, inputs, points, room; pointer place, times, values")


class Plan(ctypes.Structure):
    """Complete state of the C loop."""

    _fields_ = _fields(
        "double begin, h, since, length; int64 slots, holds, width, next, last, pause; "
        "pointer slot, hold, row, table, counter, doing, asked; int64 place; pointer cells; "
        "int64 cell_count; bool changed; int64 threads; pointer pool"
    )


class NotCompiled(Exception):
    """The C loop is not available; the message says why."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def library() -> Any:
    """Return the compiled library of the loop; raise NotCompiled if it cannot be compiled."""
    try:
        loop = load_library(SOURCE.read_text(encoding="utf-8"))
        loop.run.argtypes, loop.run.restype = [ctypes.POINTER(Plan)], ctypes.c_int
        loop.step_once.argtypes, loop.step_once.restype = [ctypes.POINTER(Plan)], ctypes.c_int
        loop.put_cell.argtypes, loop.put_cell.restype = [ctypes.POINTER(Cell), c_void_p], None
        loop.finish.argtypes, loop.finish.restype = [ctypes.POINTER(Plan)], None
    except NoCompiler:
        raise NotCompiled("no C compiler") from None
    except (CompilerFailed, AttributeError) as error:  # AttributeError: the compiler produced a library without `run`
        raise NotCompiled(f"the C compiler fails: {' '.join(str(error).split())[:200]}") from None
    return loop


def move(function: Any, exchange: Exchange, row: Row, cells: ctypes.Array[Cell]) -> Move:
    """Return the C structure of a set or get call."""
    kind, start, cell = exchange.kind, exchange.places.start, None
    references, count, values, scalars = exchange.arguments
    pointer, finite = ctypes.cast(function, c_void_p), exchange.finite
    place, number = ctypes.addressof(row) + 8 * start, C_TYPE_NUMBERS.get(kind.ctype, BITS64)
    if kind.beside:
        place, cell, number = 0, ctypes.addressof(cells[start]), BITS64 if kind.is_whole else TEXT_CELL
    return Move(pointer, references, count, scalars, values, place, kind.low, kind.high, cell, finite, number)


def address_of(buffer: Any) -> int | None:
    """Return the memory address of a buffer; None for an empty buffer."""
    return None if not buffer else ctypes.addressof(ctypes.c_char.from_buffer(buffer))
