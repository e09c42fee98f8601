"""Inputs in another unit than that of the model, by its start values and bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from cosim.core.text import amount
from cosim.core.units import alternatives, factor
from cosim.logs.finding import Finding
from cosim.logs.log import Log

OTHER_SIZE = 5.0  # ratio to the model from which a size is another one
SAME_SIZE = (0.7, 1.4)  # ratio to the model within which a size is the same
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
        size, start = float(np.abs(values).max()), abs(starts.get(name, 0.0))
        bound = max(map(abs, bounds.get(name, (math.inf,))))
        unit = log.units[name]
        if size > OTHER_SIZE * bound and unit != "rad":  # angles are checked against their bounds elsewhere
            # in the right unit, the input would lie within its bound
            other = other_unit(unit, size / bound, (MIN_SHARE_OF_BOUND, 1.0))
            text = f"reaches {amount(size, unit)}, far beyond the {amount(bound, unit)} that the model allows"
            cure = f'; is its unit {other}? Then call the column "{name} [{other}]"'
            text += cure if other else ": is it scaled, or in another unit?"
            yield Finding("fault", "unit", name, text, {"ratio": size / bound})
        elif start and (other := other_unit(unit, size / start)):
            text = (
                f"reaches {amount(size, unit)}, where the model starts at {amount(start, unit)}; is its unit {other}? "
                f'Then call the column "{name} [{other}]"'
            )
            yield Finding("warning", "unit", name, text, {"ratio": size / start})


def other_unit(unit: str, ratio: float, around: tuple[float, float] = SAME_SIZE) -> str | None:
    """Return the unit whose conversion brings the ratio of sizes, log to model, into a range; None without one."""
    if not unit or 1.0 / OTHER_SIZE < ratio < OTHER_SIZE:
        return None
    sizes = {other: factor(other, unit) for other in (*alternatives(unit), "rpm")}
    return next((u for u, f in sizes.items() if f and around[0] < ratio * f < around[1]), None)
