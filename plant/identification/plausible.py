"""Plausibility of results: impossible numbers are faults, intervals with impossible values are warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.errors import Fault
from plant.bench import Bench
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
    """Return the possible range of a number, as declared by the bench."""
    if name.endswith("_projection"):
        return FACTOR_BOUNDS
    declared = Bench().declared["lag" if name.startswith("lag") else name]
    return declared.bounds


def result_faults(protocol: Protocol, results: Sequence[Result]) -> list[Fault]:
    """Return faults of results and impossible numbers; add interval warnings to the results."""
    faults = []
    for result in results:
        for e in result.estimates:
            if reason := _impossible(e):
                cure = CURES["lag" if e.name.startswith("lag") else e.name]
                text = "; ".join([f"{e.name} {reason}; {cure}", *result.odd])
                faults.append(protocol.yaml.fault(("tests", result.test), text, key=True))
        faults += [protocol.yaml.fault(("tests", result.test), text, key=True) for text in result.faults]
        result.warnings += result.odd
        result.warnings += [text for e in result.estimates for text in _doubtful(e)]
    return faults


def _unit(e: Estimate) -> str:
    return "" if e.unit == "1" else f" {e.unit}"


def _impossible(e: Estimate) -> str:
    """Return the reason why a number is impossible, else ""."""
    low, high = bounds_of(e.name)
    if not np.isfinite([e.value, e.low, e.high]).all():
        if np.isfinite(e.value):
            return f"comes out as {e.value:.4g}{_unit(e)} without an interval: the recordings do not determine it"
        return "has no value: the recordings do not determine it"
    if e.name.startswith("lag") and not LAGS[0] * 1.001 < e.value < LAGS[-1] / 1.001:
        return f"is {e.value:.4g} s, an end of the {LAGS[0]:g} to {LAGS[-1]:g} s that are tried"
    if not low <= e.value <= high:
        return f"comes out as {e.value:.4g}{_unit(e)}, and {low:g} to {high:g}{_unit(e)} is possible"
    return ""


def _doubtful(e: Estimate) -> Iterator[str]:
    """Yield doubts about a possible number."""
    low, high = bounds_of(e.name)
    if e.low < low or e.high > high:
        yield (
            f"the interval of {e.name}, {e.low:.4g} to {e.high:.4g}{_unit(e)}, contains impossible values "
            f"({low:g} to {high:g}{_unit(e)} is possible): the recordings determine it poorly; look for one that "
            "differs, or record more"
        )
    half = 0.5 * (e.high - e.low)
    if e.name.endswith("_projection") and abs(e.value - 1.0) > FACTOR_HALF_WIDTHS * half:
        function = "cosine" if e.name.startswith("vertical") else "sine"
        yield f"{e.name} is {e.value:.4g} ± {half:.2g}, not 1, so the {function} does not project it; {CURES[e.name]}"
