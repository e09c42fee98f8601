"""A reference over time: steps and ramps."""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from functools import partial

from pydantic import Field, field_validator

from cosim.yaml_file import NotNegative, Number, Part, Positive


class Change(Part):
    """A reference goes to a value at a time: a step, or a ramp.

    at:   [s]
    to:   the value
    rate: slope of a ramp, per second; a step without
    """

    at: NotNegative
    to: Number
    rate: Positive | None = None


class Profile(Part):
    """A reference over time: a start value and changes in order.

    unit:    such as m or deg, which becomes rad
    start:   value before the first change
    changes: in the order of their times
    """

    unit: str = ""
    start: Number = 0.0
    changes: list[Change] = Field(default_factory=list)

    @field_validator("changes")
    @classmethod
    def _in_order(cls, changes: list[Change]) -> list[Change]:
        times = [c.at for c in changes]
        if times != sorted(set(times)):
            raise ValueError(f"changes at {times} s are not in order of time; sort them, one at a time")
        return changes


def profile_function(profile: Profile, factor: float = 1.0) -> Callable[[float], float]:
    """Value at a time: the last step, or the point reached on the last ramp (a new change interrupts a ramp)."""
    begins = [profile.start]
    for before, change in zip(profile.changes, profile.changes[1:], strict=False):
        begins.append(_reached(begins[-1], before.to, before.rate, change.at - before.at))

    changes = [(change.to, change.rate) for change in profile.changes]
    return partial(_value, [change.at for change in profile.changes], begins, changes, factor)


def _value(
    times: Sequence[float],
    begins: Sequence[float],
    changes: Sequence[tuple[float, float | None]],
    factor: float,
    t: float,
) -> float:
    # a time that is a step's time but for rounding belongs to the step
    k = bisect.bisect_right(times, t + 1e-9) - 1
    if k < 0:
        return factor * begins[0]
    to, rate = changes[k]
    return factor * _reached(begins[k], to, rate, t - times[k])


def _reached(begin: float, to: float, rate: float | None, elapsed: float) -> float:
    if rate is None or abs(to - begin) <= rate * elapsed:
        return to
    return begin + math.copysign(rate * max(0.0, elapsed), to - begin)
