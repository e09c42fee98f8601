"""Trials of the parameters that may be set before initialization: which of them act."""

from __future__ import annotations

import time
from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import SimulationError
from cosim.blocks.derivatives import REALS
from cosim.probing.fmu_structure import ProbedParameter
from cosim.probing.log_runs import SAME, Fmu
from cosim.probing.prober import Prober, quantities
from cosim.scenario.start_values import settable


@dataclass(frozen=True, eq=False)
class Reference:
    """Reaction of the FMU with its own parameters, against which others are compared.

    Attributes:
        start, table: Reaction of the FMU: states after initialization, rates with outputs.
        state_noise, noise: Differences of equal numbers, by rounding or by chance.
    """

    start: Array
    table: Array
    state_noise: Array
    noise: Array


def settable_parameters(description: Any) -> list[Any]:
    """Return the scalar real parameters that may be set before initialization."""
    return [
        v
        for v in description.modelVariables
        if v.causality == "parameter"
        and v.variability in {"fixed", "tunable"}
        and v.type in REALS
        and not v.shape
        and v.start is not None
        and settable(v)
    ]


def tried_parameters(
    prober: Prober, react: Callable[[Fmu], tuple[Array, Array]], size: Array, only: Container[str] | None = None
) -> tuple[ProbedParameter, ...]:
    """Return each settable parameter with what other values of it change.

    Args:
        react: Function of the FMU that returns its states after initialization, and a table of reactions.
        size: Magnitude of each column of the table.
        only: Names of the parameters to try; None for all.
    """
    parameters = [v for v in settable_parameters(prober.description) if only is None or v.name in only]
    if not parameters:
        return ()
    start, table = react(prober.fmu)
    begin = time.monotonic()
    again, repeated = react(prober.fmu)
    took = time.monotonic() - begin
    rows = min(len(table), len(repeated))
    noise = np.nan_to_num(np.abs(table[:rows] - repeated[:rows])).max(axis=0, initial=0.0)
    reference = Reference(
        start, table, 10.0 * np.abs(again - start) + SAME * np.maximum(np.abs(start), SAME), SAME * size + 10.0 * noise
    )
    with prober.hurry(took):
        return tuple(_tried(prober, variable, react, reference) for variable in parameters)


def _tried(prober: Prober, variable: Any, react: Any, reference: Reference) -> ProbedParameter:
    (quantity,) = quantities(prober.description, [variable.name])
    value = float(prober.values.get(variable.name, variable.start))
    acts = starts = False
    failure, tried = "", value
    for tried in trial_values(value, quantity.bounds):
        try:
            start, table = react(prober.with_values({variable.name: tried}))
        except SimulationError as error:
            failure = failure or str(error)
            continue
        rows = min(len(table), len(reference.table))
        differs = np.abs(table[:rows] - reference.table[:rows]) > reference.noise
        refused = np.isnan(table[:rows]) & ~np.isnan(reference.table[:rows])
        acts = acts or bool((differs | refused).any()) or len(table) != len(reference.table)
        starts = starts or bool((np.abs(start - reference.start) > reference.state_noise).any())
        if acts or starts:
            break
    return ProbedParameter(quantity, acts, starts, tried, failure)


def trial_values(value: float, bounds: tuple[float, float]) -> list[float]:
    """Return values to try instead of a parameter's value, the nearest first."""
    wanted = [1.1 * value, 0.9 * value, 2.0 * value, 0.5 * value] if value else [0.1, 1.0, -0.1, -1.0]
    inside = [v for v in wanted if bounds[0] <= v <= bounds[1]]
    low, high = bounds
    if not inside and np.isfinite([low, high]).all() and low < high:
        inside = [low + share * (high - low) for share in (0.1, 0.9)]
    return inside
