"""Clocks of an FMI 3.0 FMU: their declaration, and timers that say when time-based clocks tick."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from cosim.core.errors import FmuError
from cosim.files.archive import DESCRIPTION

ClockKind = Literal["constant", "fixed", "tunable", "changing", "countdown", "triggered"]
PERIODIC = ("constant", "fixed", "tunable")
NUMBERS = {"intervalDecimal", "intervalCounter", "resolution", "shiftDecimal", "shiftCounter", "priority"}
LOWEST = 2**31  # priority of a clock without one: after all others


@dataclass(frozen=True)
class Timing:
    """Times of a clock, as the scenario states them.

    Attributes:
        interval: Time [s] between two ticks.
        shift: Time [s] from the start of the run to the first tick.
        at: Times of all ticks [s], ordered; takes the place of `interval`.
    """

    interval: float | None = None
    shift: float | None = None
    at: tuple[float, ...] = ()


@dataclass(frozen=True)
class Clock:
    """A clock as an FMU declares it.

    Attributes:
        interval: Declared interval [s]; None if the FMU computes it.
        priority: Order of the model partitions due at the same time, smallest first.
        clocks: Names of the clocks with which this clock ticks.
    """

    name: str
    reference: int
    kind: ClockKind
    causality: str
    interval: float | None = None
    shift: float = 0.0
    priority: int = LOWEST
    clocks: frozenset[str] = frozenset()


def read_clocks(path: Path, description: Any) -> dict[str, Clock]:
    """Return the clocks of an FMU by name.

    FMPy reads neither intervals nor priorities.

    Raises:
        FmuError: An interval, a shift or a priority is no number, or a period is not above 0.
    """
    variables = {v.name: v for v in description.modelVariables if v.type == "Clock"}
    if not variables:
        return {}
    root = ElementTree.fromstring(zipfile.ZipFile(path).read(DESCRIPTION))
    types = {node.get("name"): node.attrib for node in root.iter("ClockType")}
    clocks = {}
    for node in root.iter("Clock"):
        name = node.get("name", "")
        if name in variables:
            attributes = {**types.get(node.get("declaredType"), {}), **node.attrib}
            numbers = {key: _number(path, name, key, attributes[key]) for key in NUMBERS & attributes.keys()}
            kind, resolution = attributes.get("intervalVariability", "triggered"), numbers.get("resolution", 1.0)
            interval = numbers.get("intervalDecimal")
            if interval is None and "intervalCounter" in numbers:
                interval = numbers["intervalCounter"] / resolution
            variable = variables[name]
            clocks[name] = clock = Clock(
                name,
                variable.valueReference,
                kind,  # type: ignore[arg-type]  # checked by FMPy against the schema
                variable.causality,
                interval if kind in PERIODIC else None,
                numbers.get("shiftDecimal") or numbers.get("shiftCounter", 0.0) / resolution,
                int(numbers.get("priority", LOWEST)),
                frozenset(clock.name for clock in variable.clocks or ()),
            )
            if clock.interval is not None and not clock.interval > 0.0:
                raise FmuError(
                    f"{path} is not a valid FMU: clock {name}: its interval is {clock.interval:g} s; a periodic clock "
                    "needs one above 0, another clock one of 0 or more"
                )
    return clocks


def _number(path: Path, clock: str, key: str, text: str) -> float:
    """Return a number of the description."""
    with suppress(ValueError):
        if math.isfinite(number := float(text)) and (number > 0.0 or key != "resolution"):
            return number
    raise FmuError(f'{path} is not a valid FMU: {f"{key} of the clock {clock}"} is "{text}", which is no number')


@dataclass
class Timer:
    """Times of a clock's ticks, derived from counts.

    Attributes:
        base: Time [s] of tick 0 of the current interval.
        count: Number of ticks since `base`.
        interval: Current interval [s]; None: only the tick at `base` is known.
        times: Times of all ticks [s], if they are stated one by one.
        is_set: Whether a next tick is known.
    """

    base: float = 0.0
    count: int = 0
    interval: float | None = None
    times: Sequence[float] = field(default_factory=tuple)
    is_set: bool = False

    @property
    def next(self) -> float:
        """Return the time [s] of the next tick, or infinity."""
        if self.is_set and self.times:
            return self.times[self.count] if self.count < len(self.times) else math.inf
        if not self.is_set or (self.interval is None and self.count > 0):
            return math.inf
        return self.base + self.count * (self.interval or 0.0)

    def begin(self, base: float, interval: float | None = None, count: int = 0) -> None:
        """Tick once, at `base` [s], or every `interval` [s] from tick `count` on."""
        self.base, self.count, self.interval, self.is_set = base, count, interval, True
