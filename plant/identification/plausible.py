"""Numbers that are impossible, which are faults, and intervals that contain impossible values, which are warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.errors import Fault
from plant.bench import Bench
from plant.identification.command_response import LAGS
from plant.identification.estimates import Estimate, Result
from plant.identification.protocol import Protocol

FACTOR_BOUNDS = (0.5, 2.0)  # of a projection, which is 1: beyond it another angle, unit or channel was read
FACTOR_HALF_WIDTHS = 3.0  # that 1 may lie outside a projection's interval, in its half-widths
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
    """Return the possible range of a number, as the bench declares it."""
    if name.endswith("_projection"):
        return FACTOR_BOUNDS
    declared = Bench().declared["lag" if name.startswith("lag") else name]
    return declared.bounds


def result_faults(protocol: Protocol, results: Sequence[Result]) -> list[Fault]:
    """Return the faults of results and one for each impossible number; add warnings of intervals to the results."""
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
    """Return why a number cannot be, "" where it can."""
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
    """Yield what is doubtful about a number that is possible."""
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
