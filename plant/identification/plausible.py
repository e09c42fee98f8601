"""Plausibility of results: an impossible value is a fault, an interval with impossible values a warning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.errors import Fault
from plant.bench import Bench
from plant.identification import messages
from plant.identification.command_response import LAGS
from plant.identification.estimates import Estimate, Result
from plant.identification.protocol import Protocol

FACTOR_BOUNDS = (0.5, 2.0)  # range of a projection factor, ideally 1; outside, another angle, unit or channel was read
FACTOR_HALF_WIDTHS = 3.0  # half-widths of a projection's interval by which 1 may lie outside
CURES = {
    "thrust_offset": "look at the unit and points of cell z, and whether the cell is at its end in `window`",
    "thrust_slope": "look at the unit and points of cell z, and whether the cell is at its end in `window`",
    "ground_effect_exponent": "look for a run of another height, battery or cell, and at `propeller_radius`",
    "lag": "look whether the force follows the step or the sines, and at `servo_neutral` and `servo_slope`",
    "assembly_arm": "look at the unit and points of cell m, and at `assembly_mass`",
    "vertical_projection": "look at the points of cell z, and at `hold`",
    "horizontal_projection": "look at the points of cells z and x, and at `servo_slope`",
}


def bounds_of(name: str) -> tuple[float, float]:
    """Return a number's possible range declared by the bench."""
    if name.endswith("_projection"):
        return FACTOR_BOUNDS
    declared = Bench().declared["lag" if name.startswith("lag") else name]
    return declared.bounds


def result_faults(protocol: Protocol, results: Sequence[Result]) -> list[Fault]:
    """Return faults of results and impossible numbers; add warnings about possible numbers to the results."""
    faults = []
    for result in results:
        reasons = [reason for e in result.estimates if (reason := _reason_against(e))]
        faults += [protocol.yaml.fault(("tests", result.test), text, key=True) for text in reasons]
        result.warnings += [text for e in result.estimates for text in _doubts(e)]
    return faults


def _unit(e: Estimate) -> str:
    return "" if e.unit == "1" else f" {e.unit}"


def _reason_against(e: Estimate) -> str | None:
    """Return the message on an impossible number, else None."""
    low, high = bounds_of(e.name)
    is_lag = e.name.startswith("lag")
    cure = CURES["lag" if is_lag else e.name]
    fields = {"name": e.name, "value": e.value, "unit": _unit(e), "cure": cure}
    if not np.isfinite(e.value):
        return messages.NO_VALUE(name=e.name, cure=cure)
    if not np.isfinite([e.low, e.high]).all():
        return messages.NO_INTERVAL(**fields)
    if is_lag and not LAGS[0] * 1.001 < e.value < LAGS[-1] / 1.001:
        return messages.LAG_AT_LIMIT(name=e.name, value=e.value, low=LAGS[0], high=LAGS[-1], cure=cure)
    return None if low <= e.value <= high else messages.IMPOSSIBLE_VALUE(**fields, low=low, high=high)


def _doubts(e: Estimate) -> Iterator[str]:
    """Yield warnings about a possible number: a wide interval, or a projection factor far from 1."""
    low, high = bounds_of(e.name)
    if e.low < low or e.high > high:
        yield messages.WIDE_INTERVAL(name=e.name, first=e.low, last=e.high, unit=_unit(e), low=low, high=high)
    half = e.half_width
    if e.name.endswith("_projection") and abs(e.value - 1.0) > FACTOR_HALF_WIDTHS * half:
        fields = {"function": "cosine" if e.name.startswith("vertical") else "sine", "cure": CURES[e.name]}
        yield messages.WRONG_PROJECTION(name=e.name, value=e.value, half=half, **fields)
