"""Start values of an FMU for co-simulation that change its course, by trial: they stand for unknown start states."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.derivatives import REALS
from cosim.probing.fmu_structure import StartValue
from cosim.probing.log_runs import Course
from cosim.probing.prober import Job, Prober, quantities
from cosim.scenario.start_values import settable

STEP = 1e-2  # displacement of a start value, as a share of its size or nominal value
MOST = 40  # start values tried


def start_values(prober: Prober, simulate: Job, course: Course, base: Array, noise: Array) -> tuple[StartValue, ...]:
    """Return the start values of states that change an output.

    Parameters are not tried: those of a start are a matter of names.

    Args:
        simulate: Function of FMU and course, in the worker, that returns the outputs and an error.
        base: Outputs along the course with the FMU's own start values.
        noise: Differences of equal outputs.
    """
    found = []
    spread = np.maximum(base.std(axis=0), 10.0 * noise)
    for variable in _candidates(prober.description)[:MOST]:
        (quantity,) = quantities(prober.description, [variable.name])
        moved = _moved(quantity.start, float(getattr(variable, "nominal", None) or 0.0), quantity.bounds)
        try:
            table, _ = prober.call(simulate, prober.with_values({variable.name: moved}), course)
        except SimulationError:
            continue
        rows = min(len(table), len(base))
        change, by = table[:rows] - base[:rows], moved - quantity.start
        if not rows or not (np.abs(change) > noise).any():
            continue
        reach = float((np.abs(change) / spread).max()) / abs(by)
        shown, gain = _shown(change[0] / by, noise / abs(by))
        found.append(StartValue(quantity, 1.0 / reach, shown, gain))
    return tuple(found)


def _candidates(description: Any) -> list[Any]:
    """Return the scalar real states and outputs with a start value that may be set."""
    used: Collection[str] = {"input", "parameter", "calculatedParameter", "structuralParameter", "independent"}
    return [
        v
        for v in description.modelVariables
        if v.causality not in used
        and v.variability in {None, "continuous"}
        and v.type in REALS
        and not v.shape
        and v.start is not None
        and settable(v)
    ]


def _moved(value: float, nominal: float, bounds: tuple[float, float]) -> float:
    size = STEP * (abs(value) or abs(nominal) or 1.0)
    return value + size if value + size <= bounds[1] else value - size


def _shown(slopes: Array, noise: Array) -> tuple[int, float]:
    """Return the output that alone shows a start value after initialization, and its slope; −1 and 0 without one."""
    shown = np.flatnonzero(np.abs(slopes) > noise)
    return (int(shown[0]), float(slopes[shown[0]])) if len(shown) == 1 else (-1, 0.0)
