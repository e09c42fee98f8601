"""Columns in another unit than that of the model, by start values, bounds and predictions of the model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from cosim.base.arrays import Array
from cosim.base.messages import Template
from cosim.base.text import amount, plain
from cosim.base.units import alternatives, factor
from cosim.logs import messages
from cosim.logs.finding import Finding, Severity
from cosim.logs.log import Log

SLOW = 1.0  # [s] slower changes also come from drift and the unknown start
OTHER_SIZE = 5.0  # ratio to the model from which a size is another one
SAME_SIZE = (0.7, 1.4)  # ratio to the model within which a size is the same
MAX_SLOPE_ERROR = 0.1  # standard error of a slope relative to the slope
BLOCKS, MIN_BLOCK = 20, 10  # blocks of rows for the standard error, and rows of a block
MIN_SHARE_OF_BOUND = 0.02  # least size relative to its bound in the right unit


def input_unit_findings(
    log: Log, starts: Mapping[str, float], bounds: Mapping[str, tuple[float, float]] = MappingProxyType({})
) -> Iterator[Finding]:
    """Yield findings on inputs whose size fits the model only in another unit.

    Args:
        starts: Start value of each input in the model.
        bounds: Limits declared by the model; a value beyond them is a fault.
    """
    for name, values in log.inputs.items():
        unit, size, start = log.units[name], float(np.abs(values).max()), abs(starts.get(name, 0.0))
        bound = max(map(abs, bounds.get(name, (math.inf,))))
        severity: Severity
        template: Template
        if bound < math.inf and unit != "rad":  # angles are checked against their bounds elsewhere
            reference, range_, severity, template = bound, (MIN_SHARE_OF_BOUND, 1.0), "fault", messages.BEYOND_BOUND
            if size <= OTHER_SIZE * bound:
                continue
        elif start:
            reference, range_, severity, template = start, SAME_SIZE, "warning", messages.OTHER_SIZE
        else:
            continue
        if other := other_unit(unit, size / reference, range_):
            text = template(size=amount(size, unit), reference=amount(reference, unit), unit=other, name=name)
            yield Finding(severity, "unit", name, text, {"ratio": size / reference})


def output_unit_findings(log: Log, model: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield warnings on outputs that move with the model by the factor of another unit."""
    for name, measured in log.outputs.items():
        if name not in model:
            continue
        slope, error = _slope(moving_part(log, measured), moving_part(log, model[name]))
        if error < MAX_SLOPE_ERROR * slope and (unit := other_unit(log.units[name], slope)):
            text = messages.OTHER_SLOPE(slope=plain(slope), error=plain(error, 1), unit=unit, name=name)
            yield Finding("warning", "unit", name, text, {"slope": slope, "error": error})


def other_unit(unit: str, ratio: float, around: tuple[float, float] = SAME_SIZE) -> str | None:
    """Return the unit whose conversion brings the ratio of sizes, log to model, into a range; None without one."""
    if not unit or 1.0 / OTHER_SIZE < ratio < OTHER_SIZE:
        return None
    sizes = {other: factor(other, unit) for other in (*alternatives(unit), "rpm")}
    return next((u for u, f in sizes.items() if f and around[0] < ratio * f < around[1]), None)


def moving_part(log: Log, values: Array) -> Array:
    """Return the fast part of a signal: its deviation from the moving mean over SLOW seconds; NaN at the ends."""
    half = max(1, round(0.5 * SLOW * log.slowness / log.step))
    out = np.full(values.size, np.nan)
    if values.size > 2 * half:
        finite = np.isfinite(values)
        parts = np.where(finite, values, 0.0), finite.astype(np.float64)
        sums, counts = (np.concatenate(([0.0], np.cumsum(part))) for part in parts)
        width = 2 * half + 1
        count = counts[width:] - counts[:-width]
        middle = slice(half, values.size - half)
        with np.errstate(invalid="ignore", divide="ignore"):
            out[middle] = values[middle] - (sums[width:] - sums[:-width]) / count
    return out


def _slope(measured: Array, model: Array) -> tuple[float, float]:
    """Return the least-squares slope of a measurement over the model, and its standard error.

    The error comes from blocks of rows, so that the residual may be correlated; without enough rows it is infinite.
    """
    good = np.isfinite(measured) & np.isfinite(model)
    y, x = measured[good], model[good]
    square = float(x @ x)
    if x.size < BLOCKS * MIN_BLOCK or not square > 0.0:
        return 0.0, math.inf
    slope = float(x @ y) / square
    scores = [float(part.sum()) for part in np.array_split(x * (y - slope * x), BLOCKS)]
    return slope, math.hypot(*scores) / square
