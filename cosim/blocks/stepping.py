"""Stepping loop in C (`stepping.c`) for systems of FMUs whose functions C can call.

    loop = Loop(slots, held, row, table, begin=0.0, h=0.02, made=made, doing=doing)
    while (why := loop.run(last, pause)) != Why.FINISHED: …   # handle, then call again to continue

A `Slot` is an FMU (function pointers and instance loaded by FMPy) or values prepared for each point. A `Transfer` moves
a value within a row of doubles through `Link`s: factors, noise and injected faults, each a function of the point and of
previous values. The caller allocates everything. A step gives the same bytes as the same calls from Python.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import c_bool, c_double, c_int32, c_int64, c_size_t, c_void_p
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from cosim.base.arrays import Array
from cosim.blocks.component import Row
from cosim.blocks.fmi_types import Exchange
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, loaded

SOURCE = Path(__file__).with_name("stepping.c")
NEVER = -1
NAMES = ("double", "float", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "bool")
TYPES = {getattr(ctypes, f"c_{name}"): number for number, name in enumerate(NAMES)}  # numbering of stepping.c


class Why(IntEnum):
    """Reason for a return of the loop: its last step, or a need for Python.

    STATUS: a call returned a status other than OK; NOT_FINITE: an output is not finite; UNFIT: an input does not fit
        its
    type; NO_ITEM: a value is no item of the target enumeration; TERMINATED: an FMU ended the simulation; PAUSED: the
    row of a point is complete but not stored; LATER: a second has passed
    """

    FINISHED, STATUS, NOT_FINITE, UNFIT, NO_ITEM, TERMINATED, PAUSED, LATER = range(8)


class Does(IntEnum):
    """Effect of a link on a value v at point k; all but the first two and the last act only from `first` to `last`.

    v·a + b, v + values[k], v + a, v·a, a, v + a where marks[k], v of `count` − 1 points before, the last v where
    marks[k], v if it is among `values`
    """

    AFFINE, ADDED, BIAS, SCALE, STUCK, SPIKES, DELAYED, HELD, ITEMS = range(9)


class Link(ctypes.Structure):
    """Conversion of a value in transit; `keeping` keeps its buffers alive."""

    keeping: Any

    _fields_ = (
        ("kind", c_int32),
        ("first", c_int64),
        ("last", c_int64),
        ("a", c_double),
        ("b", c_double),
        ("values", c_void_p),
        ("marks", c_void_p),
        ("kept", c_void_p),
        ("count", c_int64),
    )


class Transfer(ctypes.Structure):
    """Transfer between two places of the row, every so many points."""

    keeping: Any

    _fields_ = (("origin", c_void_p), ("to", c_void_p), ("every", c_int64), ("links", c_int64), ("link", c_void_p))


class Move(ctypes.Structure):
    """Variables of a type, moved in a single call.

    `row` is their place in the row; after a get the first `finite` values must be finite.
    """

    _fields_ = (
        ("function", c_void_p),
        ("references", c_void_p),
        ("count", c_size_t),
        ("scalars", c_size_t),
        ("values", c_void_p),
        ("row", c_void_p),
        ("low", c_double),
        ("high", c_double),
        ("finite", c_size_t),
        ("type", c_int32),
    )


class Slot(ctypes.Structure):
    """A stepped unit: an FMU of FMI `version` 2 or 3, or (0) `scalars` values prepared per point from `since` on."""

    keeping: Any

    _fields_ = (
        ("version", c_int32),
        ("step", c_void_p),
        ("instance", c_void_p),
        ("every", c_int64),
        ("doing", c_int64),
        ("pulls", c_int64),
        ("puts", c_int64),
        ("gets", c_int64),
        ("length", c_double),
        ("pull", c_void_p),
        ("put", c_void_p),
        ("get", c_void_p),
        ("prepared", c_void_p),
        ("row", c_void_p),
        ("scalars", c_size_t),
        ("since", c_int64),
        ("time", c_double),
        ("reached", c_double),
        ("event", c_bool),
        ("terminate", c_bool),
        ("early", c_bool),
    )


class Plan(ctypes.Structure):
    """Complete state of the C loop."""

    _fields_ = (
        ("begin", c_double),
        ("h", c_double),
        ("slots", c_int64),
        ("held", c_int64),
        ("width", c_int64),
        ("next", c_int64),
        ("last", c_int64),
        ("pause", c_int64),
        ("slot", c_void_p),
        ("hold", c_void_p),
        ("row", c_void_p),
        ("table", c_void_p),
        ("made", c_void_p),
        ("doing", c_void_p),
        ("place", c_int64),
        ("phase", c_int64),
        ("move", c_int64),
        ("called", c_int64),
        ("moving", c_int64),
        ("status", c_int32),
    )


class Steps(Protocol):
    """A component for the C loop; others have no `slot`, or `slot` returns the reason."""

    def slot(self) -> Slot | str:
        """Return the slot after initialization, or the reason for none."""

    def came_to(self, t: float) -> None:
        """Note the time [s] after C steps."""

    def tell(self, why: Why, plan: Plan, slot: Slot) -> None:
        """Raise the error behind a return of the C loop.

        Warnings are only logged.

        Raises:
            SimulationError: A call or value is faulty.
            EndedEarly: The FMU ended the simulation.
        """


class NotCompiled(Exception):
    """Reason for a missing C loop."""


@cache
def library() -> Any:
    """Return the compiled loop from the cache; raise NotCompiled without a working compiler."""
    try:
        run = loaded(SOURCE.read_text(encoding="utf-8")).run
    except NoCompiler:
        raise NotCompiled("no C compiler") from None
    except (CompilerFailed, AttributeError) as error:  # AttributeError: the compiler produced a library without `run`
        raise NotCompiled(f"the C compiler fails: {' '.join(str(error).split())[:200]}") from None
    run.argtypes, run.restype = [ctypes.POINTER(Plan)], ctypes.c_int
    return run


def move(function: Any, exchange: Exchange, row: Row, finite: int = 0) -> Move:
    """Return a get or set call for C.

    Args:
        finite: Number of leading values that must be finite.
    """
    direct = exchange.kind.ctype is ctypes.c_double
    place = ctypes.addressof(row) + 8 * exchange.places.start
    values = place if direct else ctypes.addressof(exchange.buffer)
    low, high = exchange.kind.low, exchange.kind.high
    pointer = ctypes.cast(function, c_void_p)
    largest = exchange.kind.largest
    bounds = (-largest, largest) if low is None or high is None else (float(low), float(high))
    references = ctypes.addressof(exchange.vrs)
    kind = TYPES[exchange.kind.ctype]
    return Move(pointer, references, len(exchange.vrs), exchange.count, values, place, *bounds, finite, kind)


def fmu_slot(version: int, step: Any, instance: Any, puts: Sequence[Move], gets: Sequence[Move], time: float) -> Slot:
    """Return the slot of an FMU at `time` [s]."""
    put, get = (Move * len(puts))(*puts), (Move * len(gets))(*gets)
    slot = Slot(version, ctypes.cast(step, c_void_p), instance, every=1, time=time)
    slot.puts, slot.gets, slot.put, slot.get = len(put), len(get), ctypes.addressof(put), ctypes.addressof(get)
    slot.keeping = put, get
    return slot


def transfer(row: Row, origin: int, to: int, links: Sequence[Link] = (), every: int = 1) -> Transfer:
    """Return a transfer between two places of the row."""
    chain, first = (Link * len(links))(*links), ctypes.addressof(row)
    made = Transfer(first + 8 * origin, first + 8 * to, every, len(chain), ctypes.addressof(chain))
    made.keeping = chain, [getattr(link, "keeping", None) for link in links]
    return made


def link(
    kind: Does,
    window: tuple[int, int] = (0, 0),
    *,
    a: float = 0.0,
    b: float = 0.0,
    values: Any = None,
    marks: Any = None,
    kept: Any = None,
    count: int = 0,
) -> Link:
    """Return a link; buffers are referenced, not copied.

    Args:
        values: Buffer of doubles, like `kept`.
        marks: Buffer of bytes.
    """
    made = Link(kind, *window, a, b, _address(values), _address(marks), _address(kept), count)
    made.keeping = values, marks, kept
    return made


def _address(buffer: Any) -> int | None:
    """Return the address of a buffer."""
    return None if not buffer else ctypes.addressof(ctypes.c_char.from_buffer(buffer))


class Loop:
    """A system in C, from its first step on.

    Args:
        slots: Slots in stepping order, each with the transfers before its step.
        held: Transfers at the end of a step.
        row: Current signals.
        table: Rows of all communication points, with point 0 filled.
        made: Counter of completed points, for observers; `doing` counts calls.
    """

    def __init__(
        self,
        slots: Sequence[tuple[Slot, Sequence[Transfer]]],
        held: Sequence[Transfer],
        row: Row,
        table: Array,
        *,
        begin: float,
        h: float,
        made: Any,
        doing: Any,
    ) -> None:
        self._run = library()
        pulls = [(Transfer * len(transfers))(*transfers) for _, transfers in slots]
        for (slot, _), pull in zip(slots, pulls, strict=True):
            slot.pulls, slot.pull = len(pull), ctypes.addressof(pull)
        self.slots, hold = (Slot * len(slots))(*(slot for slot, _ in slots)), (Transfer * len(held))(*held)
        self._keeping = slots, pulls, held, hold, row, table, made, doing
        self.plan = plan = Plan(begin, h, len(self.slots), len(hold), len(row), next=1)
        plan.slot, plan.hold = ctypes.addressof(self.slots), ctypes.addressof(hold)
        plan.row, plan.table = ctypes.addressof(row), table.ctypes.data
        plan.made, plan.doing = _address(made), _address(doing)

    def prepare(self, slot: int, values: Array, since: int) -> None:
        """Set prepared values of a slot of version 0, without copying.

        Args:
            values: A row for each point from `since` on.
        """
        self.slots[slot].prepared, self.slots[slot].since = values.ctypes.data, since

    def run(self, last: int, pause: int = NEVER) -> Why:
        """Continue to point `last`, or until Python is needed.

        Args:
            pause: Point at which to return before its row is stored.
        """
        self.plan.last, self.plan.pause = last, pause
        return Why(self._run(ctypes.byref(self.plan)))
