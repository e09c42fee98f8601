"""A reference signal over time: steps and ramps."""

from __future__ import annotations

import bisect
import math

import numpy as np
from pydantic import Field, field_validator

from cosim.core.arrays import Array
from cosim.core.times import rounding, roundings
from cosim.files.yaml_file import Amount, Part, PositiveAmount, Seconds


class Change(Part):
    """Change of a reference at a time: a step or a ramp.

    at:   [s]
    to:   value after the change
    rate: slope of a ramp, per second; by default a step
    """

    at: Seconds
    to: Amount
    rate: PositiveAmount | None = None


class Profile(Part):
    """Reference over time: a start value and ordered changes.

    unit:    such as m or deg, which becomes rad
    start:   value before the first change
    changes: in the order of their times
    """

    unit: str = ""
    start: Amount = 0.0
    changes: list[Change] = Field(default_factory=list)

    @field_validator("changes")
    @classmethod
    def _in_order(cls, changes: list[Change]) -> list[Change]:
        times = [c.at for c in changes]
        if times != sorted(set(times)):
            raise ValueError(f"changes at {times} s are not in order of time; sort them, with one change per time")
        return changes


class ProfileFunction:
    """Function from a time [s] to the value of a profile. A change that begins during a ramp interrupts the ramp.

    Args:
        step: Communication step [s]; times that differ by much less count as equal.
    """

    def __init__(self, profile: Profile, factor: float = 1.0, step: float = 0.0) -> None:
        begins = [profile.start]
        for before, change in zip(profile.changes, profile.changes[1:], strict=False):
            begins.append(_value_after(begins[-1], before.to, before.rate, change.at - before.at))
        self.step = step
        self.factor, self.begins, self.times = factor, begins, [change.at for change in profile.changes]
        self.changes = [(change.to, change.rate) for change in profile.changes]

    def __call__(self, t: float) -> float:
        # A time that equals that of a change within rounding is at the change.
        k = bisect.bisect_right(self.times, t + rounding(t, self.step)) - 1
        if k < 0:
            return self.factor * self.begins[0]
        to, rate = self.changes[k]
        return self.factor * _value_after(self.begins[k], to, rate, t - self.times[k])

    def over(self, times: Array) -> Array:
        """Return values at ordered times, with exactly the results of single calls."""
        bounds = [0, *np.searchsorted(times + roundings(times, self.step), self.times).tolist(), len(times)]
        values = np.full(len(times), self.begins[0])
        for k, (to, rate) in enumerate(self.changes):
            part = slice(bounds[k + 1], bounds[k + 2])
            begin, elapsed = self.begins[k], times[part] - self.times[k]
            if rate is None:
                values[part] = to
            else:
                ramp = begin + np.copysign(rate * np.maximum(0.0, elapsed), to - begin)
                values[part] = np.where(abs(to - begin) <= rate * elapsed, to, ramp)
        return self.factor * values


def _value_after(begin: float, to: float, rate: float | None, elapsed: float) -> float:
    if rate is None or abs(to - begin) <= rate * elapsed:
        return to
    return begin + math.copysign(rate * max(0.0, elapsed), to - begin)
