"""Trials of the parameters and start values that may be set before initialization: which of them act."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.errors import SimulationError
from cosim.fmi.description import REALS
from cosim.probing.fmu_structure import START_STEP, ProbedParameter, StartValue
from cosim.probing.log_runs import CHANCE, SAME, Course, Fmu, noise_of, nominal_of, outputs_along
from cosim.probing.prober import Prober, quantities
from cosim.scenario.start_values import settable

MOST_STARTS = 40  # start values tried


def settable_parameters(description: Any) -> list[Any]:
    """Return the scalar real parameters that may be set before initialization."""
    return [
        v
        for v in description.modelVariables
        if v.causality == "parameter" and v.variability in {"fixed", "tunable"} and _is_settable_real(v)
    ]


def _is_settable_real(v: Any) -> bool:
    return v.type in REALS and not v.shape and v.start is not None and settable(v)


def tried_parameters(
    prober: Prober, react: Callable[[Fmu], tuple[Array, Array]], size: Array
) -> tuple[ProbedParameter, ...]:
    """Return each settable parameter with what other values of it change.

    Args:
        react: Function of the FMU that returns its states after initialization, and a table of reactions.
        size: Magnitude of each column of the table.
    """
    parameters = settable_parameters(prober.description)
    if not parameters:
        return ()
    start, table = react(prober.fmu)
    begin = time.monotonic()
    again, repeated = react(prober.fmu)
    took = time.monotonic() - begin
    noise = noise_of(table, repeated, size)
    state_noise = noise_of(start[None], again[None], np.maximum(np.abs(start), SAME))
    found = []
    with prober.hurry(took):
        for variable in parameters:
            (quantity,) = quantities(prober.description, [variable.name])
            value = quantity.start
            acts = starts = False
            failure, tried = "", value
            low, high = quantity.bounds
            wanted = [1.1 * value, 0.9 * value, 2.0 * value, 0.5 * value] if value else [0.1, 1.0, -0.1, -1.0]
            inside = [v for v in wanted if low <= v <= high]
            if not inside and np.isfinite([low, high]).all() and low < high:
                inside = [low + share * (high - low) for share in (0.1, 0.9)]
            for tried in inside:
                try:
                    state, reaction = react(prober.with_values({variable.name: tried}))
                except SimulationError as error:
                    failure = failure or str(error)
                    continue
                rows = min(len(reaction), len(table))
                differs = np.abs(reaction[:rows] - table[:rows]) > noise
                refused = np.isnan(reaction[:rows]) & ~np.isnan(table[:rows])
                acts = acts or bool((differs | refused).any()) or len(reaction) != len(table)
                starts = starts or bool((np.abs(state - start) > state_noise).any())
                if acts or starts:
                    break
            found.append(ProbedParameter(quantity, acts, starts, tried, failure))
    return tuple(found)


def start_values(prober: Prober, course: Course, base: Array, noise: Array) -> tuple[StartValue, ...]:
    """Return the start values of states of an FMU for co-simulation that change an output: its unknown start states.

    Parameters are not tried: those of a start are a matter of names.

    Args:
        base: Outputs along the course with the FMU's own start values.
        noise: Differences of equal outputs.
    """
    found = []
    spread = np.maximum(base.std(axis=0), CHANCE * noise)
    used = {"input", "parameter", "calculatedParameter", "structuralParameter", "independent"}
    states = [
        v
        for v in prober.description.modelVariables
        if v.causality not in used and v.variability in {None, "continuous"} and _is_settable_real(v)
    ]
    for variable in states[:MOST_STARTS]:
        (quantity,) = quantities(prober.description, [variable.name])
        value = quantity.start
        size = START_STEP * (abs(value) or abs(nominal_of(variable)) or 1.0)
        moved = value + size if value + size <= quantity.bounds[1] else value - size
        try:
            table, _ = prober.call(outputs_along, prober.with_values({variable.name: moved}), course)
        except SimulationError:
            continue
        rows = min(len(table), len(base))
        change, by = table[:rows] - base[:rows], moved - value
        if not rows or not (np.abs(change) > noise).any():
            continue
        reach = float((np.abs(change) / spread).max()) / abs(by)
        # the output that alone shows it after initialization
        slopes = change[0] / by
        shown = np.flatnonzero(np.abs(slopes) > noise / abs(by))
        output = (int(shown[0]), float(slopes[shown[0]])) if len(shown) == 1 else (-1, 0.0)
        found.append(StartValue(quantity, 1.0 / reach, *output))
    return tuple(found)
