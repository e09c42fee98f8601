"""Stepping loop in C (`stepping.c`) for systems of FMUs whose functions C can call.

    loop = Loop(slots, holds, row, table, begin=0.0, h=0.02, counter=counter, doing=doing)
    while (reason := loop.run(last, pause)) != StopReason.FINISHED: …   # handle, then call again to continue

A `Slot` is an FMU (function pointers and instance loaded by FMPy) or values prepared for each point. A `Transfer` moves
a value within a row of doubles through `Link`s: factors, noise and injected faults, each a function of the point and of
previous values. The caller allocates everything. A step gives the same bytes as the same calls from Python.
"""

from __future__ import annotations

import ctypes
from array import array
from collections.abc import Callable, Sequence
from ctypes import c_void_p
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any

from cosim.blocks.component import Row
from cosim.core.arrays import Array
from cosim.fmi.fmi_types import Exchange
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, load_library

SOURCE = Path(__file__).with_name("stepping.c")
NEVER = -1
CALLED = 1  # version of a slot that a function of Python steps
CALL = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_double)
C_TYPES = {
    **{name: getattr(ctypes, f"c_{name}") for name in ("double", "int32", "int64", "bool")},
    "size": ctypes.c_size_t,
    "pointer": c_void_p,
}
NAMES = ("double", "float", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "bool")
TYPES = {getattr(ctypes, f"c_{name}"): number for number, name in enumerate(NAMES)}  # numbering of stepping.c


class StopReason(IntEnum):
    """Reason for a return of the loop: its last step, or a need for Python.

    STATUS: a call returned a status other than OK; NOT_FINITE: an output is not finite; UNFIT: an input does not fit
    its type; NO_ITEM: a value is no item of the target enumeration; TERMINATED: an FMU ended the simulation; PAUSED:
    the row of a point is complete but not stored; LATER: a second has passed, or Python is asked for; FAILED: a
    function of Python failed
    """

    FINISHED, STATUS, NOT_FINITE, UNFIT, NO_ITEM, TERMINATED, PAUSED, LATER, FAILED = range(9)


class LinkKind(IntEnum):
    """Effect of a link on a value v at point k; all but the first two and the last act only from `first` to `last`.

    v·a + b, v + values[k], v + a, v·a, a, v + a where marks[k], v of `count` − 1 points before, the last v where
    marks[k], v if it is among `values`
    """

    AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS = range(9)


def _fields(declaration: str) -> list[tuple[str, Any]]:
    """Return the fields of a structure from their declaration, written as in stepping.c."""
    declarations = (part.split(maxsplit=1) for part in declaration.split(";"))
    return [(name, C_TYPES[kind]) for kind, names in declarations for name in names.split(", ")]


class ConvertedLink(ctypes.Structure):
    """Conversion of a value in transit; `keeping` keeps its buffers alive."""

    keeping: Any

    _fields_ = _fields("int32 kind; int64 first, last; double a, b; pointer values, marks, past; int64 count")


class Transfer(ctypes.Structure):
    """Transfer between two places of the row, every so many points."""

    keeping: Any

    _fields_ = _fields("pointer origin, to; int64 every, links; pointer link")


class Move(ctypes.Structure):
    """Variables of a type, moved in a single call.

    `row` is their place in the row; after a get the first `finite` values must be finite.
    """

    _fields_ = _fields(
        "pointer function, references; size count, scalars; pointer values, row; double low, high; size finite; "
        "int32 type"
    )


class Slot(ctypes.Structure):
    """Data of one stepped component for the loop in C.

    The component is an FMU of FMI `version` 2 or 3. With version 0 it is a source with `scalars` values prepared for
    each point, beginning at point `since`. With version CALLED a function of Python steps it.

    Attributes:
        failures: Errors of this function.
    """

    keeping: Any
    failures: list[BaseException]

    _fields_ = _fields(
        "int32 version; pointer step, instance; int64 every, doing, pulls, lates, puts, gets; "
        "pointer pull, late, put, get, prepared, row; size scalars; int64 since; double time, reached; "
        "bool event, terminate, early"
    )


class Plan(ctypes.Structure):
    """Complete state of the C loop."""

    _fields_ = _fields(
        "double begin, h; int64 slots, holds, width, next, last, pause; "
        "pointer slot, hold, row, table, counter, doing, asked; int64 place, phase, move, called, moving; int32 status"
    )


class NotCompiled(Exception):
    """Reason for a missing C loop."""


@cache
def library() -> Any:
    """Return the compiled loop from the cache; raise NotCompiled without a working compiler."""
    try:
        run = load_library(SOURCE.read_text(encoding="utf-8")).run
    except NoCompiler:
        raise NotCompiled("no C compiler") from None
    except (CompilerFailed, AttributeError) as error:  # AttributeError: the compiler produced a library without `run`
        raise NotCompiled(f"the C compiler fails: {' '.join(str(error).split())[:200]}") from None
    run.argtypes, run.restype = [ctypes.POINTER(Plan)], ctypes.c_int
    return run


def move(function: Any, exchange: Exchange, row: Row) -> Move:
    """Return a get or set call for C."""
    kind, place = exchange.kind, ctypes.addressof(row) + 8 * exchange.places.start
    references, count, values, scalars = exchange.arguments
    bounds = (-kind.largest, kind.largest) if kind.low is None or kind.high is None else (kind.low, kind.high)
    pointer = ctypes.cast(function, c_void_p)
    return Move(pointer, references, count, scalars, values, place, *bounds, exchange.finite, TYPES[kind.ctype])


def fmu_slot(version: int, step: Any, instance: Any, puts: Sequence[Move], gets: Sequence[Move], time: float) -> Slot:
    """Return the slot of an FMU at `time` [s]."""
    put, get = (Move * len(puts))(*puts), (Move * len(gets))(*gets)
    slot = Slot(version, ctypes.cast(step, c_void_p), instance, every=1, time=time)
    slot.puts, slot.gets, slot.put, slot.get = len(put), len(get), ctypes.addressof(put), ctypes.addressof(get)
    slot.keeping = put, get
    return slot


def called_slot(step: Callable[[float, float], None], time: float, late: Callable[[], None]) -> Slot:
    """Return the slot of a component at `time` [s] whose step is a function of Python.

    Args:
        late: Function that puts late values and gets the outputs.
    """
    is_done, failures = ctypes.c_bool(), list[BaseException]()

    def call(t: float, h: float) -> None:
        try:
            step(t, h) if h else late()
        except BaseException as failure:  # Exceptions cannot pass through C.
            failures.append(failure)
        else:
            is_done.value = True

    function = CALL(call)
    slot = Slot(CALLED, ctypes.cast(function, c_void_p), ctypes.addressof(is_done), every=1, time=time)
    slot.keeping, slot.failures = (function, is_done), failures
    return slot


def transfer(row: Row, origin: int, to: int, links: Sequence[ConvertedLink] = (), every: int = 1) -> Transfer:
    """Return a transfer between two places of the row."""
    chain, first = (ConvertedLink * len(links))(*links), ctypes.addressof(row)
    result = Transfer(first + 8 * origin, first + 8 * to, every, len(chain), ctypes.addressof(chain))
    result.keeping = chain, [getattr(link, "keeping", None) for link in links]
    return result


def address_of(buffer: Any) -> int | None:
    """Return the address of a buffer, which is referenced and not copied; None for an empty one."""
    return None if not buffer else ctypes.addressof(ctypes.c_char.from_buffer(buffer))


class Loop:
    """A system in C, from its first step on.

    Args:
        slots: Slots in stepping order, each with the transfers before and after its step.
        holds: Transfers at the end of a step.
        row: Current signals.
        table: Rows of all communication points, with point 0 filled.
        counter: Number of completed points, for observers; `doing` counts calls.
        asked: Cell that is not 0 if `run` shall return after the current step.
        first: First point to make.
    """

    def __init__(
        self,
        slots: Sequence[tuple[Slot, Sequence[Transfer], Sequence[Transfer]]],
        holds: Sequence[Transfer],
        row: Row,
        table: Array,
        *,
        begin: float,
        h: float,
        counter: Any,
        doing: Any,
        asked: Any = None,
        first: int = 1,
    ) -> None:
        asked = asked if asked is not None else array("q", [0])
        self._run = library()
        transfers = [[(Transfer * len(each))(*each) for each in around] for _, *around in slots]
        for (slot, *_), (pull, late) in zip(slots, transfers, strict=True):
            slot.pulls, slot.pull = len(pull), ctypes.addressof(pull)
            slot.lates, slot.late = len(late), ctypes.addressof(late)
        self.slots, hold = (Slot * len(slots))(*(slot for slot, *_ in slots)), (Transfer * len(holds))(*holds)
        self._keeping = slots, transfers, holds, hold, row, table, counter, doing, asked
        self.plan = plan = Plan(begin, h, len(self.slots), len(hold), len(row), next=first)
        plan.slot, plan.hold = ctypes.addressof(self.slots), ctypes.addressof(hold)
        plan.row, plan.table = ctypes.addressof(row), table.ctypes.data
        plan.counter, plan.doing, plan.asked = address_of(counter), address_of(doing), address_of(asked)

    def prepare(self, slot: int, values: Array, since: int) -> None:
        """Set prepared values of a slot of version 0, without copying.

        Args:
            values: A row for each point from `since` on.
        """
        self.slots[slot].prepared, self.slots[slot].since = values.ctypes.data, since

    def run(self, last: int, pause: int = NEVER) -> StopReason:
        """Continue to point `last`, or until Python is needed.

        Args:
            pause: Point at which to return before its row is stored.
        """
        self.plan.last, self.plan.pause = last, pause
        return StopReason(self._run(ctypes.byref(self.plan)))
