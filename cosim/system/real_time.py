"""What ties a run to the clock on the wall."""

from __future__ import annotations

from dataclasses import dataclass

from cosim.scenario.scenario import Scenario


@dataclass(frozen=True)
class RealTime:
    """Pace of a run [simulated s/s], None for as fast as possible."""

    pace: float | None = None


def real_time_of(scenario: Scenario) -> RealTime | None:
    """Return what ties a run to real time, if anything."""
    return None if scenario.pace is None else RealTime(scenario.pace)
